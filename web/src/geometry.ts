// SPDX-License-Identifier: Apache-2.0
// Poses in the plane: [x, y, yaw] in m, m, rad. A pose `a_from_b` maps points of frame b to frame a.

export type Pose = readonly [x: number, y: number, yaw: number];
export type Point = readonly [x: number, y: number];

/** The pose `a_from_c` of `a_from_b` and `b_from_c`. */
export function compose(a: Pose, b: Pose): Pose {
  const c = Math.cos(a[2]);
  const s = Math.sin(a[2]);
  return [a[0] + c * b[0] - s * b[1], a[1] + s * b[0] + c * b[1], wrapAngle(a[2] + b[2])];
}

/** The point of frame b in frame a. */
export function transformPoint(a: Pose, p: Point): Point {
  const c = Math.cos(a[2]);
  const s = Math.sin(a[2]);
  return [a[0] + c * p[0] - s * p[1], a[1] + s * p[0] + c * p[1]];
}

/** The pose that is `share` (0 .. 1) of the motion from `a` to `b`; the angle goes the short way. */
export function interpolate(a: Pose, b: Pose, share: number): Pose {
  return [a[0] + (b[0] - a[0]) * share, a[1] + (b[1] - a[1]) * share, a[2] + wrapAngle(b[2] - a[2]) * share];
}

/** The angle within -pi .. pi, rad. */
export function wrapAngle(angle: number): number {
  return Math.atan2(Math.sin(angle), Math.cos(angle));
}

export function degrees(radians: number): number {
  return (radians * 180) / Math.PI;
}

export function radians(degrees: number): number {
  return (degrees * Math.PI) / 180;
}
