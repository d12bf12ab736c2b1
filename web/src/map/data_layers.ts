// SPDX-License-Identifier: Apache-2.0
// Layers of what the robot measures and plans: scan, trail, plan, rollouts, costmap, people, robot.

import { interpolate, transformPoint, type Point, type Pose } from "../geometry";
import { isShownOld, shown, shownAge } from "../state";
import { type Layer } from "../preferences";
import { type Pen, points } from "./pen";
import { poseAt, robotPose, shownRobot, trail } from "./robot_pose";

export function drawTrail(pen: Pen): void {
  pen.trace(trail());
  pen.stroke(pen.palette.trail, 2);
}

export function drawPlan(pen: Pen, now: number): void {
  const plan = shown.plan.peek()?.message;
  if (plan === undefined || plan.xs.length < 2 || shown.goal.peek()?.message.active === false) return;
  pen.trace(points(plan.xs, plan.ys));
  pen.stroke(pen.palette.labelBack, 6);
  pen.stroke(isShownOld("plan", now) ? pen.palette.old : pen.palette.plan, 3);
}

export function drawScan(pen: Pen, now: number): void {
  drawScanOf("scan", shownRobot()?.laser_mount, pen, now);
  drawScanOf("scan_2", shownRobot()?.laser_2_mount, pen, now);
}

function drawScanOf(key: "scan" | "scan_2", mount: Pose | undefined, pen: Pen, now: number): void {
  const scan = shown[key].peek()?.message;
  if (scan === undefined || mount === undefined || isShownOld(key, now) || isShownOld("pose", now)) return;
  const first = poseAt(scan.stamp);
  const last = poseAt(scan.stamp + scan.scan_time * 1e9);
  if (first === null || last === null) return;
  const { context } = pen;
  context.fillStyle = pen.palette.scan;
  const side = pen.view.scale > 60 ? 3 : 2;
  for (let i = 0; i < scan.ranges.length; i++) {
    const range = scan.ranges[i]!;
    if (!(range >= scan.range_min && range <= scan.range_max)) continue;
    const angle = scan.angle_min + i * scan.angle_increment;
    const inBase = transformPoint(mount, [range * Math.cos(angle), range * Math.sin(angle)]);
    const mapFromBase = interpolate(first, last, i / scan.ranges.length); // each beam from where the robot was
    const [x, y] = pen.screen(transformPoint(mapFromBase, inBase));
    context.fillRect(x - side / 2, y - side / 2, side, side);
  }
}

export function drawRollouts(pen: Pen, now: number): void {
  const rollouts = shown["debug/rollouts"].peek()?.message;
  const pose = shown.pose.peek()?.message;
  if (rollouts === undefined || pose === undefined || isShownOld("debug/rollouts", now)) return;
  const { rows, columns, values: xs } = rollouts.xs;
  const ys = rollouts.ys.values;
  for (let row = rows - 1; row >= 0; row--) {
    const line: Point[] = [];
    for (let i = row * columns; i < (row + 1) * columns; i++) {
      line.push(transformPoint(pose.map_from_odom, [xs[i]!, ys[i]!]));
    }
    pen.trace(line);
    pen.context.globalAlpha = row === 0 ? 1 : 0.22;
    pen.stroke(row === 0 ? pen.palette.chosen : pen.palette.plan, row === 0 ? 3 : 1);
    pen.context.globalAlpha = 1;
  }
}

/** Keyframes, and the loop closures between them: rejected ones are dashed. */
export function drawClosures(pen: Pen, now: number): void {
  const graph = shown["debug/graph"].peek()?.message;
  if (graph === undefined || isShownOld("debug/graph", now)) return;
  const [from, to] = [[...points(graph.from_xs, graph.from_ys)], [...points(graph.to_xs, graph.to_ys)]];
  const lines: [rejected: (Point | null)[], accepted: (Point | null)[]] = [[], []];
  from.forEach((place, i) => lines[graph.accepted[i] === 1 ? 1 : 0].push(place, to[i]!, null));
  pen.trace(lines[1]);
  pen.stroke(pen.palette.chosen, 1.5);
  pen.trace(lines[0]);
  pen.stroke(pen.palette.keepOut, 1.5, [4, 4]);
  const { context } = pen;
  context.fillStyle = pen.palette.trail;
  for (const place of points(graph.xs, graph.ys)) {
    const [x, y] = pen.screen(place);
    context.fillRect(x - 1.5, y - 1.5, 3, 3);
  }
}

let costmapImage: { message: object; canvas: HTMLCanvasElement } | null = null;

