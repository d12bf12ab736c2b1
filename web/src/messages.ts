// SPDX-License-Identifier: Apache-2.0
// Made from shared/messages.py and shared/topics.py by `python -m zenav.web_types`; edit these instead.
// Stamps are ns on the stack's clock; lengths are m, angles rad, unless a field says otherwise.

/** A pose: m, m, rad. */
export type Pose = readonly [x: number, y: number, yaw: number];

/** An array of two axes, row by row. */
export interface Grid<A> {
  readonly rows: number;
  readonly columns: number;
  readonly values: A;
}

/** Under "@" in each message. `sent`: ns on the stack's clock. `sequence`: from 0, by key and session. */
export type Envelope = readonly [publisher: string, session: string, sequence: number, sent: number];

/** How far the pose can be trusted. */
export type Localization = "starting" | "good" | "poor" | "lost";

/** What the mapper does with its map. */
export type MapMode = "map" | "localise" | "continue";

/** Kind of an edit of the map. */
export type EditKind = "erase" | "wall";

/** What local control does to free a robot without progress. */
export type RecoveryKind = "back_up" | "turn" | "wait";

/** Kind of a zone. */
export type ZoneKind = "keep_out" | "slow";

/** What local control is doing. */
export type FollowState = "idle" | "following" | "blocked" | "arrived" | "failed";

/** State of the navigator. */
export type NavState = "idle" | "navigating" | "exploring" | "recovering" | "paused" | "reached" | "failed" | "canceled";

/** Kind of a navigator's task. */
export type TaskKind = "none" | "route" | "explore";

/** Why the robot moves or stands. */
export type GuardState = "idle" | "active" | "hold" | "stopped" | "fault";

/** What the motion board measures. The left encoder counts down when the X80SV drives forward. */
export interface BoardReport {
  /** ns */
  readonly stamp: number;
  /** encoder counts, wrapping */
  readonly left_counts: number;
  /** encoder counts, wrapping */
  readonly right_counts: number;
  /** counts/s */
  readonly left_speed: number;
  /** counts/s */
  readonly right_speed: number;
  /** m */
  readonly ultrasonic: Float32Array;
  /** m */
  readonly infrared: Float32Array;
  /** V */
  readonly battery: number;
  /** A */
  readonly currents: Float32Array;
}

/** Wheel speeds for the board, in encoder counts a second with the board's signs. It stands until the next. */
export interface MotorCommand {
  /** ns */
  readonly stamp: number;
  /** counts/s */
  readonly left: number;
  /** counts/s */
  readonly right: number;
}

/** Odometry of a base that controls its own speed: a pose, a twist, or both. Without one of them its fields are 0. */
export interface BaseOdometry {
  /** ns */
  readonly stamp: number;
  /** ns */
  readonly epoch: number;
  readonly has_pose: boolean;
  /** m, m, rad */
  readonly odom_from_base: Pose;
  readonly has_twist: boolean;
  /** m/s */
  readonly v: number;
  /** m/s */
  readonly vy: number;
  /** rad/s */
  readonly w: number;
  /** m, m, rad squared, row by row */
  readonly covariance: Float64Array;
  /** m/s, m/s, rad/s squared, row by row */
  readonly twist_covariance: Float64Array;
  /** V */
  readonly battery: number;
}

/** A velocity in `base`. `reason` says why it is zero or slowed, empty when it is neither. */
export interface Velocity {
  /** ns */
  readonly stamp: number;
  /** m/s */
  readonly v: number;
  /** rad/s */
  readonly w: number;
  readonly reason: string;
}

/** What an inertial sensor measures, turned into `base`: turn rate about z (up), and specific force. */
export interface Imu {
  /** ns */
  readonly stamp: number;
  /** rad/s */
  readonly yaw_rate: number;
  /** m/s^2 */
  readonly acceleration_x: number;
  /** m/s^2 */
  readonly acceleration_y: number;
  /** m/s^2 */
  readonly acceleration_z: number;
}

/** The names of the bumpers that are pressed and of the cliff sensors that see no floor, and the e-stop input. */
export interface Contacts {
  /** ns */
  readonly stamp: number;
  readonly bumpers: readonly string[];
  readonly cliffs: readonly string[];
  readonly estop: boolean;
}

