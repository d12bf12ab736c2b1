// SPDX-License-Identifier: Apache-2.0
// Drawing in map coordinates on a canvas in CSS px: paths in m, widths and radii in px.

import { type Point, type Pose } from "../geometry";
import { toScreen, type Size, type View } from "../view_transform";
import { type Palette } from "./palette";

export class Pen {
  /** Plates of the labels so far: [left, top, right, bottom], px. */
  private readonly plates: [number, number, number, number][] = [];

  constructor(
    readonly context: CanvasRenderingContext2D,
    readonly view: View,
    readonly size: Size,
    readonly palette: Palette,
  ) {}

  screen(point: Point): Point {
    return toScreen(this.view, this.size, point);
  }

  /** A path through points of the map; null lifts the pen. */
  trace(points: Iterable<Point | null>, closed = false): void {
    const { context } = this;
    context.beginPath();
    let down = false;
    for (const point of points) {
      if (point === null) down = false;
      else {
        const [x, y] = this.screen(point);
        if (down) context.lineTo(x, y);
        else context.moveTo(x, y);
        down = true;
      }
    }
    if (closed) context.closePath();
  }

  stroke(color: string, width: number, dash: number[] = []): void {
    const { context } = this;
    context.strokeStyle = color;
    context.lineWidth = width;
    context.lineJoin = context.lineCap = "round";
    context.setLineDash(dash);
    context.stroke();
    context.setLineDash([]);
  }

  fill(color: string, alpha = 1): void {
    const { context } = this;
    context.globalAlpha = alpha;
    context.fillStyle = color;
    context.fill();
    context.globalAlpha = 1;
  }

  disc(point: Point, radius: number): void {
    const [x, y] = this.screen(point);
    this.context.beginPath();
    this.context.arc(x, y, radius, 0, 2 * Math.PI);
  }

  /** An arrow from a pose along its heading, `length` px. */
  arrow(pose: Pose, length: number, color: string): void {
    const { context } = this;
    const [x, y] = this.screen([pose[0], pose[1]]);
    const angle = -(pose[2] + this.view.rotation);
    context.save();
    context.translate(x, y);
    context.rotate(angle);
    context.beginPath();
    context.moveTo(0, 0);
    context.lineTo(length - 8, 0);
    this.stroke(this.palette.labelBack, 6);
    this.stroke(color, 3);
    context.beginPath();
    context.moveTo(length, 0);
    context.lineTo(length - 12, -7);
    context.lineTo(length - 12, 7);
    context.closePath();
    this.stroke(this.palette.labelBack, 3);
    this.fill(color);
    context.restore();
    context.beginPath();
    context.arc(x, y, 6, 0, 2 * Math.PI);
    this.stroke(this.palette.labelBack, 4);
    this.fill(color);
  }

  /** Text on a plate, its middle `dy` px below the point; left out where it would cover an earlier label. */
  label(point: Point, text: string, dy: number, color = this.palette.label): void {
    const { context } = this;
    const [x, y] = this.screen(point);
    context.font = "500 12px Inter, system-ui, sans-serif";
    context.textAlign = "center";
    context.textBaseline = "middle";
    const half = context.measureText(text).width / 2 + 6;
    const plate: [number, number, number, number] = [x - half, y + dy - 10, x + half, y + dy + 10];
    const covers = ([x0, y0, x1, y1]: readonly number[]): boolean =>
      x0! < plate[2] && x1! > plate[0] && y0! < plate[3] && y1! > plate[1];
    if (this.plates.some(covers)) return;
    this.plates.push(plate);
    context.beginPath();
    context.roundRect(x - half, y + dy - 10, 2 * half, 20, 5);
    this.fill(this.palette.labelBack);
    context.fillStyle = color;
    context.fillText(text, x, y + dy + 0.5);
  }
}

/** Points of two arrays of coordinates. */
export function* points(xs: ArrayLike<number>, ys: ArrayLike<number>): Generator<Point> {
  for (let i = 0; i < xs.length; i++) yield [xs[i]!, ys[i]!];
}

/** The middle of a polygon's corners. */
export function centre(corners: readonly Point[]): Point {
  const n = Math.max(1, corners.length);
  return [corners.reduce((sum, c) => sum + c[0], 0) / n, corners.reduce((sum, c) => sum + c[1], 0) / n];
}
