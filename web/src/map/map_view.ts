// SPDX-License-Identifier: Apache-2.0
// The map on two canvases: tiles below, all that moves above. Each is drawn only after something on it changed.

import { effect, signal } from "@preact/signals";

import { othersOnMap, selected } from "../fleet";
import { type Point } from "../geometry";
import { isDark, layers } from "../preferences";
import { link, mapId, now, replaying, replayStamp, shown as shownMessages } from "../state";
import { t } from "../texts";
import { TileAtlas } from "../tile_atlas";
import { type Tile, type TilesFrame, TileStore } from "../tile_store";
import { fit, panBy, rotateAt, toScreen, type Size, type View, zoomAt } from "../view_transform";
import { DRAW, drawRobot } from "./data_layers";
import { drawDrafts, drawEdits, drawGoal, drawGrid, drawPlaces, drawZoneNames, drawZones } from "./edit_layers";
import { drawFleet } from "./fleet_layer";
import { following } from "./following";
import { DARK, LIGHT } from "./palette";
import { Pen } from "./pen";
import { liveTrack, robotPose } from "./robot_pose";
import {
  closedPolygon,
  draftCorners,
  draftPose,
  draftStroke,
  editedZone,
  newPlace,
  places,
  route,
  tool,
} from "./tools";

const MIN_FRAME_MS = 30; // at most 33 frames a second
const START_SCALE = 45; // px/m, before a map is there
const FIT_MARGIN: Size = { width: 100, height: 140 }; // px: room for the status above and the tools below

export const view = signal<View>({ x: 0, y: 0, scale: START_SCALE, rotation: 0 });

/** A map with its bitmaps. */
class TileLayer {
  readonly store = new TileStore();
  readonly atlas = new TileAtlas(this.store, (isDark.peek() ? DARK : LIGHT).cells);
}

export class MapView {
  size: Size = { width: 1, height: 1 };
  private readonly live = new TileLayer();
  /** The map of the replay, null without one. */
  private replay: TileLayer | null = null;
  private viewBefore: View | null = null;
  private readonly below: CanvasRenderingContext2D;
  private readonly above: CanvasRenderingContext2D;
  private belowDirty = true;
  private aboveDirty = true;
  private changed: Tile[] = [];
  private fitted = false;
  private drawnAt = 0;
  private scheduled = false;

  constructor(
    private readonly tilesCanvas: HTMLCanvasElement,
    private readonly overlayCanvas: HTMLCanvasElement,
  ) {
    this.below = context(tilesCanvas);
    this.above = context(overlayCanvas);
    new ResizeObserver(() => this.resize()).observe(overlayCanvas);
    this.resize();
    effect(() => {
      const { cells } = isDark.value ? DARK : LIGHT;
      for (const layer of [this.live, this.replay]) layer?.atlas.recolor(cells);
      this.invalidate(true);
    });
    effect(() => {
      void view.value;
      this.invalidate(true);
    });
    effect(() => {
      for (const key of Object.values(shownMessages)) void key.value;
      for (const drawn of [tool, draftPose, draftCorners, draftStroke, closedPolygon, newPlace, places, route]) void drawn.value;
      void [othersOnMap.value, selected.value];
      void [following.value, layers.value, editedZone.value, link.value, now.value, replaying.value, replayStamp.value];
      this.invalidate(false);
    });
  }

  onTiles(frame: TilesFrame): void {
    const { store } = this.live;
    const reset = this.apply(this.live, frame);
    if (reset && mapId.peek() !== store.mapId) {
      liveTrack.trail = [];
      this.fitted = false;
    }
    if (reset) mapId.value = store.mapId;
    if (this.replay === null && !this.fitted && store.size > 0) this.fitted = this.fit();
  }

  /** From now on the map of a replay is shown, first of all the whole map. */
  beginReplay(): void {
    this.viewBefore ??= view.peek();
    this.replay = new TileLayer();
    this.fitted = false;
    this.invalidate(true);
  }

  onReplayTiles(frame: TilesFrame): void {
    if (this.replay === null) return;
    this.apply(this.replay, frame);
    if (!this.fitted && this.replay.store.size > 0) this.fitted = this.fit();
  }

  /** The live map is shown again, as it was seen before. */
  endReplay(): void {
    this.replay = null;
    if (this.viewBefore !== null) view.value = this.viewBefore;
    this.viewBefore = null;
    this.fitted = this.live.store.size > 0;
    this.invalidate(true);
  }

  private get shown(): TileLayer {
    return this.replay ?? this.live;
  }

  /** Stores and paints tiles. Returns whether the map of the layer began again. */
  private apply(layer: TileLayer, frame: TilesFrame): boolean {
    const { reset, changed } = layer.store.apply(frame);
    if (reset) layer.atlas.clear();
    for (const tile of changed) layer.atlas.paint(tile);
    if (layer === this.shown) {
      this.belowDirty ||= reset;
      this.changed.push(...changed);
      this.schedule();
    }
    return reset;
  }

