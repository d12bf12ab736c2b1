// SPDX-License-Identifier: Apache-2.0
// Where the robot is on the map: the newest correction of the mapper with the newest odometry; and its trail.

import { compose, interpolate, type Point, type Pose } from "../geometry";
import { type Odometry } from "../messages";
import { latest } from "../state";

const MAX_ODOMETRY = 100; // 2 s at 50 Hz: longer than a scan is late
const TRAIL_STEP_M = 0.1;
const MAX_TRAIL = 5000; // 500 m
const MAX_JUMP_M = 1; // a longer step is a correction of the map, not a motion

const odometry: Odometry[] = [];
export const trail: (Point | null)[] = [];

/** The newest pose `map_from_base`, or null before the first. */
export function robotPose(): Pose | null {
  const pose = latest.pose.peek()?.message;
  const odom = latest.odom.peek()?.message;
  if (pose === undefined) return null;
  return odom === undefined ? pose.map_from_base : compose(pose.map_from_odom, odom.odom_from_base);
}

/** `map_from_base` at a stamp (ns), between the two samples of odometry around it. */
export function poseAt(stamp: number): Pose | null {
  const pose = latest.pose.peek()?.message;
  if (pose === undefined) return null;
  const next = odometry.findIndex((sample) => sample.stamp >= stamp);
  const after = odometry[next < 0 ? odometry.length - 1 : next];
  const before = odometry[Math.max(0, (next < 0 ? odometry.length : next) - 1)];
  if (after === undefined || before === undefined) return pose.map_from_base;
  const span = after.stamp - before.stamp;
  const share = span > 0 ? Math.min(1, Math.max(0, (stamp - before.stamp) / span)) : 0;
  return compose(pose.map_from_odom, interpolate(before.odom_from_base, after.odom_from_base, share));
}

export function onOdometry(message: Odometry): void {
  const last = odometry[odometry.length - 1];
  if (last !== undefined && message.stamp < last.stamp) odometry.length = 0; // another run of the stack
  odometry.push(message);
  if (odometry.length > MAX_ODOMETRY) odometry.shift();
  const pose = robotPose();
  if (pose !== null) extendTrail([pose[0], pose[1]]);
}

export function clearTrail(): void {
  trail.length = 0;
}

/** Adds a point; null marks a gap. */
function extendTrail(point: Point): void {
  const last = trail[trail.length - 1] ?? null;
  const step = last === null ? Infinity : Math.hypot(point[0] - last[0], point[1] - last[1]);
  if (step < TRAIL_STEP_M) return;
  if (last !== null && step > MAX_JUMP_M) trail.push(null);
  trail.push(point);
  if (trail.length > MAX_TRAIL) trail.splice(0, trail.length - MAX_TRAIL);
}
