// SPDX-License-Identifier: Apache-2.0
import assert from "node:assert/strict";
import { test } from "node:test";

import { paintCells } from "../src/tile_atlas";
import { TILE_CELLS, TileStore, type TilesFrame } from "../src/tile_store";

const CELLS = TILE_CELLS * TILE_CELLS;

function frame(places: readonly (readonly [number, number, number])[], rest: Partial<TilesFrame> = {}): TilesFrame {
  const cells = new Uint8Array(places.length * CELLS);
  places.forEach(([, , value], i) => cells.fill(value & 255, i * CELLS, (i + 1) * CELLS));
  const [rows, columns] = [places.map((p) => p[0]), places.map((p) => p[1])];
  return { map_id: 1, resolution: 0.05, reset: false, rows, columns, cells, ...rest };
}

test("a tile replaces the one at its place", () => {
  const store = new TileStore();
  store.apply(frame([[0, 0, 10], [-1, 2, 20]]));
  const { changed, reset } = store.apply(frame([[-1, 2, 99]]));
  assert.equal(reset, false);
  assert.equal(changed.length, 1);
  assert.equal(store.size, 2);
  assert.equal(store.tile(-1, 2)?.cells[17], 99);
  assert.equal(store.tile(0, 0)?.cells[CELLS - 1], 10);
});

test("unknown cells are -1", () => {
  const store = new TileStore();
  store.apply(frame([[0, 0, -1]]));
  assert.equal(store.tile(0, 0)?.cells[5], -1);
  assert.equal(store.bounds(), null);
});

test("reset, another map and another resolution begin again", () => {
  for (const change of [{ reset: true }, { map_id: 2 }, { resolution: 0.1 }]) {
    const store = new TileStore();
    store.apply(frame([[0, 0, 1], [1, 1, 1]]));
    assert.equal(store.apply(frame([[5, 5, 1]], change)).reset, true);
    assert.equal(store.size, 1);
  }
});

test("a frame whose bytes do not fit its places changes nothing", () => {
  const store = new TileStore();
  store.apply(frame([[0, 0, 1]]));
  assert.equal(store.apply({ ...frame([[1, 1, 1]]), cells: new Uint8Array(7) }).changed.length, 0);
  assert.equal(store.apply({ ...frame([[1, 1, 1]]), columns: [] }).changed.length, 0);
  assert.equal(store.size, 1);
});

test("bounds are of the tiles with known cells", () => {
  const store = new TileStore();
  store.apply(frame([[0, 0, 0], [2, -1, 50], [9, 9, -1]]));
  const [low, high] = store.bounds()!;
  assert.deepEqual([...low, ...high].map((value) => Math.round(value * 100) / 100), [-3.2, 0, 3.2, 9.6]);
});

test("the overview shows a thin wall, with row 0 at the bottom", () => {
  const cells = new Int8Array(CELLS);
  cells[0 * TILE_CELLS + 6] = 100; // row 0, column 6
  const colors = new Uint32Array(102).map((_, i) => i);
  const image = { data: new Uint8ClampedArray(16 * 16 * 4) };
  paintCells(cells, 4, colors, image);
  const pixels = new Uint32Array(image.data.buffer);
  assert.equal(pixels[15 * 16 + 1], 101);
  assert.equal(pixels.filter((pixel) => pixel === 101).length, 1);
});