/** Both wheels, positive when the robot drives forward. Angles are unwrapped since the driver's start (`epoch`). */
export interface WheelState {
  /** ns */
  readonly stamp: number;
  /** ns */
  readonly epoch: number;
  /** rad */
  readonly left: number;
  /** rad */
  readonly right: number;
  /** rad/s */
  readonly left_speed: number;
  /** rad/s */
  readonly right_speed: number;
}

/** Ultrasonic and infrared cones in `base`: where each sensor sits, looks, and what it sees. No echo is NaN. */
export interface RangeReadings {
  /** ns */
  readonly stamp: number;
  /** m */
  readonly x: Float32Array;
  /** m */
  readonly y: Float32Array;
  /** rad */
  readonly yaw: Float32Array;
  /** rad */
  readonly field_of_view: Float32Array;
  /** m */
  readonly ranges: Float32Array;
}

/** State of the base for people and for the guard. `fault` is a reason's code, empty when there is none. */
export interface BaseStatus {
  /** ns */
  readonly stamp: number;
  /** V */
  readonly battery: number;
  /** A */
  readonly left_current: number;
  /** A */
  readonly right_current: number;
  readonly link: boolean;
  readonly fault: string;
  readonly detail: string;
  readonly waits: boolean;
}

/** How the line to the motion board is doing, and what else the board measures; NaN before it was measured. */
export interface BoardStatus {
  /** ns */
  readonly stamp: number;
  /** packets */
  readonly good: number;
  /** packets */
  readonly bad_crc: number;
  /** times that bytes were no packet */
  readonly resyncs: number;
  /** bytes */
  readonly skipped: number;
  /** s */
  readonly last_heard: number;
  /** Hz */
  readonly rate: number;
  /** V */
  readonly board_supply: number;
  /** V */
  readonly motor_supply: number;
  /** V */
  readonly servo_supply: number;
  /** degrees C, motor driver */
  readonly left_temperature: number;
  /** degrees C, motor driver */
  readonly right_temperature: number;
  /** degrees C */
  readonly temperature: number;
}

/** One sweep in `laser`; beams run counter-clockwise when the increment is positive. No echo is NaN or +inf. */
export interface LaserScan {
  /** ns */
  readonly stamp: number;
  /** rad */
  readonly angle_min: number;
  /** rad */
  readonly angle_increment: number;
  /** s */
  readonly scan_time: number;
  /** m */
  readonly range_min: number;
  /** m */
  readonly range_max: number;
  /** m */
  readonly ranges: Float32Array;
  readonly intensities?: Float32Array;
}

/** Dead reckoning: continuous, drifts. Covariance of the pose grows with travel. */
export interface Odometry {
  /** ns */
  readonly stamp: number;
  /** m, m, rad */
  readonly odom_from_base: Pose;
  /** m/s */
  readonly v: number;
  /** rad/s */
  readonly w: number;
  /** m, m, rad squared, row by row */
  readonly covariance: Float64Array;
}

/** Where the robot is on the map, as of a scan. `quality` is the share of beams that agree with the map. */
export interface PoseEstimate {
  /** ns */
  readonly stamp: number;
  /** m, m, rad */
  readonly map_from_base: Pose;
  /** m, m, rad */
  readonly map_from_odom: Pose;
  /** m, m, rad squared, row by row */
  readonly covariance: Float64Array;
  readonly quality: number;
  readonly state: Localization;
  readonly mode: MapMode;
}

/** Changed tiles of the occupancy grid. -1 unknown, 0 free .. 100 occupied. */
export interface MapUpdate {
  /** ns */
  readonly stamp: number;
  /** ns */
  readonly map_id: number;
  readonly version: number;
  /** m/cell */
  readonly resolution: number;
  /** tiles */
  readonly rows: Int32Array;
  /** tiles */
  readonly columns: Int32Array;
  /** percent, -1 unknown */
  readonly cells: Grid<Int8Array>;
}

