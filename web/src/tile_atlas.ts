// SPDX-License-Identifier: Apache-2.0
// Bitmaps of the map: chunks of 8 x 8 tiles, one pixel a cell, and an overview with one pixel for 4 x 4 cells.
// A map of 4000 x 4000 cells takes 64 chunks of 1 MB, and 4 MB of overviews.

import { TILE_CELLS, type Tile, type TileStore } from "./tile_store";
import { toScreen, visibleBounds, type Size, type View } from "./view_transform";

const CHUNK_TILES = 8;
const CHUNK_CELLS = CHUNK_TILES * TILE_CELLS;
const OVERVIEW_CELLS = 4; // cells that one pixel of the overview covers, each way
const MIN_FULL_SCALE = 0.4; // px a cell; smaller, the overview is drawn: thin walls stay visible

/** Colours of cells: index cell + 1, so unknown, then 0 .. 100; each is 0xAABBGGRR. */
export type CellColors = Uint32Array;

interface Chunk {
  readonly row: number;
  readonly column: number;
  readonly full: CanvasRenderingContext2D;
  readonly overview: CanvasRenderingContext2D;
}

export class TileAtlas {
  private readonly chunks = new Map<string, Chunk>();
  private readonly full = new ImageData(TILE_CELLS, TILE_CELLS);
  private readonly small = new ImageData(TILE_CELLS / OVERVIEW_CELLS, TILE_CELLS / OVERVIEW_CELLS);

  constructor(private colors: CellColors) {}

  clear(): void {
    this.chunks.clear();
  }

  /** Paints all tiles again in other colours. */
  recolor(colors: CellColors, store: TileStore): void {
    this.colors = colors;
    for (const tile of store.all()) this.paint(tile);
  }

  paint(tile: Tile): void {
    const row = Math.floor(tile.row / CHUNK_TILES);
    const column = Math.floor(tile.column / CHUNK_TILES);
    const chunk = this.chunk(row, column);
    const x = (tile.column - column * CHUNK_TILES) * TILE_CELLS;
    const y = CHUNK_CELLS - (tile.row - row * CHUNK_TILES + 1) * TILE_CELLS; // images grow downward
    paintCells(tile.cells, 1, this.colors, this.full);
    chunk.full.putImageData(this.full, x, y);
    paintCells(tile.cells, OVERVIEW_CELLS, this.colors, this.small);
    chunk.overview.putImageData(this.small, x / OVERVIEW_CELLS, y / OVERVIEW_CELLS);
  }

  /** Draws the chunks that the view shows. The context is in CSS px. Returns their number. */
  draw(context: CanvasRenderingContext2D, view: View, size: Size, resolution: number): number {
    const side = CHUNK_CELLS * resolution;
    const cellPx = view.scale * resolution;
    const [x0, y0, x1, y1] = visibleBounds(view, size);
    let n = 0;
    context.save();
    const [ox, oy] = toScreen(view, size, [0, 0]);
    const c = Math.cos(view.rotation) * cellPx;
    const s = Math.sin(view.rotation) * cellPx;
    context.transform(c, -s, s, c, ox, oy); // from cells (y down) to the screen
    context.imageSmoothingEnabled = cellPx < 1 || view.rotation % (Math.PI / 2) !== 0;
    for (const chunk of this.chunks.values()) {
      const [x, y] = [chunk.column * side, chunk.row * side];
      if (x > x1 || y > y1 || x + side < x0 || y + side < y0) continue;
      const source = cellPx < MIN_FULL_SCALE ? chunk.overview : chunk.full;
      context.drawImage(source.canvas, chunk.column * CHUNK_CELLS, -(chunk.row + 1) * CHUNK_CELLS, CHUNK_CELLS, CHUNK_CELLS);
      n++;
    }
    context.restore();
    return n;
  }

  private chunk(row: number, column: number): Chunk {
    const key = `${row},${column}`;
    let chunk = this.chunks.get(key);
    if (chunk === undefined) {
      chunk = { row, column, full: canvas(CHUNK_CELLS), overview: canvas(CHUNK_CELLS / OVERVIEW_CELLS) };
      this.chunks.set(key, chunk);
    }
    return chunk;
  }
}

/** Paints a tile; a pixel covers `step` x `step` cells and shows the most occupied one, so walls do not vanish. */
export function paintCells(cells: Int8Array, step: number, colors: CellColors, image: { data: Uint8ClampedArray }): void {
  const pixels = new Uint32Array(image.data.buffer);
  const n = TILE_CELLS / step;
  for (let row = 0; row < n; row++) {
    for (let column = 0; column < n; column++) {
      let highest = -1;
      for (let i = 0; i < step; i++) {
        for (let j = 0; j < step; j++) {
          highest = Math.max(highest, cells[(row * step + i) * TILE_CELLS + column * step + j]!);
        }
      }
      pixels[(n - 1 - row) * n + column] = colors[Math.min(highest, 100) + 1]!;
    }
  }
}

function canvas(side: number): CanvasRenderingContext2D {
  const element = document.createElement("canvas");
  element.width = element.height = side;
  const context = element.getContext("2d");
  if (context === null) throw new Error("this browser has no 2D canvas");
  return context;
}
