// SPDX-License-Identifier: Apache-2.0
// Bitmaps of the map in chunks of 8 x 8 tiles: an overview with one pixel for 4 x 4 cells of every chunk, and one pixel
// a cell of the chunks that were shown last. So a map of 4000 x 4000 cells takes some 40 MB and not 64.

import { TILE_CELLS, type Tile, type TileStore } from "./tile_store";
import { toScreen, visibleBounds, type Size, type View } from "./view_transform";

const CHUNK_TILES = 8;
const CHUNK_CELLS = CHUNK_TILES * TILE_CELLS;
const OVERVIEW_CELLS = 4; // cells that one pixel of the overview covers, each way
const MIN_FULL_SCALE = 0.5; // px a cell; smaller, the overview is drawn: thin walls stay visible
const MAX_FULL_CHUNKS = 8; // of 1 MB each that are stored, beside those on the screen
const MAX_PAINTED_CHUNKS = 4; // in one frame, some 2 ms each; the others show their overview until the next frame

/** Colours of cells: index cell + 1, so unknown, then 0 .. 100; each is 0xAABBGGRR. */
export type CellColors = Uint32Array;

interface Chunk {
  readonly row: number;
  readonly column: number;
  readonly overview: CanvasRenderingContext2D;
  /** One pixel a cell; null where it was not shown for long. */
  full: CanvasRenderingContext2D | null;
  /** Number of the frame that drew it in full. */
  shown: number;
}

export class TileAtlas {
  private readonly chunks = new Map<string, Chunk>();
  /** Bitmaps that no chunk needs. A browser frees the memory of a canvas late, so none is thrown away. */
  private readonly spare: CanvasRenderingContext2D[] = [];
  private readonly cellImage = new ImageData(TILE_CELLS, TILE_CELLS);
  private readonly overviewImage = new ImageData(TILE_CELLS / OVERVIEW_CELLS, TILE_CELLS / OVERVIEW_CELLS);
  private frame = 0;

  constructor(
    private readonly store: TileStore,
    private colors: CellColors,
  ) {}

  clear(): void {
    for (const chunk of this.chunks.values()) this.empty(chunk);
    this.chunks.clear();
  }

  /** Paints all tiles again in other colours. */
  recolor(colors: CellColors): void {
    this.colors = colors;
    for (const tile of this.store.all()) this.paint(tile);
  }

  /** Paints a tile that is new or changed. */
  paint(tile: Tile): void {
    const chunk = this.chunk(Math.floor(tile.row / CHUNK_TILES), Math.floor(tile.column / CHUNK_TILES));
    this.put(chunk, tile, chunk.overview, OVERVIEW_CELLS, this.overviewImage);
    if (chunk.full !== null) this.put(chunk, tile, chunk.full, 1, this.cellImage);
  }

  /** Draws the chunks that the view shows, on a context in CSS px. False while some wait for another frame. */
  draw(context: CanvasRenderingContext2D, view: View, size: Size): boolean {
    const resolution = this.store.resolution || 1;
    const side = CHUNK_CELLS * resolution;
    const cellPx = view.scale * resolution;
    const [x0, y0, x1, y1] = visibleBounds(view, size);
    let painted = 0;
    let waiting = 0;
    this.frame++;
    context.save();
    const [ox, oy] = toScreen(view, size, [0, 0]);
    const c = Math.cos(view.rotation) * cellPx;
    const s = Math.sin(view.rotation) * cellPx;
    context.transform(c, -s, s, c, ox, oy); // from cells (y down) to the screen
    context.imageSmoothingEnabled = cellPx < 1 || view.rotation % (Math.PI / 2) !== 0;
    for (const chunk of this.chunks.values()) {
      const [x, y] = [chunk.column * side, chunk.row * side];
      if (x > x1 || y > y1 || x + side < x0 || y + side < y0) continue;
      let source = chunk.overview;
      if (cellPx >= MIN_FULL_SCALE) {
        if (chunk.full === null && painted < MAX_PAINTED_CHUNKS) {
          this.fill(chunk);
          painted++;
        }
        chunk.shown = this.frame;
        if (chunk.full === null) waiting++;
        else source = chunk.full;
      }
      context.drawImage(source.canvas, chunk.column * CHUNK_CELLS, -(chunk.row + 1) * CHUNK_CELLS, CHUNK_CELLS, CHUNK_CELLS);
    }
    context.restore();
    this.evict();
    return waiting === 0;
  }

  private chunk(row: number, column: number): Chunk {
    const key = `${row},${column}`;
    let chunk = this.chunks.get(key);
    if (chunk === undefined) {
      chunk = { row, column, overview: canvas(CHUNK_CELLS / OVERVIEW_CELLS), full: null, shown: 0 };
      this.chunks.set(key, chunk);
    }
    return chunk;
  }

  /** Paints all tiles of a chunk, one pixel a cell. */
  private fill(chunk: Chunk): void {
    chunk.full = this.spare.pop() ?? canvas(CHUNK_CELLS);
    for (let i = 0; i < CHUNK_TILES * CHUNK_TILES; i++) {
      const row = chunk.row * CHUNK_TILES + Math.floor(i / CHUNK_TILES);
      const tile = this.store.tile(row, chunk.column * CHUNK_TILES + (i % CHUNK_TILES));
      if (tile !== undefined) this.put(chunk, tile, chunk.full, 1, this.cellImage);
    }
  }

  private put(chunk: Chunk, tile: Tile, target: CanvasRenderingContext2D, step: number, image: ImageData): void {
    const x = (tile.column - chunk.column * CHUNK_TILES) * TILE_CELLS;
    const y = CHUNK_CELLS - (tile.row - chunk.row * CHUNK_TILES + 1) * TILE_CELLS; // images grow downward
    paintCells(tile.cells, step, this.colors, image);
    target.putImageData(image, x / step, y / step);
  }

  /** Drops the full bitmaps that were not shown for longest. */
  private evict(): void {
    const hidden = [...this.chunks.values()].filter((chunk) => chunk.full !== null && chunk.shown < this.frame);
    hidden.sort((a, b) => a.shown - b.shown);
    for (const chunk of hidden.slice(0, Math.max(0, hidden.length - MAX_FULL_CHUNKS))) this.empty(chunk);
  }

  /** Takes a chunk's full bitmap. */
  private empty(chunk: Chunk): void {
    if (chunk.full === null) return;
    chunk.full.clearRect(0, 0, CHUNK_CELLS, CHUNK_CELLS);
    this.spare.push(chunk.full);
    chunk.full = null;
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