/** A change of the map by a user, over what the laser saw. `id` is its own among the map's; the mapper chooses it. */
export interface MapEdit {
  /** ns */
  readonly stamp: number;
  readonly id: number;
  readonly kind: EditKind;
  /** m */
  readonly xs: Float64Array;
  /** m */
  readonly ys: Float64Array;
  /** m */
  readonly width: number;
}

/** What the tiles of the map do not show: the name under which it was saved or loaded, empty if none, and its edits. */
export interface MapState {
  /** ns */
  readonly stamp: number;
  /** ns */
  readonly map_id: number;
  readonly name: string;
  readonly edits: readonly MapEdit[];
}

/** The pose to plan and drive to, or, when it is not active, the order to stand. */
export interface Goal {
  /** ns */
  readonly stamp: number;
  readonly id: number;
  readonly active: boolean;
  /** m, m, rad */
  readonly map_from_goal: Pose;
  /** m */
  readonly tolerance: number;
  /** rad; over pi: any heading */
  readonly yaw_tolerance: number;
  readonly clear_costmap: boolean;
}

/** A motion that frees a robot without progress. It holds until a goal or a recovery with a higher `id` comes. */
export interface Recovery {
  /** ns */
  readonly stamp: number;
  readonly id: number;
  readonly kind: RecoveryKind;
  /** m, rad or s by kind */
  readonly amount: number;
}

/** A polygon in `map`, corners in order, closed by itself (even-odd rule). `name` is its own among all. */
export interface Zone {
  /** ns */
  readonly stamp: number;
  readonly name: string;
  readonly kind: ZoneKind;
  /** m */
  readonly xs: Float64Array;
  /** m */
  readonly ys: Float64Array;
  /** m/s */
  readonly speed: number;
  readonly share: number;
}

/** Every zone that holds from now on. */
export interface Zones {
  /** ns */
  readonly stamp: number;
  readonly zones: readonly Zone[];
}

/** The way to the goal in `map`, or none and why. `reason` is a code of reasons.py, empty when there is a path. */
export interface Path {
  /** ns */
  readonly stamp: number;
  readonly goal_id: number;
  readonly map_version: number;
  readonly reason: string;
  /** m */
  readonly xs: Float64Array;
  /** m */
  readonly ys: Float64Array;
  /** rad */
  readonly yaws: Float64Array;
  /** m */
  readonly length: number;
  /** m, weighted */
  readonly cost: number;
}

/** Conditions of the planner for any goal. The navigator refuses other goals in its reply. */
export interface GoalLimits {
  /** ns */
  readonly stamp: number;
  /** m */
  readonly margin: number;
  /** m */
  readonly least_margin: number;
  /** m */
  readonly reach: number;
  /** m outside the map's tiles */
  readonly beyond_map: number;
}

/** Local control's progress on the goal or recovery with this id. */
export interface FollowStatus {
  /** ns */
  readonly stamp: number;
  readonly goal_id: number;
  readonly state: FollowState;
  readonly reason: string;
  /** m */
  readonly distance_left: number;
}

/** The task, how far it is, and why the robot stands when it stands. `task_id` counts the requests it accepted. */
export interface NavStatus {
  /** ns */
  readonly stamp: number;
  readonly task_id: number;
  readonly state: NavState;
  readonly recovery: string;
  readonly reason: string;
  readonly detail: string;
  /** m, m, rad */
  readonly goal: Pose;
  /** m */
  readonly distance_left: number;
  /** s */
  readonly time_left: number;
  readonly waypoint: number;
  readonly n_waypoints: number;
  readonly n_recoveries: number;
  readonly round: number;
  readonly n_rounds: number;
}

/** The navigator's task and how far it is, for the navigator that takes its place after a crash. */
export interface NavTask {
  /** ns */
  readonly stamp: number;
  readonly task_id: number;
  readonly kind: TaskKind;
  /** s */
  readonly age: number;
  /** ns */
  readonly map_id: number;
  readonly paused: boolean;
  /** m, m, rad */
  readonly poses: readonly Pose[];
  /** s, one a pose */
  readonly dwells: readonly number[];
  /** rounds; 0 is for ever */
  readonly loops: number;
  readonly any_heading: boolean;
  /** m */
  readonly tolerance: number;
  /** rad */
  readonly yaw_tolerance: number;
  readonly waypoint: number;
  readonly round: number;
  readonly dwelling: boolean;
  /** s */
  readonly dwell: number;
  readonly pass_through: boolean;
}

