// SPDX-License-Identifier: Apache-2.0
// Where the robot is on the map: the newest correction of the mapper with the newest odometry; and its trail.

import { compose, interpolate, type Point, type Pose } from "../geometry";
import { type Odometry } from "../messages";
import { type Robot } from "../protocol";
import { type RecordedRobot } from "../records";
import { hello, type Latest, latest, replayed, replaying } from "../state";

const MAX_ODOMETRY = 100; // 2 s at 50 Hz: longer than a scan is late
const TRAIL_STEP_M = 0.1;
const MAX_TRAIL = 5000; // 500 m
const MAX_JUMP_M = 1; // a longer step is a correction of the map, not a motion

/** The robot's track, live or of a replay. */
export class RobotTrack {
  trail: (Point | null)[] = [];
  private readonly odometry: Odometry[] = [];

  constructor(private readonly source: Latest) {}

  /** The newest pose `map_from_base`, or null before the first. */
  pose(): Pose | null {
    const pose = this.source.pose.peek()?.message;
    const odom = this.source.odom.peek()?.message;
    if (pose === undefined) return null;
    return odom === undefined ? pose.map_from_base : compose(pose.map_from_odom, odom.odom_from_base);
  }

  /** `map_from_base` at a stamp (ns), between the two samples of odometry around it. */
  poseAt(stamp: number): Pose | null {
    const { odometry } = this;
    const pose = this.source.pose.peek()?.message;
    if (pose === undefined) return null;
    const next = odometry.findIndex((sample) => sample.stamp >= stamp);
    const after = odometry[next < 0 ? odometry.length - 1 : next];
    const before = odometry[Math.max(0, (next < 0 ? odometry.length : next) - 1)];
    if (after === undefined || before === undefined) return pose.map_from_base;
    const span = after.stamp - before.stamp;
    const share = span > 0 ? Math.min(1, Math.max(0, (stamp - before.stamp) / span)) : 0;
    return compose(pose.map_from_odom, interpolate(before.odom_from_base, after.odom_from_base, share));
  }

  /** The newest odometry, which the trail follows. */
  add(message: Odometry): void {
    const last = this.odometry[this.odometry.length - 1];
    if (last !== undefined && message.stamp < last.stamp) this.odometry.length = 0; // another run of the stack
    this.odometry.push(message);
    if (this.odometry.length > MAX_ODOMETRY) this.odometry.shift();
    const pose = this.pose();
    if (pose !== null) this.extendTrail([pose[0], pose[1]]);
  }

  /** The odometry around a moment of a recording, and the trail until then. */
  set(odometry: readonly Odometry[], trail: readonly Point[]): void {
    this.odometry.splice(0, this.odometry.length, ...odometry);
    this.trail = [];
    for (const point of trail) this.extendTrail(point);
  }

  /** Adds a point; null marks a gap. */
  private extendTrail(point: Point): void {
    const { trail } = this;
    const last = trail[trail.length - 1] ?? null;
    const step = last === null ? Infinity : Math.hypot(point[0] - last[0], point[1] - last[1]);
    if (step < TRAIL_STEP_M) return;
    if (last !== null && step > MAX_JUMP_M) trail.push(null);
    trail.push(point);
    if (trail.length > MAX_TRAIL) trail.splice(0, trail.length - MAX_TRAIL);
  }
}

export const liveTrack = new RobotTrack(latest);
export const replayTrack = new RobotTrack(replayed);

let recordedRobot: RecordedRobot | null = null;

/** The robot of the recording that is replayed; null: that of today. */
export function setRecordedRobot(robot: RecordedRobot | null): void {
  recordedRobot = robot;
}

function shownTrack(): RobotTrack {
  return replaying.peek() ? replayTrack : liveTrack;
}

/** Outline and laser of the robot that is shown. */
export function shownRobot(): RecordedRobot | Robot | undefined {
  return (replaying.peek() ? recordedRobot : null) ?? hello.peek()?.robot;
}

export function robotPose(): Pose | null {
  return shownTrack().pose();
}

export function poseAt(stamp: number): Pose | null {
  return shownTrack().poseAt(stamp);
}

export function trail(): readonly (Point | null)[] {
  return shownTrack().trail;
}
