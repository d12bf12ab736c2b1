// SPDX-License-Identifier: Apache-2.0
// Lists of the server that panels show: maps, recordings, settings. Loaded when a panel opens and after each change.

import { signal } from "@preact/signals";

import { run } from "./connection";
import { report } from "./map/commands";
import { mapsFrom, recordingsFrom, settingsFrom, type Recording, type SavedMap, type Setting } from "./records";
import { hello } from "./state";
import { t } from "./texts";

export const maps = signal<readonly SavedMap[] | null>(null);
export const recordings = signal<readonly Recording[] | null>(null);
export const settings = signal<readonly Setting[] | null>(null);

export async function loadMaps(): Promise<void> {
  const reply = await run("maps");
  if (report(reply)) maps.value = mapsFrom(reply.data);
}

export async function loadRecordings(): Promise<void> {
  const reply = await run("recordings");
  if (report(reply)) recordings.value = recordingsFrom(reply.data);
}

export async function loadSettings(): Promise<void> {
  const reply = await run("settings");
  if (report(reply)) settings.value = settingsFrom(reply.data);
}

/** Runs an operation on maps, then loads the list again. */
export async function changeMap(op: string, args: object, done: string): Promise<void> {
  if (report(await run(op, args), done)) await loadMaps();
}

export async function changeRecording(op: string, args: object, done: string): Promise<void> {
  if (report(await run(op, args), done)) await loadRecordings();
}

/** Sets one setting of the running robot; "" is the value of its start. Then loads the list again. */
export async function changeSetting(name: string, value: string): Promise<void> {
  if (report(await run("setting_set", { name, value }), t("setting_is_set", { name }))) await loadSettings();
}

/** Sends a ROS map (zip of pgm and yaml) under a name. Returns "" or what went wrong. */
export async function uploadMap(name: string, file: File): Promise<string> {
  try {
    const headers = { "X-CSRF": hello.peek()?.csrf ?? "" };
    const answer = await fetch(`/maps?name=${encodeURIComponent(name)}`, { method: "POST", headers, body: file });
    if (!answer.ok) return (await answer.text()) || String(answer.status);
  } catch (error) {
    return String(error);
  }
  await loadMaps();
  return "";
}