/** The part of a robot in an exploration with others, for these. Positions are in the frame that all have in common. */
export interface ExplorationShare {
  /** ns */
  readonly stamp: number;
  readonly robot: string;
  /** ns */
  readonly session: number;
  readonly sequence: number;
  readonly task_id: number;
  readonly others: readonly string[];
  readonly active: boolean;
  /** m, m, rad */
  readonly common_from_map: Pose;
  /** m */
  readonly x: number;
  /** m */
  readonly y: number;
  /** m */
  readonly frontier_xs: Float32Array;
  /** m */
  readonly frontier_ys: Float32Array;
  /** m */
  readonly frontier_costs: Float32Array;
  readonly claimed: number;
  /** m */
  readonly closed_xs: Float32Array;
  /** m */
  readonly closed_ys: Float32Array;
  /** m */
  readonly seen_xs: Float32Array;
  /** m */
  readonly seen_ys: Float32Array;
  /** m */
  readonly cell: number;
  readonly first_row: number;
  readonly first_column: number;
  readonly rows: number;
  readonly columns: number;
  /** zlib */
  readonly cells: Uint8Array;
}

/** STOP, latched: it holds until an operator releases it; releasing never moves the robot. */
export interface EmergencyStop {
  /** ns */
  readonly stamp: number;
  readonly pressed: boolean;
  readonly by: string;
}

/** What local control steers by, in `odom`, or the planner's costs, in `map`, while somebody watches. */
export interface Costmap {
  /** ns */
  readonly stamp: number;
  /** m */
  readonly x: number;
  /** m */
  readonly y: number;
  /** m/cell */
  readonly resolution: number;
  /** percent, -1 unknown */
  readonly cells: Grid<Int8Array>;
}

/** Ways that local control weighed up in a tick, in `odom`, while somebody watches; the first is the one it took. */
export interface Rollouts {
  /** ns */
  readonly stamp: number;
  /** m */
  readonly xs: Grid<Float32Array>;
  /** m */
  readonly ys: Grid<Float32Array>;
  readonly costs: Float32Array;
}

/** Discs that local control takes for moving obstacles, in `odom`, while somebody watches. None: nothing moves. */
export interface MovingObstacles {
  /** ns */
  readonly stamp: number;
  /** m */
  readonly xs: Float32Array;
  /** m */
  readonly ys: Float32Array;
  /** m/s */
  readonly vxs: Float32Array;
  /** m/s */
  readonly vys: Float32Array;
  /** m */
  readonly radii: Float32Array;
}

/** Keyframes of the mapper in `map`, and the loop closures between them, while somebody watches. */
export interface KeyframeGraph {
  /** ns */
  readonly stamp: number;
  /** m */
  readonly xs: Float32Array;
  /** m */
  readonly ys: Float32Array;
  /** m */
  readonly from_xs: Float32Array;
  /** m */
  readonly from_ys: Float32Array;
  /** m */
  readonly to_xs: Float32Array;
  /** m */
  readonly to_ys: Float32Array;
  readonly accepted: Int8Array;
}

/** The guard's verdict. `source` is the command source in charge ("nav", "teleop" or empty). */
export interface GuardStatus {
  /** ns */
  readonly stamp: number;
  readonly state: GuardState;
  readonly source: string;
  readonly reason: string;
  readonly detail: string;
  /** m/s */
  readonly speed_limit: number;
  /** ns */
  readonly stopped: number;
}

/** The settings of a service that were set while it runs; all others are as it was started with. */
export interface RuntimeSettings {
  /** ns */
  readonly stamp: number;
  /** dotted, as in a robot's file */
  readonly names: readonly string[];
  /** YAML, one a name */
  readonly values: readonly string[];
}

