// SPDX-License-Identifier: Apache-2.0
// Mouse, fingers and keys on the map: move the view, or draw with the chosen tool.

import { othersOnMap, robotAt, selectRobot } from "../fleet";
import { type Point, type Pose } from "../geometry";
import { panBy, pinch, rotateAt, toMap, toScreen } from "../view_transform";
import { following } from "./following";
import { type MapView, view } from "./map_view";
import { finishPose } from "./commands";
import { addEdit, strokeWidth } from "./map_edits";
import {
  addWaypoint,
  cancelDrawing,
  closePolygon,
  draftCorners,
  draftPose,
  draftStroke,
  editedZone,
  editKind,
  tool,
} from "./tools";

const MIN_DRAG_PX = 12; // shorter presses are clicks: the heading is the robot's choice
const CORNER_PX = 22; // around a corner in which a press takes it
const ROBOT_REACH_M = 0.4; // around a robot in which a press selects it
const ROBOT_REACH_PX = 16;
const WHEEL_FACTOR = 0.0015; // of the logarithm of the scale, a px of the wheel
const MIN_STROKE_STEP_PX = 4; // between two points of the eraser's stroke
const KEY_TURN_RAD = Math.PI / 12;
const KEY_PAN_PX = 60;

/** Installs pointer, wheel and key handlers on the map's upper canvas. */
export function installGestures(map: MapView, canvas: HTMLCanvasElement): void {
  const fingers = new Map<number, Point>();
  let anchor: Point | null = null; // map point where a pose is dragged from
  let corner = -1; // of the edited zone, being dragged
  let turning = false;

  const at = (event: MouseEvent): Point => {
    const box = canvas.getBoundingClientRect();
    return [event.clientX - box.left, event.clientY - box.top];
  };
  const mapPoint = (p: Point): Point => toMap(view.peek(), map.size, p);
  const abort = (): void => {
    anchor = null;
    corner = -1;
    draftPose.value = null;
    draftStroke.value = [];
  };

  canvas.addEventListener("pointerdown", (event) => {
    canvas.setPointerCapture(event.pointerId);
    fingers.set(event.pointerId, at(event));
    turning = event.shiftKey;
    if (fingers.size > 1) return abort();
    if (event.button !== 0 || turning) return;
    corner = cornerAt(map, at(event));
    const chosen = tool.peek();
    if (corner >= 0 || chosen === "look" || chosen === "zone") return;
    if (editKind(chosen) !== null) {
      draftStroke.value = [mapPoint(at(event))];
      return;
    }
    anchor = mapPoint(at(event));
    draftPose.value = [anchor[0], anchor[1], defaultYaw(chosen)];
  });

  canvas.addEventListener("pointermove", (event) => {
    const before = fingers.get(event.pointerId);
    if (before === undefined) return;
    const here = at(event);
    if (fingers.size === 2) {
      const other = [...fingers.entries()].find(([id]) => id !== event.pointerId)![1];
      if (Math.hypot(here[0] - before[0], here[1] - before[1]) > 0) following.value = false;
      view.value = pinch(view.peek(), map.size, [before, other], [here, other]);
    } else if (turning) {
      const angle = (p: Point): number => Math.atan2(p[1] - map.middle[1], p[0] - map.middle[0]);
      view.value = rotateAt(view.peek(), map.size, map.middle, angle(before) - angle(here));
    } else if (corner >= 0) dragCorner(corner, mapPoint(here));
    else if (draftStroke.peek().length > 0) extendStroke(map, here);
    else if (anchor !== null) draftPose.value = draggedPose(map, anchor, here);
    else if (Math.hypot(here[0] - before[0], here[1] - before[1]) > 0) {
      following.value = false;
      view.value = panBy(view.peek(), map.size, here[0] - before[0], here[1] - before[1]);
    }
    fingers.set(event.pointerId, here);
  });

  let pressed: Point = [0, 0];
  canvas.addEventListener("pointerdown", (event) => (pressed = at(event)));
  canvas.addEventListener("pointerup", (event) => {
    const alone = fingers.size === 1;
    const here = at(event);
    const clicked = Math.hypot(here[0] - pressed[0], here[1] - pressed[1]) < MIN_DRAG_PX;
    fingers.delete(event.pointerId);
    const pose = draftPose.peek();
    if (alone && anchor !== null && pose !== null) finish(pose, !clicked);
    else if (alone && draftStroke.peek().length > 0) finishStroke(clicked);
    else if (alone && clicked && event.button === 0 && tool.peek() === "zone") addCorner(map, here);
    else if (alone && clicked && event.button === 0 && tool.peek() === "look") pickRobot(mapPoint(here));
    abort();
  });
  canvas.addEventListener("pointercancel", (event) => {
    fingers.delete(event.pointerId);
    abort();
  });
  canvas.addEventListener("dblclick", () => {
    if (tool.peek() === "zone") closePolygon();
  });
  canvas.addEventListener("contextmenu", (event) => event.preventDefault());
  canvas.addEventListener(
    "wheel",
    (event) => {
      event.preventDefault();
      const lines = event.deltaMode === 1 ? 16 : 1;
      map.zoom(Math.exp(-event.deltaY * lines * WHEEL_FACTOR * (event.ctrlKey ? 4 : 1)), at(event));
    },
    { passive: false },
  );
  canvas.addEventListener("keydown", (event) => onKey(map, event));
}

