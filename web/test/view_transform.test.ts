// SPDX-License-Identifier: Apache-2.0
import assert from "node:assert/strict";
import { test } from "node:test";

import { compose, interpolate, transformPoint, type Point } from "../src/geometry";
import { fit, MAX_SCALE, panBy, pinch, rotateAt, toMap, toScreen, type View, visibleBounds, zoomAt } from "../src/view_transform";

const SIZE = { width: 800, height: 600 };
const VIEWS: View[] = [
  { x: 0, y: 0, scale: 50, rotation: 0 },
  { x: -12.5, y: 7.25, scale: 13, rotation: 0.7 },
  { x: 100, y: -40, scale: 300, rotation: -2.4 },
];
const POINTS: Point[] = [[0, 0], [400, 300], [799, 1], [123, 456]];

function near(a: readonly number[], b: readonly number[], tolerance = 1e-6): void {
  a.forEach((value, i) => assert.ok(Math.abs(value - b[i]!) < tolerance, `${String(a)} is not ${String(b)}`));
}

test("map and screen are inverse of each other", () => {
  for (const view of VIEWS) for (const p of POINTS) near(toScreen(view, SIZE, toMap(view, SIZE, p)), p);
});

test("x is right and y is up on a map that is not turned", () => {
  const view = VIEWS[0]!;
  near(toScreen(view, SIZE, [1, 0]), [450, 300]);
  near(toScreen(view, SIZE, [0, 1]), [400, 250]);
});

test("a positive rotation turns the map counter-clockwise", () => {
  near(toScreen({ ...VIEWS[0]!, rotation: Math.PI / 2 }, SIZE, [1, 0]), [400, 250]);
});

test("zoom and turn keep the map point under the finger", () => {
  for (const view of VIEWS) {
    for (const p of POINTS) {
      near(toMap(zoomAt(view, SIZE, p, 1.7), SIZE, p), toMap(view, SIZE, p));
      near(toMap(rotateAt(view, SIZE, p, 0.4), SIZE, p), toMap(view, SIZE, p));
    }
  }
});

test("zoom ends at the largest scale", () => {
  assert.equal(zoomAt(VIEWS[0]!, SIZE, [0, 0], 1e9).scale, MAX_SCALE);
});

test("a dragged point follows the pointer", () => {
  for (const view of VIEWS) near(toMap(panBy(view, SIZE, 30, -70), SIZE, [130, 230]), toMap(view, SIZE, [100, 300]));
});

test("two fingers keep their map points", () => {
  for (const view of VIEWS) {
    const before: [Point, Point] = [[200, 200], [400, 250]];
    const after: [Point, Point] = [[250, 180], [380, 330]];
    const moved = pinch(view, SIZE, before, after);
    if (moved.scale < MAX_SCALE) {
      near(toMap(moved, SIZE, after[0]), toMap(view, SIZE, before[0]), 1e-6);
      near(toMap(moved, SIZE, after[1]), toMap(view, SIZE, before[1]), 1e-6);
    }
  }
});

test("a fitted view shows both corners", () => {
  const view = fit(SIZE, [-3, 2], [27, 22], { width: 50, height: 50 });
  for (const corner of [[-3, 2], [27, 22]] as Point[]) {
    const [x, y] = toScreen(view, SIZE, corner);
    assert.ok(x >= 49 && x <= 751 && y >= 49 && y <= 551);
  }
});

test("visible bounds contain every corner of the screen", () => {
  for (const view of VIEWS) {
    const [x0, y0, x1, y1] = visibleBounds(view, SIZE);
    const [x, y] = toMap(view, SIZE, [800, 600]);
    assert.ok(x0 <= x + 1e-9 && x <= x1 + 1e-9 && y0 <= y + 1e-9 && y <= y1 + 1e-9);
  }
});

test("a pose between two turns the short way", () => {
  near(interpolate([0, 0, 3], [2, 4, -3], 0.5), [1, 2, Math.PI]);
  near(interpolate([0, 0, 3], [2, 4, -3], 0), [0, 0, 3]);
});

test("composing poses is applying both", () => {
  const a = [1, 2, 0.5] as const;
  const b = [-3, 0.25, 2.9] as const;
  near(transformPoint(compose(a, b), [0.3, 4]), transformPoint(a, transformPoint(b, [0.3, 4])));
});