/** One service's second, from its own work loop: a hung service falls silent. */
export interface Health {
  /** ns */
  readonly stamp: number;
  readonly name: string;
  readonly pid: number;
  readonly state: string;
  readonly events: number;
  readonly bad_messages: number;
  readonly dropped: number;
  readonly intruders: number;
  readonly last_error: string;
  /** share of a core over the last second */
  readonly cpu: number;
  /** MB */
  readonly memory: number;
  /** ms, slowest handler of the last second */
  readonly handler_ms: number;
  /** topic, Hz, age in s when handled (largest) */
  readonly rates: readonly (readonly [string, number, number])[];
  /** key, why (old, ahead, sequence, size, content), messages since the start */
  readonly rejected: readonly (readonly [string, string, number])[];
}

/** One line of a service's log. Levels as in Python's logging: DEBUG, INFO, WARNING, ERROR. */
export interface LogLine {
  /** ns */
  readonly stamp: number;
  readonly level: string;
  readonly text: string;
}

/** Where a robot is, where it will be, and which part of its path it holds, for the other robots on its map. */
export interface RobotIntent {
  /** ns */
  readonly stamp: number;
  readonly robot: string;
  readonly map: string;
  /** m, m, rad */
  readonly map_from_base: Pose;
  /** m/s */
  readonly v: number;
  /** rad/s */
  readonly w: number;
  /** m, circumscribed */
  readonly radius: number;
  /** m in map */
  readonly xs: Float32Array;
  /** m in map */
  readonly ys: Float32Array;
  /** m */
  readonly widths: Float32Array;
  readonly held: number;
  readonly wanted: number;
  readonly priority: number;
  /** ns */
  readonly since: number;
  readonly claim: number;
  /** robot, its newest claim */
  readonly heard: readonly (readonly [string, number])[];
  /** names of the robots that keep it from its next claim */
  readonly waits_for: readonly string[];
  readonly gives_way: boolean;
  readonly stuck: boolean;
  readonly lost: boolean;
}

/** How far this robot may drive, as far as other robots are concerned. Not `active`: none is heard on its map. */
export interface RightOfWay {
  /** ns */
  readonly stamp: number;
  readonly active: boolean;
  /** m in map */
  readonly xs: Float32Array;
  /** m in map */
  readonly ys: Float32Array;
  readonly whole: boolean;
  /** names */
  readonly waits_for: readonly string[];
  readonly gives_way: boolean;
  /** m, m, rad */
  readonly refuge: Pose;
  /** share of the top speed */
  readonly speed_share: number;
  /** m in map */
  readonly closed_xs: Float32Array;
  /** m in map */
  readonly closed_ys: Float32Array;
  /** m */
  readonly closed_radii: Float32Array;
}

/** The other robots on this robot's map as discs, at `stamp` and each `period` after it, on their paths. */
export interface OtherRobots {
  /** ns */
  readonly stamp: number;
  /** of the robots */
  readonly names: readonly string[];
  /** m */
  readonly radii: Float32Array;
  /** s */
  readonly period: number;
  /** m in map, robot by robot */
  readonly xs: Grid<Float32Array>;
  /** m in map, robot by robot */
  readonly ys: Grid<Float32Array>;
}

/** The simulator's time; `rate` is how many simulated seconds pass in a real one. */
export interface Clock {
  /** ns */
  readonly stamp: number;
  readonly rate: number;
}

/** Where the other robots of a simulated world are, as discs in the world. Only a simulator reads it. */
export interface RobotDiscs {
  /** ns */
  readonly stamp: number;
  /** m */
  readonly x: Float32Array;
  /** m */
  readonly y: Float32Array;
  /** m */
  readonly radius: Float32Array;
}

/** What only the simulator knows. Never read by a service that a robot would run. `start` is `world_from_map`. */
export interface Truth {
  /** ns */
  readonly stamp: number;
  /** m, m, rad */
  readonly world_from_base: Pose;
  /** m, m, rad */
  readonly start: Pose;
  /** m/s */
  readonly v: number;
  /** rad/s */
  readonly w: number;
  readonly contact: boolean;
  readonly n_contacts: number;
  /** m */
  readonly distance: number;
  /** m */
  readonly people_x: Float32Array;
  /** m */
  readonly people_y: Float32Array;
}

