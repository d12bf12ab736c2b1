// SPDX-License-Identifier: Apache-2.0
// Frames of the WebSocket, as docs/page.md lists them. `t` is the type.

import { type Point, type Pose } from "./geometry";
import { type TilesFrame } from "./tile_store";

export type Role = "viewer" | "operator" | "admin";
export type Severity = "info" | "hold" | "stop" | "fault";

export interface Robot {
  readonly name: string;
  readonly outline: readonly Point[];
  readonly laser_mount: Pose;
  readonly laser_2_mount?: Pose; // of a robot with a second laser
  readonly max_speed: number;
  readonly max_reverse_speed: number;
  readonly max_turn_rate: number;
}

export interface Hello {
  readonly t: "hello";
  readonly client: number;
  readonly name: string;
  readonly role: Role;
  /** Whether it has logged in: then its name is that of the login. */
  readonly login: boolean;
  readonly robot: Robot;
  readonly simulated: boolean;
  readonly version: string;
  readonly csrf: string;
  /** A page of a site: it shows one of several robots, and none is driven by hand. */
  readonly site?: boolean;
  readonly keys: readonly string[];
  readonly reasons: Readonly<Record<string, readonly [text: string, hint: string, severity: Severity]>>;
}

export interface Drivers {
  readonly t: "drivers";
  readonly driver: { readonly client: number; readonly name: string } | null;
  readonly other: boolean;
  readonly source: string;
}

export interface PageClient {
  readonly client: number;
  readonly name: string;
  readonly role: Role;
}

/** One robot of the router, as `zenav fleet list` has it. x, y: m, yaw: rad, on its map; plan: x and y of its poses, m. */
export interface FleetRobot {
  readonly name: string;
  readonly state: string;
  readonly reason: string;
  readonly task: string;
  readonly battery: number | null;
  readonly map: string;
  readonly x: number | null;
  readonly y: number | null;
  readonly yaw: number | null;
  readonly pose_state: string;
  readonly received: number | null;
  readonly delay: number | null;
  readonly address: string;
  readonly version: string;
  readonly plan: readonly [] | readonly [readonly number[], readonly number[]];
}

export interface Reply {
  readonly t: "reply";
  readonly id: number;
  readonly accepted: boolean;
  readonly reason: string;
  readonly detail: string;
  readonly hint: string;
  readonly data: unknown;
}

export interface Note {
  readonly t: "note";
  readonly level: "info" | "warning" | "error";
  readonly text: string;
  readonly hint: string;
  readonly answers?: "stop_all";
}

export type ServerFrame =
  | Hello
  | Drivers
  | Reply
  | Note
  | ({ readonly t: "tiles" } & TilesFrame)
  | { readonly t: "m"; readonly k: string; readonly b: Uint8Array }
  | { readonly t: "fleet"; readonly robots: readonly FleetRobot[] }
  | { readonly t: "clients"; readonly clients: readonly PageClient[] }
  | { readonly t: "pong"; readonly id: number; readonly now: number };

export type ClientFrame =
  | { t: "want"; keys: string[]; debug: boolean }
  | { t: "teleop"; v: number; w: number; n: number }
  | { t: "let_go" }
  | { t: "stop" }
  | { t: "stop_all" }
  | { t: "release" }
  | { t: "ask"; id: number; request: string; args: object }
  | { t: "do"; id: number; op: string; args: object }
  | { t: "name"; name: string }
  | { t: "ping"; id: number };

const QUIET_FRAMES: ReadonlySet<string> = new Set(["want", "stop", "stop_all", "let_go", "name", "ping"]);
const QUIET_OPERATIONS: ReadonlySet<string> = new Set(["replay_open", "replay_at", "recordings"]);

/** Whether a frame may be sent while a recording is replayed: it commands nothing, or it stops the robot. */
export function mayReplaySend(frame: ClientFrame): boolean {
  return frame.t === "do" ? QUIET_OPERATIONS.has(frame.op) : QUIET_FRAMES.has(frame.t);
}
