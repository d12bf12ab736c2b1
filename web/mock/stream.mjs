// SPDX-License-Identifier: Apache-2.0
// The messages of the mock as bytes, with arrays as shared/codec.py packs them.

import { encode } from "@msgpack/msgpack";

import { ray } from "./world.mjs";

const DTYPES = new Map([[Float32Array, 0], [Float64Array, 1], [Int8Array, 2]]);
const MOUNT = [0.13, 0, -Math.PI / 2];
const N_BEAMS = 450;
const SERVICES = ["sim", "base_driver", "lidar_driver", "odometry", "mapper", "planner", "local_ctrl", "guard", "navigator", "recorder", "dashboard"];
let sequence = 0;

export const KEYS = ["map", "pose", "odom", "scan", "plan", "goal", "zones", "map/state", "cmd/vel", "estop", "guard/status", "base/status", "nav/status", "nav/task", "follow/status", "debug/costmap", "debug/rollouts", "sim/truth", ...SERVICES.flatMap((name) => [`health/${name}`, `log/${name}`])];

function array(values, shape = [values.length]) {
  const header = Buffer.alloc(16);
  header.writeUInt8(DTYPES.get(values.constructor), 0);
  header.writeUInt8(shape.length, 1);
  shape.forEach((length, i) => header.writeUInt32LE(length, 4 + 4 * i));
  return Buffer.concat([header, Buffer.from(values.buffer)]);
}

const stampNow = () => BigInt(Date.now()) * 1000000n;

function bytes(fields) {
  const stamp = stampNow();
  return encode({ stamp, ...fields, "@": ["mock", "mock", sequence++, stamp] }, { useBigInt64: true });
}

/** The values of a float64 bin that the page sent. */
export function float64s(bin) {
  return Array.from({ length: (bin.length - 16) / 8 }, (_, i) => Buffer.from(bin).readDoubleLE(16 + 8 * i));
}

export function fast(robot) {
  const [v, w] = robot.velocity;
  return {
    odom: bytes({ odom_from_base: robot.pose, v, w, covariance: array(new Float64Array(9)) }),
    "cmd/vel": bytes({ v: robot.driving ? 0.55 : 0, w, reason: "" }),
    "sim/truth": bytes({
      world_from_base: [robot.pose[0] + 0.03, robot.pose[1] + 0.02, robot.pose[2]], start: [0, 0, 0], v, w,
      contact: false, n_contacts: 0, distance: 3,
      people_x: array(new Float32Array([10 + 3 * Math.sin(Date.now() / 4000), 17.5])),
      people_y: array(new Float32Array([10.4, 9 + Math.cos(Date.now() / 3000)])),
    }),
  };
}

export function medium(robot, now) {
  const [x, y, yaw] = robot.pose;
  const ranges = new Float32Array(N_BEAMS);
  const [lx, ly] = [x + Math.cos(yaw) * MOUNT[0], y + Math.sin(yaw) * MOUNT[0]];
  for (let i = 0; i < N_BEAMS; i++) {
    ranges[i] = ray(lx, ly, yaw + MOUNT[2] - (i * 2 * Math.PI) / N_BEAMS) + (Math.random() - 0.5) * 0.02;
  }
  const covariance = array(new Float64Array(9));
  const quality = 0.86 + 0.08 * Math.sin(now / 7000);
  return {
    pose: bytes({ map_from_base: robot.pose, map_from_odom: [0, 0, 0], covariance, quality, state: "good", mode: "map" }),
    scan: bytes({ angle_min: 0, angle_increment: (-2 * Math.PI) / N_BEAMS, scan_time: 0.1, range_min: 0.05, range_max: 12, ranges: array(ranges) }),
    "guard/status": bytes({ ...robot.guard(now), stopped: 0 }),
    "follow/status": bytes({ goal_id: robot.goal.id, state: robot.driving ? "following" : "idle", reason: "", distance_left: robot.left }),
    "debug/rollouts": rollouts(robot),
    "debug/costmap": costmap(robot),
  };
}

