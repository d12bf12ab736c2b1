// SPDX-License-Identifier: Apache-2.0
// The tool that a press on the map uses, and what the user is drawing with it.

import { computed, signal } from "@preact/signals";

import { type Point, type Pose } from "../geometry";
import { mapName } from "../state";

export type Tool = "look" | "goal" | "route" | "pose" | "place" | "zone" | "erase" | "wall";

export interface Waypoint {
  readonly id: number;
  readonly pose: Pose;
  /** s to stay there. */
  readonly dwell: number;
}

export interface NamedPlace {
  readonly name: string;
  readonly pose: Pose;
  readonly map: string;
  /** Whether the place has a heading; without one any will do. */
  readonly hasHeading: boolean;
}

export const tool = signal<Tool>("look");
/** The pose that is being dragged. */
export const draftPose = signal<Pose | null>(null);
export const route = signal<readonly Waypoint[]>([]);
/** Corners of the polygon that is being drawn. */
export const draftCorners = signal<readonly Point[]>([]);
/** The pose that waits for its name as a place. */
export const newPlace = signal<Pose | null>(null);
/** The zone whose corners may be dragged, by its name, and its corners. */
export const editedZone = signal<{ readonly name: string; readonly corners: readonly Point[] } | null>(null);
const allPlaces = signal<readonly NamedPlace[]>([]);
/** Places on the map that is shown, and those of no map; all of them on a map without a name. */
export const places = computed(() =>
  allPlaces.value.filter(({ map }) => map === "" || mapName.value === "" || map === mapName.value),
);
/** The closed polygon that waits for its name and kind. */
export const closedPolygon = signal<readonly Point[] | null>(null);
/** The points of the eraser's stroke, or the ends of the wall, that is being drawn. */
export const draftStroke = signal<readonly Point[]>([]);
export const isDrawing = computed(() => tool.value !== "look" || editedZone.value !== null);

export function setPlaces(rows: readonly NamedPlace[]): void {
  allPlaces.value = rows;
}

/** The kind of edit that a tool draws; null for other tools. */
export function editKind(chosen: Tool): "erase" | "wall" | null {
  return chosen === "erase" || chosen === "wall" ? chosen : null;
}

let nWaypoints = 0;

export function addWaypoint(pose: Pose): void {
  route.value = [...route.peek(), { id: ++nWaypoints, pose, dwell: 0 }];
}

/** Moves a waypoint by one place: -1 earlier, +1 later. */
export function moveWaypoint(index: number, by: -1 | 1): void {
  const rows = [...route.peek()];
  const other = index + by;
  if (other < 0 || other >= rows.length) return;
  [rows[index], rows[other]] = [rows[other]!, rows[index]!];
  route.value = rows;
}

export function removeWaypoint(index: number): void {
  route.value = route.peek().filter((_, i) => i !== index);
}

export function setDwell(index: number, dwell: number): void {
  route.value = route.peek().map((row, i) => (i === index ? { ...row, dwell } : row));
}

export function chooseTool(chosen: Tool): void {
  tool.value = chosen === tool.peek() ? "look" : chosen;
  draftPose.value = null;
  draftCorners.value = [];
  draftStroke.value = [];
  editedZone.value = null;
}

/** Leaves the tool and drops what is half drawn. */
export function cancelDrawing(): void {
  chooseTool("look");
  closedPolygon.value = null;
  newPlace.value = null;
}

export function closePolygon(): void {
  const corners = draftCorners.peek();
  if (corners.length < 3) return;
  closedPolygon.value = corners;
  draftCorners.value = [];
  tool.value = "look";
}