/** Message type of each key; families ("health/mapper") by their first part. */
export interface MessageOf {
  "hardware/board": BoardReport;
  "hardware/motors": MotorCommand;
  "hardware/odometry": BaseOdometry;
  "hardware/velocity": Velocity;
  "imu": Imu;
  "hardware/contacts": Contacts;
  "base/wheels": WheelState;
  "base/odometry": BaseOdometry;
  "base/ranges": RangeReadings;
  "base/status": BaseStatus;
  "base/report": BoardReport;
  "base/board": BoardStatus;
  "scan": LaserScan;
  "scan_2": LaserScan;
  "odom": Odometry;
  "pose": PoseEstimate;
  "map": MapUpdate;
  "map/state": MapState;
  "goal": Goal;
  "recovery": Recovery;
  "zones": Zones;
  "plan": Path;
  "plan/limits": GoalLimits;
  "follow/status": FollowStatus;
  "nav/status": NavStatus;
  "nav/task": NavTask;
  "explore/share": ExplorationShare;
  "explore/others": ExplorationShare;
  "explore/map": MapUpdate;
  "cmd/nav": Velocity;
  "cmd/teleop": Velocity;
  "estop": EmergencyStop;
  "debug/costmap": Costmap;
  "debug/rollouts": Rollouts;
  "debug/moving_obstacles": MovingObstacles;
  "debug/graph": KeyframeGraph;
  "debug/global_costmap": Costmap;
  "guard/status": GuardStatus;
  "cmd/vel": Velocity;
  "settings": RuntimeSettings;
  "health": Health;
  "log": LogLine;
  "traffic/intent": RobotIntent;
  "traffic/heard": RobotIntent;
  "traffic/right_of_way": RightOfWay;
  "traffic/others": OtherRobots;
  "sim/clock": Clock;
  "sim/others": RobotDiscs;
  "sim/truth": Truth;
}

export type Key = keyof MessageOf;

/** Array fields of each key: dtype, and the number of axes over 1. `zones[].xs`: of each item of a list. */
export const ARRAYS: { readonly [K in Key]?: Readonly<Record<string, string>> } = {
  "hardware/board": { "ultrasonic": "f4", "infrared": "f4", "currents": "f4" },
  "hardware/odometry": { "covariance": "f8", "twist_covariance": "f8" },
  "base/odometry": { "covariance": "f8", "twist_covariance": "f8" },
  "base/ranges": { "x": "f4", "y": "f4", "yaw": "f4", "field_of_view": "f4", "ranges": "f4" },
  "base/report": { "ultrasonic": "f4", "infrared": "f4", "currents": "f4" },
  "scan": { "ranges": "f4", "intensities": "f4" },
  "scan_2": { "ranges": "f4", "intensities": "f4" },
  "odom": { "covariance": "f8" },
  "pose": { "covariance": "f8" },
  "map": { "rows": "i4", "columns": "i4", "cells": "i1 2" },
  "map/state": { "edits[].xs": "f8", "edits[].ys": "f8" },
  "zones": { "zones[].xs": "f8", "zones[].ys": "f8" },
  "plan": { "xs": "f8", "ys": "f8", "yaws": "f8" },
  "explore/share": { "frontier_xs": "f4", "frontier_ys": "f4", "frontier_costs": "f4", "closed_xs": "f4", "closed_ys": "f4", "seen_xs": "f4", "seen_ys": "f4" },
  "explore/others": { "frontier_xs": "f4", "frontier_ys": "f4", "frontier_costs": "f4", "closed_xs": "f4", "closed_ys": "f4", "seen_xs": "f4", "seen_ys": "f4" },
  "explore/map": { "rows": "i4", "columns": "i4", "cells": "i1 2" },
  "debug/costmap": { "cells": "i1 2" },
  "debug/rollouts": { "xs": "f4 2", "ys": "f4 2", "costs": "f4" },
  "debug/moving_obstacles": { "xs": "f4", "ys": "f4", "vxs": "f4", "vys": "f4", "radii": "f4" },
  "debug/graph": { "xs": "f4", "ys": "f4", "from_xs": "f4", "from_ys": "f4", "to_xs": "f4", "to_ys": "f4", "accepted": "i1" },
  "debug/global_costmap": { "cells": "i1 2" },
  "traffic/intent": { "xs": "f4", "ys": "f4", "widths": "f4" },
  "traffic/heard": { "xs": "f4", "ys": "f4", "widths": "f4" },
  "traffic/right_of_way": { "xs": "f4", "ys": "f4", "closed_xs": "f4", "closed_ys": "f4", "closed_radii": "f4" },
  "traffic/others": { "radii": "f4", "xs": "f4 2", "ys": "f4 2" },
  "sim/others": { "x": "f4", "y": "f4", "radius": "f4" },
  "sim/truth": { "people_x": "f4", "people_y": "f4" },
};

