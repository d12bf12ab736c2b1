// SPDX-License-Identifier: Apache-2.0
// The view of the map: which point is in the middle of the screen, how large, and how it is turned.

import type { Point } from "./geometry";

export const MIN_SCALE = 1; // px/m: 819 m, the widest map, fit on a phone
export const MAX_SCALE = 800; // px/m: a cell of 5 cm is 40 px wide

/** `x`, `y`: map point in the middle, m. `scale`: px/m. `rotation`: rad that the map is turned counter-clockwise. */
export interface View {
  readonly x: number;
  readonly y: number;
  readonly scale: number;
  readonly rotation: number;
}

/** Size of the screen in CSS px. */
export interface Size {
  readonly width: number;
  readonly height: number;
}

/** The screen point (px, y down) of a map point (m). */
export function toScreen(view: View, size: Size, [x, y]: Point): Point {
  const c = Math.cos(view.rotation) * view.scale;
  const s = Math.sin(view.rotation) * view.scale;
  const dx = x - view.x;
  const dy = y - view.y;
  return [size.width / 2 + c * dx - s * dy, size.height / 2 - (s * dx + c * dy)];
}

/** The map point (m) of a screen point (px). */
export function toMap(view: View, size: Size, [px, py]: Point): Point {
  const u = (px - size.width / 2) / view.scale;
  const v = (size.height / 2 - py) / view.scale;
  const c = Math.cos(view.rotation);
  const s = Math.sin(view.rotation);
  return [view.x + c * u + s * v, view.y - s * u + c * v];
}

/** The view that shows map point `point` at screen point `at`. */
function pinned(view: View, size: Size, point: Point, at: Point): View {
  const [x, y] = toMap(view, size, at);
  return { ...view, x: view.x + point[0] - x, y: view.y + point[1] - y };
}

/** The view moved by (dx, dy) px, as by a hand on the paper. */
export function panBy(view: View, size: Size, dx: number, dy: number): View {
  const centre: Point = [size.width / 2, size.height / 2];
  return pinned(view, size, [view.x, view.y], [centre[0] + dx, centre[1] + dy]);
}

/** The view `factor` times larger; the map point at `at` (px) stays there. */
export function zoomAt(view: View, size: Size, at: Point, factor: number): View {
  const scale = Math.min(MAX_SCALE, Math.max(MIN_SCALE, view.scale * factor));
  return pinned({ ...view, scale }, size, toMap(view, size, at), at);
}

/** The view turned by `angle` rad counter-clockwise about the screen point `at`. */
export function rotateAt(view: View, size: Size, at: Point, angle: number): View {
  return pinned({ ...view, rotation: view.rotation + angle }, size, toMap(view, size, at), at);
}

/** The view after two fingers went from `before` to `after` (px): pan, zoom and turn in one. */
export function pinch(view: View, size: Size, before: readonly [Point, Point], after: readonly [Point, Point]): View {
  const span = (p: readonly [Point, Point]): Point => [p[1][0] - p[0][0], p[1][1] - p[0][1]];
  const middle = (p: readonly [Point, Point]): Point => [(p[0][0] + p[1][0]) / 2, (p[0][1] + p[1][1]) / 2];
  const [ax, ay] = span(before);
  const [bx, by] = span(after);
  const factor = Math.hypot(bx, by) / Math.max(1, Math.hypot(ax, ay));
  const angle = Math.atan2(ay, ax) - Math.atan2(by, bx);
  const held = toMap(view, size, middle(before));
  const scale = Math.min(MAX_SCALE, Math.max(MIN_SCALE, view.scale * factor));
  return pinned({ ...view, scale, rotation: view.rotation + angle }, size, held, middle(after));
}

/** The view that shows the rectangle `low` .. `high` (m), with a `margin` (px) on each side, not turned. */
export function fit(size: Size, low: Point, high: Point, margin: Size): View {
  const width = Math.max(1, high[0] - low[0]);
  const height = Math.max(1, high[1] - low[1]);
  const across = Math.max(80, size.width - 2 * margin.width) / width;
  const up = Math.max(80, size.height - 2 * margin.height) / height;
  const scale = Math.min(MAX_SCALE, Math.max(MIN_SCALE, Math.min(across, up)));
  return { x: (low[0] + high[0]) / 2, y: (low[1] + high[1]) / 2, scale, rotation: 0 };
}

/** Bounds in map coordinates of what the screen shows: [min x, min y, max x, max y], m. */
export function visibleBounds(view: View, size: Size): [number, number, number, number] {
  const corners = [
    [0, 0],
    [size.width, 0],
    [0, size.height],
    [size.width, size.height],
  ].map(([x, y]) => toMap(view, size, [x!, y!]));
  const xs = corners.map((c) => c[0]);
  const ys = corners.map((c) => c[1]);
  return [Math.min(...xs), Math.min(...ys), Math.max(...xs), Math.max(...ys)];
}