export function drawCostmap(pen: Pen, now: number): void {
  const costmap = shown["debug/costmap"].peek()?.message;
  const pose = shown.pose.peek()?.message;
  if (costmap === undefined || pose === undefined || isShownOld("debug/costmap", now)) return;
  const { rows, columns, values } = costmap.cells;
  if (costmapImage?.message !== costmap) {
    const canvas = costmapImage?.canvas ?? document.createElement("canvas");
    canvas.width = columns;
    canvas.height = rows;
    const context = canvas.getContext("2d");
    if (context === null) return;
    const image = context.createImageData(columns, rows);
    for (let i = 0; i < values.length; i++) {
      const row = rows - 1 - Math.floor(i / columns); // images grow downward
      paintCost(image.data, row * columns + (i % columns), values[i]!);
    }
    context.putImageData(image, 0, 0);
    costmapImage = { message: costmap, canvas };
  }
  const { context } = pen;
  const [x, y] = pen.screen(transformPoint(pose.map_from_odom, [costmap.x, costmap.y]));
  const px = pen.view.scale * costmap.resolution;
  context.save();
  context.translate(x, y);
  context.rotate(-(pose.map_from_odom[2] + pen.view.rotation));
  context.imageSmoothingEnabled = false;
  context.globalAlpha = 0.6;
  context.drawImage(costmapImage.canvas, 0, -rows * px, columns * px, rows * px);
  context.restore();
}

/** A pixel of the costmap: transparent where free, orange by cost, vermillion where the robot would touch. */
function paintCost(data: Uint8ClampedArray, i: number, cost: number): void {
  if (cost <= 0) return;
  data[4 * i] = cost >= 99 ? 213 : 230;
  data[4 * i + 1] = cost >= 99 ? 94 : 159;
  data[4 * i + 2] = 0;
  data[4 * i + 3] = cost >= 99 ? 230 : Math.round(30 + cost * 1.6);
}

/** People and the true pose, in simulation. */
export function drawTruth(pen: Pen, now: number): void {
  const truth = shown["sim/truth"].peek()?.message;
  const outline = shownRobot()?.outline;
  if (truth === undefined || outline === undefined || isShownOld("sim/truth", now)) return;
  const [x, y, yaw] = truth.start;
  const c = Math.cos(yaw);
  const s = Math.sin(yaw);
  const inMap = (p: Point): Point => [c * (p[0] - x) + s * (p[1] - y), -s * (p[0] - x) + c * (p[1] - y)];
  for (const person of points(truth.people_x, truth.people_y)) {
    pen.disc(inMap(person), Math.max(4, 0.25 * pen.view.scale));
    pen.fill(pen.palette.people, 0.75);
    pen.stroke(pen.palette.labelBack, 1.5);
  }
  pen.trace(outline.map((corner) => inMap(transformPoint(truth.world_from_base, corner))), true);
  pen.stroke(pen.palette.truth, 1.5, [4, 4]);
}

export function drawRobot(pen: Pen, now: number, ageText: (seconds: number) => string): void {
  const pose = robotPose();
  const outline = shownRobot()?.outline;
  if (pose === null || outline === undefined) return;
  const old = isShownOld("pose", now);
  const color = old ? pen.palette.old : pen.palette.robot;
  const at: Point = [pose[0], pose[1]];
  const radius = Math.max(...outline.map(([x, y]) => Math.hypot(x, y))) * pen.view.scale;
  if (radius < 9) drawMarker(pen, pose, color);
  else {
    pen.trace(outline.map((corner) => transformPoint(pose, corner)), true);
    pen.fill(color, old ? 0.35 : 0.92);
    pen.stroke(pen.palette.robotEdge, 2);
    const nose = Math.max(...outline.map(([x]) => x));
    const chevron: Point[] = [
      [0, nose * 0.45],
      [nose * 0.7, 0],
      [0, -nose * 0.45],
    ];
    pen.trace(chevron.map((point) => transformPoint(pose, point)));
    pen.stroke(pen.palette.robotEdge, 2.5);
  }
  const age = shownAge("pose", now) ?? 0;
  if (old) pen.label(at, ageText(age), Math.max(radius, 9) + 18);
}

/** The robot where its outline would be too small to see. */
function drawMarker(pen: Pen, pose: Pose, color: string): void {
  const [x, y] = pen.screen([pose[0], pose[1]]);
  const { context } = pen;
  context.save();
  context.translate(x, y);
  context.rotate(-(pose[2] + pen.view.rotation));
  context.beginPath();
  context.moveTo(12, 0);
  context.lineTo(-8, 8);
  context.lineTo(-4, 0);
  context.lineTo(-8, -8);
  context.closePath();
  pen.stroke(pen.palette.robotEdge, 4);
  pen.fill(color);
  context.restore();
}

export const DRAW: Partial<Record<Layer, (pen: Pen, now: number) => void>> = {
  costmap: drawCostmap,
  closures: drawClosures,
  trail: drawTrail,
  rollouts: drawRollouts,
  plan: drawPlan,
  scan: drawScan,
  people: drawTruth,
};
