// SPDX-License-Identifier: Apache-2.0
// Edits of the map: erased obstacles and virtual walls. The robot publishes them, and applies what pages ask for.

import { ask } from "../connection";
import { type Point } from "../geometry";
import { type MapEdit } from "../messages";
import { mapId, mapState } from "../state";
import { encodeFloat64s } from "../wire";
import { report } from "./commands";

const MAX_POINTS = 256; // of one edit: MAX_EDIT_POINTS in shared/messages.py
const MAX_WIDTH_M = 5;
const BRUSH_PX = 24;
const WALL_WIDTH_M = 0.1;
const N_ATTEMPTS = 20; // while the robot redraws its map
const RETRY_MS = 500;

/** The edits of the map that is shown. */
export function mapEdits(): readonly MapEdit[] {
  return mapState.value?.edits ?? [];
}

/** m: width of a stroke at a scale of the view, px/m. The brush is one finger wide, a wall two cells. */
export function strokeWidth(kind: MapEdit["kind"], scale: number): number {
  return kind === "wall" ? WALL_WIDTH_M : Math.min(MAX_WIDTH_M, BRUSH_PX / scale);
}

/** Points of a stroke, as few as one edit may have, with both ends. */
export function thinned(points: readonly Point[]): readonly Point[] {
  if (points.length <= MAX_POINTS) return points;
  return thinned(points.filter((_, i) => i % 2 === 0 || i === points.length - 1));
}

export async function addEdit(kind: MapEdit["kind"], stroke: readonly Point[], width: number): Promise<void> {
  const points = thinned(stroke);
  const xs = encodeFloat64s(points.map((point) => point[0]));
  const ys = encodeFloat64s(points.map((point) => point[1]));
  await change({ add: [{ stamp: 0, id: 0, kind, xs, ys, width }] });
}

export async function removeEdit(id: number): Promise<void> {
  await change({ add: [], remove: [id] });
}

/** Removes the newest edit. */
export async function undoEdit(): Promise<void> {
  const ids = mapEdits().map((edit) => edit.id);
  if (ids.length > 0) await removeEdit(Math.max(...ids));
}

/** Asks until the robot does not redraw its map any more, or another map is shown. */
async function change(args: object): Promise<void> {
  const map = mapId.peek();
  let reply = await ask("request/edit_map", args);
  for (let n = 1; n < N_ATTEMPTS && reply.reason === "busy" && mapId.peek() === map; n++) {
    await new Promise((resolve) => setTimeout(resolve, RETRY_MS));
    reply = await ask("request/edit_map", args);
  }
  report(reply);
}