export function slow(robot) {
  const line = [robot.pose.slice(0, 2), ...robot.path.slice(robot.next)];
  const numbers = (i) => array(new Float64Array(robot.driving ? line.map((p) => p[i]) : []));
  const state = robot.paused ? "paused" : robot.nav;
  return {
    plan: bytes({ goal_id: robot.goal.id, map_version: 1, reason: "", xs: numbers(0), ys: numbers(1), yaws: array(new Float64Array(robot.driving ? line.length : 0)), length: robot.left, cost: 1 }),
    "nav/status": bytes({
      task_id: 1, state, recovery: "", reason: robot.reason, detail: "", goal: robot.goal.pose, distance_left: robot.left,
      time_left: robot.left / 0.5, waypoint: 0, n_waypoints: 1, n_recoveries: 0,
    }),
    "base/status": bytes({ battery: 7.4, left_current: 0.4, right_current: 0.4, link: true, fault: "", detail: "" }),
  };
}

export function events(robot) {
  const edits = robot.edits.map((edit) => ({ stamp: 0, ...edit, xs: array(new Float64Array(edit.xs)), ys: array(new Float64Array(edit.ys)) }));
  const zones = robot.zones.map((zone) => ({ stamp: 0, ...zone, xs: array(new Float64Array(zone.xs)), ys: array(new Float64Array(zone.ys)) }));
  return {
    goal: bytes({ id: robot.goal.id, active: robot.driving, map_from_goal: robot.goal.pose, tolerance: 0.1, yaw_tolerance: 0.2, clear_costmap: false }),
    zones: bytes({ zones }),
    "map/state": bytes({ map_id: 1, name: "office", edits }),
    estop: bytes({ pressed: robot.estop, by: "page" }),
  };
}

export function health() {
  return Object.fromEntries(SERVICES.map((name, i) => [`health/${name}`, bytes({
    name, pid: 100 + i, state: name === "recorder" ? "recording, 41 MB" : "running", events: 300, bad_messages: 0, dropped: i === 8 ? 3 : 0,
    intruders: 0, last_error: name === "lidar_driver" ? "2 sweeps without a start mark" : "", cpu: 0.02 + 0.015 * i + 0.01 * Math.random(),
    memory: 32 + 4 * i, handler_ms: 1 + i + 2 * Math.random(), rates: [["scan", 10, 0.004], ["odom", 50, 0.002]], rejected: [],
  })]));
}

export function logLine(level, text) {
  return bytes({ level, text });
}

function rollouts(robot) {
  const [k, n] = [24, 12];
  const [xs, ys] = [new Float32Array(k * n), new Float32Array(k * n)];
  for (let i = 0; i < k; i++) {
    const w = robot.velocity[1] + (i === 0 ? 0 : (i - k / 2) * 0.09);
    let [x, y, yaw] = robot.pose;
    for (let j = 0; j < n; j++) {
      [xs[i * n + j], ys[i * n + j]] = [x, y];
      x += Math.cos(yaw) * 0.09;
      y += Math.sin(yaw) * 0.09;
      yaw += w * 0.15;
    }
  }
  return bytes({ xs: array(xs, [k, n]), ys: array(ys, [k, n]), costs: array(new Float32Array(k)) });
}

function costmap(robot) {
  const n = 80;
  const [x, y] = [robot.pose[0] - 2, robot.pose[1] - 2];
  const cells = new Int8Array(n * n);
  for (let i = 0; i < cells.length; i++) {
    const range = ray(x + (i % n) * 0.05, y + Math.floor(i / n) * 0.05, 0.3);
    cells[i] = range < 0.2 ? 100 : range < 0.8 ? 99 - range * 110 : 0;
  }
  return bytes({ x, y, resolution: 0.05, cells: array(cells, [n, n]) });
}
