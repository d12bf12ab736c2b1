// SPDX-License-Identifier: Apache-2.0
// Lists that the server answers to `do`: maps, places, recordings, settings. Rows with a missing name are left out.

import { type Pose } from "./geometry";
import { type NamedPlace } from "./map/tools";

export interface SavedMap {
  readonly name: string;
  /** bytes; null where the server does not say it. */
  readonly size: number | null;
  /** s since 1970 of the last change; null where the server does not say it. */
  readonly modified: number | null;
  readonly current: boolean;
}

export interface Recording {
  readonly name: string;
  readonly size: number | null;
  readonly modified: number | null;
  /** Whether it is being written. */
  readonly current: boolean;
}

export interface Setting {
  readonly name: string;
  readonly value: string;
  readonly origin: string;
  readonly description: string;
}

type Row = Record<string, unknown>;

/** The rows of a list; of a map with one list in it; or of a map of rows by name. A text is a row with this name. */
function rows(data: unknown, name: string): Row[] {
  if (Array.isArray(data)) {
    return data.map((row: unknown) => (typeof row === "string" ? { name: row } : ((row ?? {}) as Row)));
  }
  if (data === null || typeof data !== "object") return [];
  const inner = (data as Row)[name];
  if (inner !== undefined) return rows(inner, name);
  return Object.entries(data).map(([key, row]) => ({ name: key, ...(typeof row === "object" ? (row as Row) : {}) }));
}

function named(data: unknown, name: string): (Row & { name: string })[] {
  return rows(data, name).filter((row): row is Row & { name: string } => typeof row["name"] === "string");
}

function number(value: unknown): number | null {
  return typeof value === "number" ? value : null;
}

export function mapsFrom(data: unknown): SavedMap[] {
  return named(data, "maps").map((row) => ({
    name: row.name,
    size: number(row["size"]),
    modified: number(row["modified"]),
    current: row["current"] === true,
  }));
}

export function recordingsFrom(data: unknown): Recording[] {
  return mapsFrom(Array.isArray(data) ? data : rows(data, "recordings"));
}

export function placesFrom(data: unknown): NamedPlace[] {
  return named(data, "places").flatMap((row) => {
    const pose = Array.isArray(row["pose"]) ? (row["pose"] as unknown[]) : [row["x"], row["y"], row["yaw"]];
    const [x, y, yaw] = pose.map(number) as (number | null)[];
    if (x === null || x === undefined || y === null || y === undefined) return [];
    const map = typeof row["map"] === "string" ? row["map"] : "";
    const hasHeading = yaw !== null && yaw !== undefined;
    return [{ name: row.name, pose: [x, y, yaw ?? 0] as Pose, map, hasHeading }];
  });
}

export function settingsFrom(data: unknown): Setting[] {
  const text = (value: unknown): string => (typeof value === "string" ? value : (JSON.stringify(value) ?? ""));
  return named(data, "settings").map((row) => ({
    name: row.name,
    value: text(row["value"]),
    origin: text(row["origin"] ?? ""),
    description: text(row["description"] ?? ""),
  }));
}
