// SPDX-License-Identifier: Apache-2.0
// Frames of the server into the page's state.

import { batch, effect } from "@preact/signals";

import { send } from "./connection";
import { liveTrack } from "./map/robot_pose";
import { loadPlaces } from "./map/commands";
import { type Health, type LogLine, type Odometry } from "./messages";
import { notify } from "./notices";
import { fleet, stopAllPending } from "./fleet";
import { DEBUG_LAYERS, layers, pageName } from "./preferences";
import { type Hello, type ServerFrame } from "./protocol";
import { appendLog, clients, connected, drivers, health, hello, latest, topicOf, type SingleKey } from "./state";
import { type TilesFrame } from "./tile_store";
import { decodeMessage, WireError } from "./wire";

/** Keys that the page shows whatever panel is open; families by their first part. */
const WANTED = [
  ...["map", "map/state", "pose", "odom", "scan", "scan_2", "plan", "goal", "zones", "cmd/vel", "estop", "guard/status", "base/status"],
  ...["nav/status", "nav/task", "follow/status", "health", "log", "sim/truth"],
];
const DEBUG = ["debug/costmap", "debug/rollouts", "debug/graph"];

/** Of the keys that may be wanted, those that the page shows. A family is offered by its members. */
export function wantedKeys(offered: readonly string[], debug: boolean): string[] {
  const wanted = new Set(debug ? [...WANTED, ...DEBUG] : WANTED);
  return offered.filter((key) => wanted.has(key) || (/^(health|log)\//.test(key) && wanted.has(key.split("/")[0]!)));
}

export function dispatcher(onTiles: (frame: TilesFrame) => void): (frame: ServerFrame) => void {
  return (frame) => {
    if (frame.t === "m") onMessage(frame.k, frame.b);
    else if (frame.t === "tiles") onTiles(frame);
    else if (frame.t === "hello") onHello(frame);
    else if (frame.t === "drivers") drivers.value = frame;
    else if (frame.t === "clients") clients.value = frame.clients;
    else if (frame.t === "fleet") fleet.value = frame.robots;
    else if (frame.t === "note") {
      if (frame.answers === "stop_all") stopAllPending.value = false;
      notify(frame.level, frame.text, frame.hint);
    }
  };
}

/** Says what the page shows, now and when that changes. To be called once. */
export function watchWants(): void {
  effect(() => {
    const offered = hello.value?.keys;
    if (!connected.value || offered === undefined) return;
    const debug = layers.value.some((layer) => DEBUG_LAYERS.includes(layer));
    send({ t: "want", keys: wantedKeys(offered, debug), debug });
  });
}

function onHello(frame: Hello): void {
  if (!frame.login && pageName.peek() !== "") send({ t: "name", name: pageName.peek() });
  drivers.value = null;
  document.title = `${frame.robot.name} · zenav`;
  if (frame.site !== true) void loadPlaces();
}

function onMessage(key: string, bytes: Uint8Array): void {
  const topic = topicOf(key);
  if (topic === null) return;
  const at = performance.now();
  try {
    const message = decodeMessage(topic, bytes);
    const service = key.slice(topic.length + 1);
    batch(() => {
      if (topic === "health") {
        health.value = new Map(health.peek()).set(service, { message: message as Health, at });
      } else if (topic === "log") {
        appendLog(service, message as LogLine);
      } else {
        (latest[topic as SingleKey] as { value: unknown }).value = { message, at };
        if (topic === "odom") liveTrack.add(message as Odometry);
      }
    });
  } catch (error) {
    if (!(error instanceof WireError)) throw error; // a message of another version is left out
  }
}
