// SPDX-License-Identifier: Apache-2.0
// Lists that the server answers to `do`: maps, places, recordings, settings. Rows with a missing name are left out.

import { type Point, type Pose } from "./geometry";
import { type NamedPlace } from "./map/tools";
import { type TilesFrame } from "./tile_store";

export interface SavedMap {
  readonly name: string;
  /** bytes; null where the server does not say it. */
  readonly size: number | null;
  /** s since 1970 of the last change; null where the server does not say it. */
  readonly modified: number | null;
}

export interface Recording extends SavedMap {
  /** Whether it is marked, so that it is not deleted for space. */
  readonly marked: boolean;
  /** Whether it is being written. */
  readonly current: boolean;
}

/** The origin of a value that was set while the robot runs. */
export const RUN_TIME = "set at run time";

const KINDS = ["number", "integer", "switch", "choice"] as const;

/** How a setting is edited that may change while the robot runs. */
export interface SettingEditor {
  readonly kind: (typeof KINDS)[number];
  readonly choices: readonly string[];
  /** Bounds, null without one. */
  readonly low: number | null;
  readonly high: number | null;
  readonly unit: string;
  /** Whether it may only be lowered below `started`, by an admin. */
  readonly isLimit: boolean;
  /** The value with which the robot was started. */
  readonly started: string;
}

export interface Setting {
  readonly name: string;
  readonly value: string;
  readonly origin: string;
  readonly description: string;
  /** null where it needs a restart, or its service does not run. */
  readonly editor: SettingEditor | null;
}

type Row = Record<string, unknown>;

/** The rows of a list that have a name. A text is a row with this name. */
function named(data: unknown): (Row & { name: string })[] {
  const rows = Array.isArray(data) ? (data as unknown[]) : [];
  return rows
    .map((row) => (typeof row === "string" ? { name: row } : ((row ?? {}) as Row)))
    .filter((row): row is Row & { name: string } => typeof row["name"] === "string");
}

function number(value: unknown): number | null {
  return typeof value === "number" ? value : null;
}

export function mapsFrom(data: unknown): SavedMap[] {
  return named(data).map((row) => ({
    name: row.name,
    size: number(row["size"]),
    modified: number(row["modified"]),
  }));
}

export function recordingsFrom(data: unknown): Recording[] {
  return named(data).map((row) => ({
    name: row.name,
    size: number(row["size"]),
    modified: number(row["modified"]),
    marked: row["marked"] === true,
    current: row["current"] === true,
  }));
}

export function placesFrom(data: unknown): NamedPlace[] {
  return named(data).flatMap((row) => {
    const pose = Array.isArray(row["pose"]) ? (row["pose"] as unknown[]) : [row["x"], row["y"], row["yaw"]];
    const [x, y, yaw] = pose.map(number) as (number | null)[];
    if (x === null || x === undefined || y === null || y === undefined) return [];
    const map = typeof row["map"] === "string" ? row["map"] : "";
    const hasHeading = yaw !== null && yaw !== undefined;
    return [{ name: row.name, pose: [x, y, yaw ?? 0] as Pose, map, hasHeading }];
  });
}

function text(value: unknown): string {
  return typeof value === "string" ? value : (JSON.stringify(value) ?? "");
}

export function settingsFrom(data: unknown): Setting[] {
  return named(data).map((row) => ({
    name: row.name,
    value: text(row["value"]),
    origin: text(row["origin"] ?? ""),
    description: text(row["description"] ?? ""),
    editor: editorFrom(row),
  }));
}

function editorFrom(row: Row): SettingEditor | null {
  const kind = KINDS.find((known) => known === row["kind"]);
  if (kind === undefined) return null;
  return {
    kind,
    choices: Array.isArray(row["choices"]) ? (row["choices"] as unknown[]).map(text) : [],
    low: number(row["low"]),
    high: number(row["high"]),
    unit: text(row["unit"] ?? ""),
    isLimit: row["is_limit"] === true,
    started: text(row["started"]),
  };
}

/** The robot with which a recording was made. */
export interface RecordedRobot {
  readonly name: string;
  readonly outline: readonly Point[];
  readonly laser_mount: Pose;
  readonly laser_2_mount?: Pose;
}

export interface ReplayMark {
  /** s since the begin of the recording. */
  readonly t: number;
  readonly kind: "fault" | "mark";
  readonly reason: string;
  readonly text: string;
}

/** What `replay_open` answers. Times in s. */
export interface OpenedReplay {
  readonly name: string;
  /** Since 1970, on the recorded clock. */
  readonly begin: number;
  readonly length: number;
  /** The first moment at which state, place and a map are known: before it there is little to see. */
  readonly start: number;
  readonly robot: RecordedRobot | null;
  readonly marks: readonly ReplayMark[];
  /** t, x, y of each point. */
  readonly trail: readonly number[];
  readonly problems: readonly string[];
}

/** What `replay_at` answers: newest messages and tiles of a moment. */
export interface ReplayState {
  readonly t: number;
  /** ns on the recorded clock. */
  readonly stamp: number;
  readonly messages: readonly (readonly [key: string, bytes: Uint8Array])[];
  readonly tiles: TilesFrame & { readonly left: number; readonly began: number };
}

/** The parts of a replay's trail until `t` that are on the map that began at `began`, s. */
export function trailUntil(flat: readonly number[], began: number, t: number): Point[] {
  const points: Point[] = [];
  for (let i = 0; i + 2 < flat.length && flat[i]! <= t; i += 3) {
    if (flat[i]! >= began) points.push([flat[i + 1]!, flat[i + 2]!]);
  }
  return points;
}
