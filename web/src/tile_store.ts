// SPDX-License-Identifier: Apache-2.0
// The occupancy grid by tiles of 64 x 64 cells. It stores cells only; tile_atlas.ts paints them.

import type { Point } from "./geometry";

export const TILE_CELLS = 64; // a tile's side in cells, as TILE_CELLS of shared/messages.py
const CELLS = TILE_CELLS * TILE_CELLS;

/** The `tiles` frame of docs/page.md. */
export interface TilesFrame {
  readonly map_id: number;
  readonly resolution: number;
  readonly reset: boolean;
  readonly rows: readonly number[];
  readonly columns: readonly number[];
  readonly cells: Uint8Array;
}

export interface Tile {
  readonly row: number;
  readonly column: number;
  /** Row-major from the lower left corner: -1 unknown, 0 free .. 100 occupied. */
  readonly cells: Int8Array;
}

export class TileStore {
  /** m/cell; 0 before the first tile. */
  resolution = 0;
  mapId = 0;
  private readonly tiles = new Map<string, Tile>();

  /** Stores a frame's tiles. Returns whether the map began again; frames whose sizes do not fit are dropped. */
  apply(frame: TilesFrame): { reset: boolean; changed: Tile[] } {
    const n = frame.rows.length;
    if (frame.columns.length !== n || frame.cells.length !== n * CELLS) return { reset: false, changed: [] };
    const reset = frame.reset || frame.map_id !== this.mapId || frame.resolution !== this.resolution;
    if (reset) this.tiles.clear();
    this.mapId = frame.map_id;
    this.resolution = frame.resolution;
    const changed = frame.rows.map((row, i) => {
      const cells = new Int8Array(frame.cells.slice(i * CELLS, (i + 1) * CELLS).buffer);
      return { row, column: frame.columns[i]!, cells };
    });
    for (const tile of changed) this.tiles.set(`${tile.row},${tile.column}`, tile);
    return { reset, changed };
  }

  get size(): number {
    return this.tiles.size;
  }

  all(): Iterable<Tile> {
    return this.tiles.values();
  }

  tile(row: number, column: number): Tile | undefined {
    return this.tiles.get(`${row},${column}`);
  }

  /** A tile's side, m. */
  get side(): number {
    return TILE_CELLS * this.resolution;
  }

  /** Corners of the rectangle around the known cells, m, or null without any. */
  bounds(): [Point, Point] | null {
    let [x0, y0, x1, y1] = [Infinity, Infinity, -Infinity, -Infinity];
    for (const { row, column, cells } of this.tiles.values()) {
      if (!cells.some((cell) => cell >= 0)) continue;
      [x0, y0] = [Math.min(x0, column), Math.min(y0, row)];
      [x1, y1] = [Math.max(x1, column + 1), Math.max(y1, row + 1)];
    }
    if (x1 < x0) return null;
    return [
      [x0 * this.side, y0 * this.side],
      [x1 * this.side, y1 * this.side],
    ];
  }
}