/** A press on another robot selects it. */
function pickRobot([x, y]: Point): void {
  const name = robotAt(othersOnMap.peek(), x, y, Math.max(ROBOT_REACH_M, ROBOT_REACH_PX / view.peek().scale));
  if (name !== null) selectRobot(name);
}

/** Keys while the map has the focus. The tool acts on the middle of the view. */
function onKey(map: MapView, event: KeyboardEvent): void {
  const [x, y] = toMap(view.peek(), map.size, map.middle);
  const pans: Record<string, Point> = { ArrowLeft: [1, 0], ArrowRight: [-1, 0], ArrowUp: [0, 1], ArrowDown: [0, -1] };
  const pan = pans[event.key];
  if (event.defaultPrevented) return; // an arrow that drives the robot
  if (pan !== undefined) map.pan(pan[0] * KEY_PAN_PX, pan[1] * KEY_PAN_PX);
  else if (event.key === "Enter" && tool.peek() === "zone") addCorner(map, map.middle);
  else if (event.key === "Enter" && editKind(tool.peek()) !== null) drawByKey([x, y]);
  else if (event.key === "Enter" && tool.peek() !== "look") finish([x, y, defaultYaw(tool.peek())], false);
  else return;
  event.preventDefault();
}

/** Keys of the whole page: zoom, turn, follow, leave a tool. */
export function onViewKey(map: MapView, event: KeyboardEvent): boolean {
  const actions: Record<string, () => void> = {
    "+": () => map.zoom(1.25),
    "=": () => map.zoom(1.25),
    "-": () => map.zoom(0.8),
    q: () => map.rotate(KEY_TURN_RAD),
    e: () => map.rotate(-KEY_TURN_RAD),
    f: () => (following.value = !following.peek()),
    Escape: cancelDrawing,
  };
  const action = actions[event.key];
  action?.();
  return action !== undefined;
}

function finish(pose: Pose, hasHeading: boolean): void {
  if (tool.peek() === "route") addWaypoint(pose);
  else void finishPose(tool.peek(), pose, hasHeading);
}

/** The eraser follows the pointer; a wall is straight, from where the press began. */
function extendStroke(map: MapView, here: Point): void {
  const stroke = draftStroke.peek();
  const point = toMap(view.peek(), map.size, here);
  const last = stroke[stroke.length - 1]!;
  if (tool.peek() === "wall") draftStroke.value = [stroke[0]!, point];
  else if (Math.hypot(point[0] - last[0], point[1] - last[1]) * view.peek().scale >= MIN_STROKE_STEP_PX) {
    draftStroke.value = [...stroke, point];
  }
}

/** Sends the edit that was drawn. A click erases a dot, and draws no wall. */
function finishStroke(clicked: boolean): void {
  const kind = editKind(tool.peek());
  const stroke = draftStroke.peek();
  draftStroke.value = [];
  if (kind === null || (kind === "wall" && clicked)) return;
  void addEdit(kind, clicked ? stroke.slice(0, 1) : stroke, strokeWidth(kind, view.peek().scale));
}

/** Enter erases a dot; with the wall it sets one end, and then the other. */
function drawByKey(point: Point): void {
  draftStroke.value = [...draftStroke.peek(), point];
  if (tool.peek() === "erase" || draftStroke.peek().length > 1) finishStroke(tool.peek() === "erase");
}

/** Heading of a pose that is clicked and not dragged: along the view. */
function defaultYaw(chosen: string): number {
  return chosen === "look" ? 0 : -view.peek().rotation;
}

function draggedPose(map: MapView, anchor: Point, here: Point): Pose {
  const start = toScreen(view.peek(), map.size, anchor);
  const [x, y] = toMap(view.peek(), map.size, here);
  const far = Math.hypot(here[0] - start[0], here[1] - start[1]) >= MIN_DRAG_PX;
  return [anchor[0], anchor[1], far ? Math.atan2(y - anchor[1], x - anchor[0]) : defaultYaw(tool.peek())];
}

function addCorner(map: MapView, here: Point): void {
  const corners = draftCorners.peek();
  const first = corners[0];
  if (first !== undefined && corners.length >= 3) {
    const [x, y] = toScreen(view.peek(), map.size, first);
    if (Math.hypot(here[0] - x, here[1] - y) < CORNER_PX) return closePolygon();
  }
  const corner = toMap(view.peek(), map.size, here);
  const last = corners[corners.length - 1];
  if (last && Math.hypot(corner[0] - last[0], corner[1] - last[1]) * view.peek().scale < 3) return; // a double click
  draftCorners.value = [...corners, corner];
}

function cornerAt(map: MapView, here: Point): number {
  return (editedZone.peek()?.corners ?? []).findIndex((corner) => {
    const [x, y] = toScreen(view.peek(), map.size, corner);
    return Math.hypot(here[0] - x, here[1] - y) < CORNER_PX;
  });
}

function dragCorner(index: number, to: Point): void {
  const zone = editedZone.peek();
  if (zone === null) return;
  editedZone.value = { ...zone, corners: zone.corners.map((corner, i) => (i === index ? to : corner)) };
}
