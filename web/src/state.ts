// SPDX-License-Identifier: Apache-2.0
// What the page knows now: the newest message of each key with the time of its arrival, and what the server said.

import { computed, type ReadonlySignal, signal, type Signal } from "@preact/signals";

import { type Health, type Key, type LogLine, type MapState, type MessageOf } from "./messages";
import { type Drivers, type Hello, type PageClient } from "./protocol";
import { StackClock } from "./stack_clock";

/** A message and when it came, ms of performance.now(). */
export interface Received<M> {
  readonly message: M;
  readonly at: number;
}

export interface LogEntry extends LogLine {
  readonly service: string;
  readonly id: number;
}

const SINGLE_KEYS = [
  ...(["scan", "scan_2", "odom", "pose", "goal", "plan", "zones", "map/state", "follow/status", "nav/status", "nav/task", "cmd/vel"] as const),
  ...(["estop", "guard/status", "base/status", "debug/costmap", "debug/rollouts", "debug/graph", "sim/truth"] as const),
] as const satisfies readonly Key[];

/** Keys that the page reads, but for those of families. */
export type SingleKey = (typeof SINGLE_KEYS)[number];
export type Latest = { readonly [K in SingleKey]: Signal<Received<MessageOf[K]> | null> };

function nothing(): Latest {
  return Object.fromEntries(SINGLE_KEYS.map((key) => [key, signal(null)])) as unknown as Latest;
}

export const latest = nothing();
/** A recording is replayed: the page shows `replayed`, and sends the robot no command but STOP. */
export const replaying = signal(false);
/** The messages of the moment of a recording that is replayed. */
export const replayed = nothing();
/** ns: that moment, on the recorded clock. */
export const replayStamp = signal(0);
/** The messages that the page draws: the live ones, or those of the replay. */
export const shown = Object.fromEntries(
  SINGLE_KEYS.map((key) => [key, computed(() => (replaying.value ? replayed : latest)[key].value)]),
) as unknown as { readonly [K in SingleKey]: ReadonlySignal<Received<MessageOf[K]> | null> };
export const health = signal<ReadonlyMap<string, Received<Health>>>(new Map());
export const log = signal<readonly LogEntry[]>([]);
export const hello = signal<Hello | null>(null);
export const drivers = signal<Drivers | null>(null);
export const clients = signal<readonly PageClient[]>([]);
export const mapId = signal(0);
/** Name and edits of the map that is shown; null without any, and while those of another map are known. */
export const mapState = computed<MapState | null>(() => {
  const state = latest["map/state"].value?.message;
  return state !== undefined && state.map_id === mapId.value ? state : null;
});
/** Name under which the map that is shown was saved or loaded; "" for none. */
export const mapName = computed(() => mapState.value?.name ?? "");

const TOPICS: ReadonlySet<string> = new Set([...SINGLE_KEYS, "health", "log"]);

/** The topic of a published key: "health" for "health/mapper"; null for topics that the page does not read. */
export function topicOf(key: string): SingleKey | "health" | "log" | null {
  const topic = /^(health|log)\//.exec(key)?.[1] ?? key;
  return TOPICS.has(topic) ? (topic as SingleKey) : null;
}

/** The link: open, or when the next attempt is (ms of performance.now()). */
export const link = signal<{ state: "connecting" | "open" | "waiting"; retryAt: number; since: number }>({
  state: "connecting",
  retryAt: 0,
  since: 0,
});
export const rtt = signal<number | null>(null);
export const clock = new StackClock();

/** Time of the page in ms, four times a second: ages on the screen follow it. */
export const now = signal(0);

export const connected = computed(() => link.value.state === "open" && hello.value !== null);
/** Whether the role of the page suffices, as shared/roles.py has it. The server decides. Nothing is changed in a replay. */
export const mayAdminister = computed(() => connected.value && hello.value?.role === "admin" && !replaying.value);
export const mayOperate = computed(() => connected.value && hello.value?.role !== "viewer" && !replaying.value);

/** Seconds without a message after which a key's data is shown as old. Events (goal, zones, estop) do not age. */
const MAX_AGE_S: { readonly [K in SingleKey]?: number } = {
  pose: 1,
  odom: 0.6,
  scan: 1,
  scan_2: 1,
  plan: 6,
  "guard/status": 1,
  "nav/status": 2,
  "follow/status": 2,
  "base/status": 5,
  "cmd/vel": 1,
  "debug/costmap": 1.5,
  "debug/rollouts": 1.5,
  "debug/graph": 6,
  "sim/truth": 1,
};

/** Age of the newest message of a key at `at` (ms), s: since it came, or since its stamp where it came late. */
export function ageOf(key: SingleKey, at: number): number | null {
  const entry = latest[key].peek();
  if (entry === null) return null;
  const since = (at - entry.at) / 1e3;
  const byStamp = MAX_AGE_S[key] === undefined ? null : clock.age(entry.message.stamp, at);
  return Math.max(since, byStamp ?? 0);
}

/** Whether a key's newest message is missing, too old, or from a link that is lost. */
export function isOld(key: SingleKey, at: number): boolean {
  const age = ageOf(key, at);
  return age === null || link.peek().state !== "open" || age > (MAX_AGE_S[key] ?? Infinity);
}

/** As `ageOf`, of what is shown: in a replay on the recorded clock. */
export function shownAge(key: SingleKey, at: number): number | null {
  if (!replaying.peek()) return ageOf(key, at);
  const entry = replayed[key].peek();
  return entry === null ? null : Math.max(0, (replayStamp.peek() - entry.message.stamp) / 1e9);
}

/** As `isOld`, of what is shown. */
export function isShownOld(key: SingleKey, at: number): boolean {
  if (!replaying.peek()) return isOld(key, at);
  const age = shownAge(key, at);
  return age === null || age > (MAX_AGE_S[key] ?? Infinity);
}

const MAX_LOG = 600;
let nLogged = 0;

export function appendLog(service: string, line: LogLine): void {
  const kept = log.peek().slice(-MAX_LOG + 1);
  log.value = [...kept, { ...line, service, id: ++nLogged }];
}
