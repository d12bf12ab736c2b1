// SPDX-License-Identifier: Apache-2.0
// A made-up office: walls, tiles of its map as far as it was seen, and rays of a laser in it. All in m.

export const RESOLUTION = 0.05;
const TILE = 64;

/** Rectangles [x0, y0, x1, y1]: walls, then furniture. */
const WALLS = [
  [0, 0, 30, 0.15], [0, 19.85, 30, 20], [0, 0, 0.15, 20], [29.85, 0, 30, 20],
  [0, 8, 4, 8.15], [5.2, 8, 12, 8.15], [13.2, 8, 20, 8.15], [21.2, 8, 26, 8.15], [27.2, 8, 30, 8.15],
  [0, 11, 3, 11.15], [4.2, 11, 10, 11.15], [11.2, 11, 19, 11.15], [20.2, 11, 30, 11.15],
  [8, 0, 8.15, 8], [16, 0, 16.15, 8], [23, 0, 23.15, 8], [7, 11, 7.15, 20], [15, 11, 15.15, 20], [24, 11, 24.15, 20],
  [1, 2, 3, 3], [5, 4, 6.5, 6], [10, 2, 12, 3], [13, 5, 14, 7], [18, 2, 20, 3.2], [25, 2, 28, 3.5],
  [2, 14, 4, 16], [9, 13, 12, 14.2], [17, 15, 21, 16], [26, 13, 28, 17],
];

export function occupied(x, y) {
  return WALLS.some(([x0, y0, x1, y1]) => x >= x0 && x <= x1 && y >= y0 && y <= y1);
}

/** Range of a ray from (x, y) at `angle`, m; Infinity beyond 12 m. */
export function ray(x, y, angle) {
  const [dx, dy] = [Math.cos(angle), Math.sin(angle)];
  let nearest = Infinity;
  for (const [x0, y0, x1, y1] of WALLS) {
    const near = Math.max(Math.min((x0 - x) / dx, (x1 - x) / dx), Math.min((y0 - y) / dy, (y1 - y) / dy));
    const far = Math.min(Math.max((x0 - x) / dx, (x1 - x) / dx), Math.max((y0 - y) / dy, (y1 - y) / dy));
    if (near > 0 && near <= far && near < nearest) nearest = near;
  }
  return nearest < 12 ? nearest : Infinity;
}

/** The tile (row, column): -1 unknown, 0 .. 100. Outside the office is unknown but for a strip along the walls. */
function tile(row, column, salt) {
  const cells = new Int8Array(TILE * TILE);
  for (let i = 0; i < TILE; i++) {
    for (let j = 0; j < TILE; j++) {
      const [x, y] = [(column * TILE + j + 0.5) * RESOLUTION, (row * TILE + i + 0.5) * RESOLUTION];
      const noise = Math.abs(Math.sin(x * 12.9898 + y * 78.233 + salt) * 43758.5453) % 1;
      const inside = x > 0 && y > 0 && x < 30 && y < 20;
      cells[i * TILE + j] = occupied(x, y) ? 90 + noise * 10 : inside && !(x > 24 && y > 17.4 + noise) ? noise * 3 : -1;
    }
  }
  return cells;
}

/** A `tiles` frame of these places. */
export function tilesFrame(places, reset, salt = 0) {
  return {
    t: "tiles",
    map_id: 1,
    resolution: RESOLUTION,
    reset,
    rows: places.map(([row]) => row),
    columns: places.map(([, column]) => column),
    cells: Buffer.concat(places.map(([row, column]) => Buffer.from(tile(row, column, salt).buffer))),
  };
}

export const ALL_TILES = Array.from({ length: 7 * 10 }, (_, i) => [Math.floor(i / 10), i % 10]);

/** A map of n x n cells of rooms, to see how fast large maps are drawn. */
export function* largeTiles(n) {
  const side = Math.ceil(n / TILE);
  for (let row = 0; row < side; row++) {
    const cells = Buffer.alloc(side * TILE * TILE);
    for (let i = 0; i < cells.length; i++) {
      const [x, y] = [i % TILE, Math.floor(i / TILE) % TILE];
      cells[i] = x < 3 || (y < 3 && x > 20) ? 100 : 2;
    }
    const columns = Array.from({ length: side }, (_, column) => column);
    yield { t: "tiles", map_id: 2, resolution: RESOLUTION, reset: row === 0, rows: columns.map(() => row), columns, cells };
  }
}
