// SPDX-License-Identifier: Apache-2.0
// A robot that follows a path, drives by hand, and stands for reasons.

import { occupied } from "./world.mjs";

const LAP = [[4.6, 9.5], [10.6, 9.6], [12.6, 9.4], [12.6, 5.5], [9.5, 4.5], [12.6, 5.8], [12.6, 9.5], [20.6, 9.5], [20.6, 6], [18, 5], [20.6, 6.5], [20.5, 9.6], [4.6, 9.5]];

export class Robot {
  pose = [4.6, 9.5, 0];
  velocity = [0, 0];
  path = LAP;
  next = 1;
  laps = true;
  goal = { id: 1, pose: [20.6, 9.5, 0] };
  nav = "navigating";
  reason = "";
  estop = false;
  paused = false;
  blockedFor = 0;
  teleop = { at: -1, v: 0, w: 0, client: null };
  edits = [];
  zones = [
    { name: "stairs", kind: "keep_out", xs: [24.6, 29.4, 29.4, 24.6], ys: [4.4, 4.4, 7.6, 7.6], speed: 20, share: 1 },
    { name: "kitchen door", kind: "slow", xs: [11.2, 14, 14, 11.2], ys: [7, 7, 9, 9], speed: 0.25, share: 1 },
  ];

  navigate(poses) {
    this.path = [this.pose.slice(0, 2), ...poses.map(([x, y]) => [x, y])];
    this.goal = { id: this.goal.id + 1, pose: poses[poses.length - 1] };
    Object.assign(this, { next: 1, nav: "navigating", laps: false, paused: false, reason: "" });
  }

  stop(nav, reason) {
    Object.assign(this, { nav, reason });
  }

  get driving() {
    return this.nav === "navigating" || this.nav === "exploring";
  }

  /** One step of `dt` s at `now` ms. */
  step(now, dt) {
    const byHand = now - this.teleop.at < 200;
    this.blockedFor = Math.max(0, this.blockedFor - dt);
    let [v, w] = [0, 0];
    if (this.estop || this.blockedFor > 0) [v, w] = [0, 0];
    else if (byHand) [v, w] = [this.teleop.v, this.teleop.w];
    else if (this.driving && !this.paused) [v, w] = this.follow();
    const [x, y, yaw] = this.pose;
    const nx = x + Math.cos(yaw) * v * dt;
    const ny = y + Math.sin(yaw) * v * dt;
    const free = !occupied(nx, ny);
    this.pose = [free ? nx : x, free ? ny : y, Math.atan2(Math.sin(yaw + w * dt), Math.cos(yaw + w * dt))];
    this.velocity = [free ? v : 0, w];
  }

  follow() {
    const [x, y, yaw] = this.pose;
    const target = this.path[this.next];
    if (Math.hypot(target[0] - x, target[1] - y) < 0.3) {
      this.next++;
      if (this.next >= this.path.length) {
        if (this.laps) this.next = 1;
        else this.stop("reached", "");
      }
      return this.velocity;
    }
    const error = Math.atan2(target[1] - y, target[0] - x) - yaw;
    const turn = Math.atan2(Math.sin(error), Math.cos(error));
    return [Math.abs(turn) > 0.6 ? 0.05 : 0.55, Math.max(-1.5, Math.min(1.5, 2.5 * turn))];
  }

  get left() {
    let length = 0;
    let from = this.pose;
    for (const to of this.path.slice(this.next)) {
      length += Math.hypot(to[0] - from[0], to[1] - from[1]);
      from = to;
    }
    return length;
  }

  guard(now) {
    const byHand = now - this.teleop.at < 200;
    if (this.estop) return { state: "stopped", source: "", reason: "estop", detail: "by a page", speed_limit: 0 };
    if (this.blockedFor > 0) return { state: "hold", source: "nav", reason: "obstacle", detail: "0.21 m ahead", speed_limit: 0 };
    if (byHand) return { state: "active", source: "teleop", reason: "", detail: "", speed_limit: 0.8 };
    if (this.driving && !this.paused) return { state: "active", source: "nav", reason: "", detail: "", speed_limit: 0.8 };
    return { state: "idle", source: "", reason: "no_command", detail: "", speed_limit: 0.8 };
  }
}
