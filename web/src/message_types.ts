// SPDX-License-Identifier: Apache-2.0
// The messages that the page reads, as docs/messages.md lists them. Stamps are ns, lengths m, angles rad.

import type { Pose } from "./geometry";

interface Message {
  readonly stamp: number;
}

export interface LaserScan extends Message {
  readonly angle_min: number;
  readonly angle_increment: number;
  readonly scan_time: number;
  readonly range_min: number;
  readonly range_max: number;
  readonly ranges: Float32Array;
}

export interface Odometry extends Message {
  readonly odom_from_base: Pose;
  readonly v: number;
  readonly w: number;
}

export interface PoseEstimate extends Message {
  readonly map_from_base: Pose;
  readonly map_from_odom: Pose;
  readonly covariance: Float64Array;
  readonly quality: number;
  readonly state: "starting" | "good" | "poor" | "lost";
  readonly mode?: "map" | "localise" | "continue";
}

export interface Goal extends Message {
  readonly id: number;
  readonly active: boolean;
  readonly map_from_goal: Pose;
}

export interface Path extends Message {
  readonly goal_id: number;
  readonly reason: string;
  readonly xs: Float64Array;
  readonly ys: Float64Array;
  readonly length: number;
}

export interface Zone {
  readonly name: string;
  readonly kind: "keep_out" | "slow";
  readonly xs: Float64Array;
  readonly ys: Float64Array;
  readonly speed?: number;
  readonly share?: number;
}

export interface Zones extends Message {
  readonly zones: readonly Zone[];
}

export interface FollowStatus extends Message {
  readonly goal_id: number;
  readonly state: "idle" | "following" | "blocked" | "arrived" | "failed";
  readonly reason: string;
  readonly distance_left: number;
}

export interface NavStatus extends Message {
  readonly task_id: number;
  readonly state: "idle" | "navigating" | "exploring" | "recovering" | "paused" | "reached" | "failed" | "canceled";
  readonly recovery: string;
  readonly reason: string;
  readonly detail: string;
  readonly distance_left: number;
  readonly time_left: number;
  readonly waypoint: number;
  readonly n_waypoints: number;
  readonly n_recoveries: number;
  readonly round?: number;
  readonly n_rounds?: number;
}

export interface NavTask extends Message {
  readonly kind: "none" | "route" | "explore";
  readonly poses: readonly Pose[];
  readonly waypoint: number;
  readonly loops: number;
}

export interface Velocity extends Message {
  readonly v: number;
  readonly w: number;
  readonly reason: string;
}

export interface EmergencyStop extends Message {
  readonly pressed: boolean;
  readonly by: string;
}

export interface GuardStatus extends Message {
  readonly state: "idle" | "active" | "hold" | "stopped" | "fault";
  readonly source: string;
  readonly reason: string;
  readonly detail: string;
  readonly speed_limit: number;
}

export interface BaseStatus extends Message {
  readonly battery: number;
  readonly link: boolean;
  readonly fault: string;
  readonly detail: string;
}

export interface Costmap extends Message {
  readonly x: number;
  readonly y: number;
  readonly resolution: number;
  readonly cells: Grid<Int8Array>;
}

export interface Rollouts extends Message {
  readonly xs: Grid<Float32Array>;
  readonly ys: Grid<Float32Array>;
  readonly costs: Float32Array;
}

export interface Health extends Message {
  readonly name: string;
  readonly state: string;
  readonly events: number;
  readonly bad_messages: number;
  readonly dropped: number;
  readonly last_error: string;
  readonly cpu: number;
  readonly memory: number;
  readonly handler_ms: number;
  readonly rates: readonly (readonly [topic: string, hz: number, age: number])[];
}

export interface LogLine extends Message {
  readonly level: string;
  readonly text: string;
}

export interface Truth extends Message {
  readonly world_from_base: Pose;
  readonly start: Pose;
  readonly contact: boolean;
  readonly n_contacts: number;
  readonly people_x: Float32Array;
  readonly people_y: Float32Array;
}

/** An array of two axes, row by row. */
export interface Grid<A> {
  readonly rows: number;
  readonly columns: number;
  readonly values: A;
}

/** Message type of each key; families ("health/mapper") by their first part. */
export interface MessageOf {
  scan: LaserScan;
  odom: Odometry;
  pose: PoseEstimate;
  goal: Goal;
  plan: Path;
  zones: Zones;
  "follow/status": FollowStatus;
  "nav/status": NavStatus;
  "nav/task": NavTask;
  "cmd/vel": Velocity;
  estop: EmergencyStop;
  "guard/status": GuardStatus;
  "base/status": BaseStatus;
  "debug/costmap": Costmap;
  "debug/rollouts": Rollouts;
  health: Health;
  log: LogLine;
  "sim/truth": Truth;
}

export type Key = keyof MessageOf;

/** Array fields of each key: dtype, and "2" where it has two axes. `zones[]` describes the items of a list. */
export const ARRAYS: { readonly [K in Key]?: Readonly<Record<string, string>> } = {
  scan: { ranges: "f4", intensities: "f4" },
  odom: { covariance: "f8" },
  pose: { covariance: "f8" },
  plan: { xs: "f8", ys: "f8", yaws: "f8" },
  zones: { "zones[].xs": "f8", "zones[].ys": "f8" },
  "debug/costmap": { cells: "i1 2" },
  "debug/rollouts": { xs: "f4 2", ys: "f4 2", costs: "f4" },
  "sim/truth": { people_x: "f4", people_y: "f4" },
};