/** Fields of each message: number, string, boolean, bytes, pose, enum NAME, array DTYPE AXES, list of KIND,
 * or the name of a message. */
export const FIELDS: Readonly<Record<string, Readonly<Record<string, string>>>> = {
  BoardReport: { stamp: "number", left_counts: "number", right_counts: "number", left_speed: "number", right_speed: "number", ultrasonic: "array f4 1", infrared: "array f4 1", battery: "number", currents: "array f4 1" },
  MotorCommand: { stamp: "number", left: "number", right: "number" },
  BaseOdometry: { stamp: "number", epoch: "number", has_pose: "boolean", odom_from_base: "pose", has_twist: "boolean", v: "number", vy: "number", w: "number", covariance: "array f8 1", twist_covariance: "array f8 1", battery: "number" },
  Velocity: { stamp: "number", v: "number", w: "number", reason: "string" },
  Imu: { stamp: "number", yaw_rate: "number", acceleration_x: "number", acceleration_y: "number", acceleration_z: "number" },
  Contacts: { stamp: "number", bumpers: "list of string", cliffs: "list of string", estop: "boolean" },
  WheelState: { stamp: "number", epoch: "number", left: "number", right: "number", left_speed: "number", right_speed: "number" },
  RangeReadings: { stamp: "number", x: "array f4 1", y: "array f4 1", yaw: "array f4 1", field_of_view: "array f4 1", ranges: "array f4 1" },
  BaseStatus: { stamp: "number", battery: "number", left_current: "number", right_current: "number", link: "boolean", fault: "string", detail: "string", waits: "boolean" },
  BoardStatus: { stamp: "number", good: "number", bad_crc: "number", resyncs: "number", skipped: "number", last_heard: "number", rate: "number", board_supply: "number", motor_supply: "number", servo_supply: "number", left_temperature: "number", right_temperature: "number", temperature: "number" },
  LaserScan: { stamp: "number", angle_min: "number", angle_increment: "number", scan_time: "number", range_min: "number", range_max: "number", ranges: "array f4 1", intensities: "array f4 1" },
  Odometry: { stamp: "number", odom_from_base: "pose", v: "number", w: "number", covariance: "array f8 1" },
  PoseEstimate: { stamp: "number", map_from_base: "pose", map_from_odom: "pose", covariance: "array f8 1", quality: "number", state: "enum Localization", mode: "enum MapMode" },
  MapUpdate: { stamp: "number", map_id: "number", version: "number", resolution: "number", rows: "array i4 1", columns: "array i4 1", cells: "array i1 2" },
  MapEdit: { stamp: "number", id: "number", kind: "enum EditKind", xs: "array f8 1", ys: "array f8 1", width: "number" },
  MapState: { stamp: "number", map_id: "number", name: "string", edits: "list of MapEdit" },
  Goal: { stamp: "number", id: "number", active: "boolean", map_from_goal: "pose", tolerance: "number", yaw_tolerance: "number", clear_costmap: "boolean" },
  Recovery: { stamp: "number", id: "number", kind: "enum RecoveryKind", amount: "number" },
  Zone: { stamp: "number", name: "string", kind: "enum ZoneKind", xs: "array f8 1", ys: "array f8 1", speed: "number", share: "number" },
  Zones: { stamp: "number", zones: "list of Zone" },
  Path: { stamp: "number", goal_id: "number", map_version: "number", reason: "string", xs: "array f8 1", ys: "array f8 1", yaws: "array f8 1", length: "number", cost: "number" },
  GoalLimits: { stamp: "number", margin: "number", least_margin: "number", reach: "number", beyond_map: "number" },
  FollowStatus: { stamp: "number", goal_id: "number", state: "enum FollowState", reason: "string", distance_left: "number" },
  NavStatus: { stamp: "number", task_id: "number", state: "enum NavState", recovery: "string", reason: "string", detail: "string", goal: "pose", distance_left: "number", time_left: "number", waypoint: "number", n_waypoints: "number", n_recoveries: "number", round: "number", n_rounds: "number" },
  NavTask: { stamp: "number", task_id: "number", kind: "enum TaskKind", age: "number", map_id: "number", paused: "boolean", poses: "list of pose", dwells: "list of number", loops: "number", any_heading: "boolean", tolerance: "number", yaw_tolerance: "number", waypoint: "number", round: "number", dwelling: "boolean", dwell: "number", pass_through: "boolean" },
  ExplorationShare: { stamp: "number", robot: "string", session: "number", sequence: "number", task_id: "number", others: "list of string", active: "boolean", common_from_map: "pose", x: "number", y: "number", frontier_xs: "array f4 1", frontier_ys: "array f4 1", frontier_costs: "array f4 1", claimed: "number", closed_xs: "array f4 1", closed_ys: "array f4 1", seen_xs: "array f4 1", seen_ys: "array f4 1", cell: "number", first_row: "number", first_column: "number", rows: "number", columns: "number", cells: "bytes" },
  EmergencyStop: { stamp: "number", pressed: "boolean", by: "string" },
  Costmap: { stamp: "number", x: "number", y: "number", resolution: "number", cells: "array i1 2" },
  Rollouts: { stamp: "number", xs: "array f4 2", ys: "array f4 2", costs: "array f4 1" },
  MovingObstacles: { stamp: "number", xs: "array f4 1", ys: "array f4 1", vxs: "array f4 1", vys: "array f4 1", radii: "array f4 1" },
  KeyframeGraph: { stamp: "number", xs: "array f4 1", ys: "array f4 1", from_xs: "array f4 1", from_ys: "array f4 1", to_xs: "array f4 1", to_ys: "array f4 1", accepted: "array i1 1" },
  GuardStatus: { stamp: "number", state: "enum GuardState", source: "string", reason: "string", detail: "string", speed_limit: "number", stopped: "number" },
  RuntimeSettings: { stamp: "number", names: "list of string", values: "list of string" },
  Health: { stamp: "number", name: "string", pid: "number", state: "string", events: "number", bad_messages: "number", dropped: "number", intruders: "number", last_error: "string", cpu: "number", memory: "number", handler_ms: "number", rates: "list of (string, number, number)", rejected: "list of (string, string, number)" },
  LogLine: { stamp: "number", level: "string", text: "string" },
  RobotIntent: { stamp: "number", robot: "string", map: "string", map_from_base: "pose", v: "number", w: "number", radius: "number", xs: "array f4 1", ys: "array f4 1", widths: "array f4 1", held: "number", wanted: "number", priority: "number", since: "number", claim: "number", heard: "list of (string, number)", waits_for: "list of string", gives_way: "boolean", stuck: "boolean", lost: "boolean" },
  RightOfWay: { stamp: "number", active: "boolean", xs: "array f4 1", ys: "array f4 1", whole: "boolean", waits_for: "list of string", gives_way: "boolean", refuge: "pose", speed_share: "number", closed_xs: "array f4 1", closed_ys: "array f4 1", closed_radii: "array f4 1" },
  OtherRobots: { stamp: "number", names: "list of string", radii: "array f4 1", period: "number", xs: "array f4 2", ys: "array f4 2" },
  Clock: { stamp: "number", rate: "number" },
  RobotDiscs: { stamp: "number", x: "array f4 1", y: "array f4 1", radius: "array f4 1" },
  Truth: { stamp: "number", world_from_base: "pose", start: "pose", v: "number", w: "number", contact: "boolean", n_contacts: "number", distance: "number", people_x: "array f4 1", people_y: "array f4 1" },
};
