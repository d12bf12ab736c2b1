// SPDX-License-Identifier: Apache-2.0
import "./browser_globals";

import assert from "node:assert/strict";
import { test } from "node:test";

import { type Point } from "../src/geometry";
import { mapEdits, strokeWidth, thinned } from "../src/map/map_edits";
import { places, setPlaces } from "../src/map/tools";
import { type MapState } from "../src/messages";
import { latest, mapId, mapName } from "../src/state";

const line = (n: number): Point[] => Array.from({ length: n }, (_, i): Point => [i, -i]);

function publish(state: Omit<MapState, "stamp">): void {
  (latest["map/state"] as { value: unknown }).value = { message: { stamp: 0, ...state }, at: 0 };
}

test("a long stroke is thinned to what one edit may have, with both ends", () => {
  assert.deepEqual(thinned(line(256)), line(256));
  for (const n of [257, 1000, 5001]) {
    const points = thinned(line(n));
    assert.ok(points.length <= 256 && points.length > 100, String(points.length));
    assert.deepEqual([points[0], points.at(-1)], [line(n)[0], line(n).at(-1)]);
  }
});

test("the eraser is as wide as a finger, and no wider than an edit may be", () => {
  assert.equal(strokeWidth("erase", 48), 0.5);
  assert.equal(strokeWidth("erase", 1), 5);
  assert.equal(strokeWidth("wall", 1), 0.1);
});

test("edits and name of another map do not count", () => {
  const edit = { stamp: 0, id: 3, kind: "wall", xs: new Float64Array([0, 1]), ys: new Float64Array([0, 1]), width: 0.1 } as const;
  publish({ map_id: 7, name: "office", edits: [edit] });
  mapId.value = 8;
  assert.deepEqual([mapEdits().length, mapName.value], [0, ""]);
  mapId.value = 7;
  assert.deepEqual([mapEdits().length, mapName.value], [1, "office"]);
});

test("on a map with a name the places of other maps are left out", () => {
  const place = (name: string, map: string) => ({ name, map, pose: [0, 0, 0] as const, hasHeading: true });
  setPlaces([place("a", ""), place("b", "office"), place("c", "lab")]);
  mapId.value = 7;
  publish({ map_id: 7, name: "office", edits: [] });
  assert.deepEqual(places.value.map(({ name }) => name), ["a", "b"]);
  publish({ map_id: 7, name: "", edits: [] });
  assert.equal(places.value.length, 3);
});
