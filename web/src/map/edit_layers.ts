// SPDX-License-Identifier: Apache-2.0
// Layers of what users set: zones, places, goal, route, and what is being drawn.

import { type Point } from "../geometry";
import { replaying, shown } from "../state";
import { t } from "../texts";
import { visibleBounds } from "../view_transform";
import { mapEdits, strokeWidth } from "./map_edits";
import { centre, type Pen, points } from "./pen";
import {
  closedPolygon,
  draftCorners,
  draftPose,
  draftStroke,
  editedZone,
  editKind,
  newPlace,
  places,
  route,
  tool,
} from "./tools";

const GRID_STEPS_M = [1, 5, 10, 50, 100];
const MIN_GRID_PX = 40;

export function drawGrid(pen: Pen): void {
  const step = GRID_STEPS_M.find((s) => s * pen.view.scale >= MIN_GRID_PX);
  if (step === undefined) return;
  const [x0, y0, x1, y1] = visibleBounds(pen.view, pen.size);
  const lines: (Point | null)[] = [];
  for (let x = Math.ceil(x0 / step) * step; x <= x1; x += step) lines.push([x, y0], [x, y1], null);
  for (let y = Math.ceil(y0 / step) * step; y <= y1; y += step) lines.push([x0, y], [x1, y], null);
  pen.trace(lines);
  pen.stroke(pen.palette.grid, 1);
}

export function drawZones(pen: Pen): void {
  for (const zone of shown.zones.peek()?.message.zones ?? []) {
    const edited = editedZone.peek();
    const corners = edited?.name === zone.name ? edited.corners : [...points(zone.xs, zone.ys)];
    const color = zone.kind === "keep_out" ? pen.palette.keepOut : pen.palette.slow;
    pen.trace(corners, true);
    pen.fill(color, 0.14);
    pen.stroke(color, 2, zone.kind === "slow" ? [7, 5] : []);
    if (edited?.name === zone.name) drawCorners(pen, corners, color);
  }
}

/** Virtual walls; while edits are drawn, erased areas too. */
export function drawEdits(pen: Pen): void {
  const edits = replaying.peek() ? (shown["map/state"].peek()?.message.edits ?? []) : mapEdits();
  for (const edit of edits) {
    const isWall = edit.kind === "wall";
    if (!isWall && editKind(tool.peek()) === null) continue;
    pen.trace(points(edit.xs, edit.ys), edit.width === 0);
    if (edit.width === 0) pen.fill(pen.palette.erased, 0.25);
    if (isWall) drawWall(pen, edit.width);
    else if (edit.width > 0) pen.stroke(translucent(pen.palette.erased), edit.width * pen.view.scale);
  }
}

function drawWall(pen: Pen, width: number): void {
  const thickness = Math.max(4, width * pen.view.scale);
  pen.stroke(pen.palette.wall, thickness);
  pen.stroke(pen.palette.labelBack, Math.max(1.5, thickness / 3), [thickness, 1.6 * thickness]);
}

/** A colour #rrggbb at a quarter of its opacity. */
function translucent(color: string): string {
  return `${color}40`;
}

export function drawZoneNames(pen: Pen): void {
  for (const zone of shown.zones.peek()?.message.zones ?? []) {
    pen.label(centre([...points(zone.xs, zone.ys)]), zone.name, 0);
  }
}

export function drawPlaces(pen: Pen): void {
  for (const { name, pose } of places.peek()) {
    const at: Point = [pose[0], pose[1]];
    pen.disc(at, 5);
    pen.stroke(pen.palette.labelBack, 4);
    pen.fill(pen.palette.place);
    pen.label(at, name, 18);
  }
}

export function drawGoal(pen: Pen): void {
  const goal = shown.goal.peek()?.message;
  const task = shown["nav/task"].peek()?.message;
  if (task?.kind === "route" && task.poses.length > 1) {
    const stops: Point[] = task.poses.map((pose) => [pose[0], pose[1]]);
    pen.trace(stops, task.loops !== 1);
    pen.stroke(pen.palette.goal, 1.5, [3, 5]);
    stops.forEach((stop, i) => numbered(pen, stop, i + 1, i < task.waypoint ? pen.palette.old : pen.palette.goal));
  }
  if (goal?.active) pen.arrow(goal.map_from_goal, 34, pen.palette.goal);
}

/** The route that is being put together, and whatever is half drawn. */
export function drawDrafts(pen: Pen): void {
  const rows = route.peek();
  pen.trace(rows.map(({ pose }) => [pose[0], pose[1]]));
  pen.stroke(pen.palette.plan, 2, [6, 5]);
  rows.forEach(({ pose }, i) => {
    pen.arrow(pose, 26, pen.palette.plan);
    numbered(pen, [pose[0], pose[1]], i + 1, pen.palette.plan);
  });
  const pose = draftPose.peek();
  if (pose !== null) pen.arrow(pose, 46, tool.peek() === "pose" ? pen.palette.truth : pen.palette.goal);
  const named = newPlace.peek();
  if (named !== null) pen.arrow(named, 30, pen.palette.place);
  const polygon = closedPolygon.peek();
  const corners = polygon ?? draftCorners.peek();
  if (corners.length > 0) {
    pen.trace(corners, polygon !== null);
    if (corners.length > 2) pen.fill(pen.palette.keepOut, 0.14);
    pen.stroke(pen.palette.keepOut, 2, [5, 4]);
    if (polygon === null) drawCorners(pen, corners, pen.palette.keepOut);
  }
  const kind = editKind(tool.peek());
  const stroke = draftStroke.peek();
  if (kind !== null && stroke.length > 0) {
    pen.trace(stroke.length > 1 ? stroke : [stroke[0]!, stroke[0]!]);
    const width = strokeWidth(kind, pen.view.scale);
    if (kind === "wall") drawWall(pen, width);
    else pen.stroke(translucent(pen.palette.erased), width * pen.view.scale);
  }
  if (tool.peek() === "zone" && corners.length >= 3) pen.label(corners[0]!, t("close_polygon"), -20);
}

function drawCorners(pen: Pen, corners: readonly Point[], color: string): void {
  for (const corner of corners) {
    pen.disc(corner, 7);
    pen.fill(pen.palette.labelBack);
    pen.stroke(color, 2.5);
  }
}

function numbered(pen: Pen, at: Point, n: number, color: string): void {
  const [x, y] = pen.screen(at);
  pen.disc(at, 10);
  pen.fill(color);
  pen.stroke(pen.palette.labelBack, 2);
  pen.context.font = "600 11px system-ui, sans-serif";
  pen.context.textAlign = "center";
  pen.context.textBaseline = "middle";
  pen.context.fillStyle = pen.palette.robotEdge;
  pen.context.fillText(String(n), x, y + 0.5);
}