  /** Shows the whole map. False while no cell is known. */
  fit(): boolean {
    const bounds = this.shown.store.bounds();
    if (bounds === null) return false;
    const { width, height } = this.size;
    const margin = { width: Math.min(FIT_MARGIN.width, width / 20), height: Math.min(FIT_MARGIN.height, height / 5) };
    view.value = fit(this.size, bounds[0], bounds[1], margin);
    return true;
  }

  zoom(factor: number, at: Point = this.middle): void {
    view.value = zoomAt(view.peek(), this.size, following.peek() ? this.middle : at, factor);
  }

  rotate(angle: number): void {
    view.value = rotateAt(view.peek(), this.size, this.middle, angle);
  }

  pan(dx: number, dy: number): void {
    following.value = false;
    view.value = panBy(view.peek(), this.size, dx, dy);
  }

  /** Moves a point of the map to the middle. */
  show(point: Point): void {
    following.value = false;
    view.value = { ...view.peek(), x: point[0], y: point[1] };
  }

  get middle(): Point {
    return [this.size.width / 2, this.size.height / 2];
  }

  private invalidate(tiles: boolean): void {
    this.belowDirty ||= tiles;
    this.aboveDirty = true;
    this.schedule();
  }

  private schedule(): void {
    if (this.scheduled) return;
    this.scheduled = true;
    requestAnimationFrame((at) => this.frame(at));
  }

  private frame(at: number): void {
    this.scheduled = false;
    if (at - this.drawnAt < MIN_FRAME_MS - 8) {
      this.schedule();
      return;
    }
    this.drawnAt = at;
    const pose = robotPose();
    const seen = view.peek();
    if (following.peek() && pose !== null && Math.hypot(pose[0] - seen.x, pose[1] - seen.y) * seen.scale > 0.5) {
      view.value = { ...seen, x: pose[0], y: pose[1] };
    }
    const complete = (!this.belowDirty && this.changed.length === 0) || this.drawTiles();
    if (this.aboveDirty) this.drawOverlay();
    this.belowDirty = !complete;
    this.aboveDirty = false;
    this.changed = [];
    if (!complete) this.schedule();
  }

  /** Draws all tiles, or only the rectangle around the changed ones. False while some wait for another frame. */
  private drawTiles(): boolean {
    const palette = isDark.peek() ? DARK : LIGHT;
    const { below, size } = this;
    below.save();
    if (!this.belowDirty) {
      below.beginPath();
      for (const { row, column } of this.changed) this.clipTile(row, column);
      below.clip();
    }
    below.fillStyle = palette.background;
    below.fillRect(0, 0, size.width, size.height);
    const complete = this.shown.atlas.draw(below, view.peek(), size);
    below.restore();
    return complete;
  }

  private clipTile(row: number, column: number): void {
    const { side } = this.shown.store;
    const corners: Point[] = [
      [column * side, row * side],
      [(column + 1) * side, row * side],
      [(column + 1) * side, (row + 1) * side],
      [column * side, (row + 1) * side],
    ];
    const screen = corners.map((corner) => toScreen(view.peek(), this.size, corner));
    const xs = screen.map((p) => p[0]);
    const ys = screen.map((p) => p[1]);
    const [x0, y0] = [Math.floor(Math.min(...xs)) - 1, Math.floor(Math.min(...ys)) - 1];
    this.below.rect(x0, y0, Math.ceil(Math.max(...xs)) + 1 - x0, Math.ceil(Math.max(...ys)) + 1 - y0);
  }

  private drawOverlay(): void {
    const { above, size } = this;
    above.clearRect(0, 0, size.width, size.height);
    const pen = new Pen(above, view.peek(), size, isDark.peek() ? DARK : LIGHT);
    const at = performance.now();
    const shown = new Set(layers.peek());
    if (shown.has("grid")) drawGrid(pen);
    if (shown.has("zones")) drawZones(pen);
    if (shown.has("walls")) drawEdits(pen);
    for (const [layer, draw] of Object.entries(DRAW)) {
      if (shown.has(layer as keyof typeof DRAW)) draw(pen, at);
    }
    if (shown.has("places") && !replaying.peek()) drawPlaces(pen);
    drawGoal(pen);
    if (shown.has("zones")) drawZoneNames(pen);
    if (!replaying.peek()) drawFleet(pen);
    drawRobot(pen, at, (age) => t("age_seconds", { n: age.toFixed(age < 10 ? 1 : 0) }));
    if (!replaying.peek()) drawDrafts(pen);
  }

  private resize(): void {
    const box = this.overlayCanvas.getBoundingClientRect();
    this.size = { width: Math.max(1, box.width), height: Math.max(1, box.height) };
    const ratio = Math.min(2, devicePixelRatio);
    for (const [canvas, target] of [
      [this.tilesCanvas, this.below],
      [this.overlayCanvas, this.above],
    ] as const) {
      canvas.width = Math.round(this.size.width * ratio);
      canvas.height = Math.round(this.size.height * ratio);
      target.setTransform(ratio, 0, 0, ratio, 0, 0);
    }
    if (!this.fitted) this.fitted = this.fit();
    this.invalidate(true);
  }
}

function context(canvas: HTMLCanvasElement): CanvasRenderingContext2D {
  const result = canvas.getContext("2d");
  if (result === null) throw new Error("this browser has no 2D canvas");
  return result;
}
