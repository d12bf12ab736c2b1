// SPDX-License-Identifier: Apache-2.0
// The robots that the page's server hears: which one is selected, and which stand on the map that is shown. STOP for all.

import { computed, effect, signal } from "@preact/signals";

import { send } from "./connection";
import { type FleetRobot } from "./protocol";
import { connected, hello, mapName } from "./state";
import { language } from "./preferences";

export const fleet = signal<readonly FleetRobot[]>([]);
export const selected = signal("");
export const isSite = computed(() => hello.value?.site === true);
/** A robot alone has no fleet. */
export const hasFleet = computed(() => isSite.value || fleet.value.length > 1);
const ownName = computed(() => hello.value?.robot.name ?? "");

/** Okabe-Ito without black and yellow: told apart with each kind of colour vision, on dark and on light. */
const COLORS = ["#e69f00", "#56b4e9", "#009e73", "#d55e00", "#cc79a7", "#0072b2"] as const;

/** The colour of a robot, by its place among all names. */
export function colorOf(name: string, robots: readonly FleetRobot[]): string {
  const names = robots.map((robot) => robot.name).sort();
  return COLORS[Math.max(0, names.indexOf(name)) % COLORS.length]!;
}

/** Whether coordinates of a robot are those of the map that is shown: only a saved map has a name that others know. */
export function isOnMap(robot: FleetRobot, own: string, map: string): boolean {
  return robot.name === own || (map !== "" && robot.map === map);
}

/** The other robots on the map that is shown. */
export const othersOnMap = computed(() =>
  fleet.value.filter(
    (robot) => robot.name !== ownName.value && robot.x !== null && isOnMap(robot, ownName.value, mapName.value),
  ),
);

/** The name of the robot nearest to a point (m, map) within `reach` m, or null. */
export function robotAt(robots: readonly FleetRobot[], x: number, y: number, reach: number): string | null {
  const near = robots
    .filter((robot) => robot.x !== null && robot.y !== null)
    .map((robot) => ({ name: robot.name, distance: Math.hypot(robot.x! - x, robot.y! - y) }))
    .filter(({ distance }) => distance <= reach)
    .sort((a, b) => a.distance - b.distance);
  return near[0]?.name ?? null;
}

/** Selects a robot. A page of a site then shows it: its map, plan, task and log. */
export function selectRobot(name: string): void {
  selected.value = name;
  if (isSite.peek() && name !== ownName.peek()) location.search = `?robot=${encodeURIComponent(name)}`;
}

const STOP_ALL_REPEAT_MS = 1000; // the server takes some seconds, and one order at a time

/** STOP for all was pressed here, and the server has not answered it. */
export const stopAllPending = signal(false);

export function stopAll(): void {
  stopAllPending.value = true;
}

/** Sends STOP for all until the server answers, also after a lost link comes back. To be called once. */
export function watchStopAll(): void {
  effect(() => {
    if (!stopAllPending.value || !connected.value) return undefined;
    send({ t: "stop_all" });
    const timer = setInterval(() => send({ t: "stop_all" }), STOP_ALL_REPEAT_MS);
    return () => clearInterval(timer);
  });
}

const STATES: Readonly<Record<string, readonly [string, string]>> = {
  idle: ["ready", "bereit"],
  navigating: ["drives", "fährt"],
  exploring: ["explores", "erkundet"],
  recovering: ["recovers", "befreit sich"],
  paused: ["paused", "pausiert"],
  reached: ["goal reached", "Ziel erreicht"],
  failed: ["failed", "gescheitert"],
  canceled: ["canceled", "abgebrochen"],
  stopped: ["STOP", "STOP"],
  silent: ["silent", "stumm"],
};

/** The state of a robot in the language of the page. */
export function stateText(state: string): string {
  return STATES[state]?.[language.value === "de" ? 1 : 0] ?? state;
}
