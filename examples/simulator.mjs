// SPDX-License-Identifier: Apache-2.0
// A simulator in JavaScript: a TurtleBot 3 Burger in a room of 5 x 4 m, by docs/wire.md, without zenav's code.
// The base controls its own speed and does its own odometry; the laser turns clockwise.
//
//   npm install @msgpack/msgpack
//   zenav up --robot turtlebot3_burger --external sim      # in one terminal
//   node simulator.mjs                                     # in another; ZENAV_STACK as for zenav
import { encode, unpack } from "./wire.mjs";
import { listen } from "./zenoh_tcp.mjs";

const ROBOT = "turtlebot3"; // `name` in the robot's file
const PORT = 17400 + 40 * Number(process.env.ZENAV_STACK ?? 0); // of the service sim
const BEAMS = 360;
const STEP = (-2 * Math.PI) / BEAMS; // rad
const SWEEP_S = 0.1994; // s from the first to the last beam
const LASER_X = -0.032; // m, in base
const COMMAND_LIFE_S = 0.2;
const LAG_S = 0.05; // of the base's speed control
const TICK_S = 0.02;
const TICKS_A_SWEEP = 10;
// walls, then two boxes: x0 y0 x1 y1, m
const BOXES = [
  [-1.5, -2, 3.5, -2], [-1.5, 2, 3.5, 2], [-1.5, -2, -1.5, 2], [3.5, -2, 3.5, 2],
  [1.4, 0.5, 1.9, 1.1], [-0.4, -1.3, 0.1, -0.9],
]; // prettier-ignore

const now = () => BigInt(Date.now()) * 1000000n; // ns
const session = `${process.pid}-${Date.now()}`;
const sequences = new Map();
let command = { v: 0, w: 0, stamp: 0n };
const speed = { v: 0, w: 0 };
let pose = [0, 0, 0]; // x, y, yaw: m, m, rad

const peer = listen(PORT, [`${ROBOT}/hardware/velocity`], (key, payload) => {
  command = unpack(payload);
});

function publish(key, fields) {
  const sequence = sequences.get(key) ?? 0;
  sequences.set(key, sequence + 1);
  peer.put(`${ROBOT}/${key}`, encode({ "@": ["sim", session, sequence, now()], ...fields }));
}

/** An array with one axis: 16 bytes of header, then the values. dtype: 0 float32, 1 float64. */
function array(values, dtype) {
  const bin = new DataView(new ArrayBuffer(16 + values.length * (dtype === 0 ? 4 : 8)));
  bin.setUint8(0, dtype);
  bin.setUint8(1, 1);
  bin.setUint32(4, values.length, true);
  values.forEach((x, i) => (dtype === 0 ? bin.setFloat32(16 + 4 * i, x, true) : bin.setFloat64(16 + 8 * i, x, true)));
  return new Uint8Array(bin.buffer);
}

/** m from a point to the nearest box along an angle, by the slab method; NaN without one. */
function range(x, y, angle) {
  const distances = BOXES.map(([x0, y0, x1, y1]) => {
    const [ax, bx] = [x0 - x, x1 - x].map((d) => d / Math.cos(angle)).sort((a, b) => a - b);
    const [ay, by] = [y0 - y, y1 - y].map((d) => d / Math.sin(angle)).sort((a, b) => a - b);
    const [near, far] = [Math.max(ax, ay), Math.min(bx, by)];
    return near > 0 && near <= far + 1e-9 ? near : Infinity;
  });
  const nearest = Math.min(...distances);
  return nearest < 8 ? nearest + 0.01 * (Math.random() + Math.random() - 1) : NaN;
}

/** The pose after a time at a velocity. */
function moved([x, y, yaw], { v, w }, seconds) {
  const middle = yaw + (w * seconds) / 2;
  return [x + v * Math.cos(middle) * seconds, y + v * Math.sin(middle) * seconds, yaw + w * seconds];
}

const began = now();
let last = began;
let n = 0;
setInterval(() => {
  const stamp = now();
  const seconds = Number(stamp - last) * 1e-9;
  if (seconds <= 0) return;
  last = stamp;
  const isFresh = Number(stamp - BigInt(command.stamp)) * 1e-9 < COMMAND_LIFE_S; // without commands the base stops
  for (const name of ["v", "w"]) {
    speed[name] += ((isFresh ? command[name] : 0) - speed[name]) * Math.min(1, seconds / LAG_S);
  }
  pose = moved(pose, speed, seconds);
  const unknown = array(new Array(9).fill(0), 1);
  publish("hardware/odometry", {
    stamp, epoch: began, has_pose: true, odom_from_base: pose, has_twist: true, v: speed.v, vy: 0, w: speed.w,
    covariance: unknown, twist_covariance: unknown, battery: 12,
  }); // prettier-ignore
  if (++n % TICKS_A_SWEEP !== 0) return;
  const ranges = Array.from({ length: BEAMS }, (_, i) => {
    const [x, y, yaw] = moved(pose, speed, SWEEP_S * (i / (BEAMS - 1) - 1)); // when this beam was measured
    return range(x + LASER_X * Math.cos(yaw), y + LASER_X * Math.sin(yaw), yaw + STEP * i);
  });
  publish("scan", {
    stamp: stamp - BigInt(Math.round(SWEEP_S * 1e9)), angle_min: 0, angle_increment: STEP, scan_time: SWEEP_S,
    range_min: 0.16, range_max: 8, ranges: array(ranges, 0),
  }); // prettier-ignore
}, TICK_S * 1000);
