// SPDX-License-Identifier: Apache-2.0
import assert from "node:assert/strict";
import { test } from "node:test";

import "./browser_globals";
import { colorOf, isOnMap, robotAt } from "../src/fleet";
import { type FleetRobot } from "../src/protocol";

function robot(name: string, fields: Partial<FleetRobot> = {}): FleetRobot {
  const nothing = { reason: "", task: "", battery: null, received: null, delay: null, address: "", version: "" };
  return { name, state: "idle", map: "", x: 0, y: 0, yaw: 0, pose_state: "good", plan: [], ...nothing, ...fields };
}

test("only a saved map of one name joins the coordinates of two robots", () => {
  assert.equal(isOnMap(robot("red", { map: "office" }), "blue", "office"), true);
  assert.equal(isOnMap(robot("red", { map: "hall" }), "blue", "office"), false);
  assert.equal(isOnMap(robot("red"), "blue", ""), false, "two maps that are not saved are two maps");
  assert.equal(isOnMap(robot("blue"), "blue", ""), true);
});

test("a press takes the nearest robot within reach, and none without a pose", () => {
  const robots = [robot("red", { x: 1 }), robot("blue", { x: 1.3 }), robot("lost", { x: null, y: null })];
  assert.equal(robotAt(robots, 1.2, 0, 0.4), "blue");
  assert.equal(robotAt(robots, 5, 0, 0.4), null);
});

test("a robot keeps its colour while others come and go silent, and neighbours differ", () => {
  const robots = ["red", "blue", "green"].map((name) => robot(name));
  assert.equal(colorOf("red", robots), colorOf("red", [...robots].reverse()));
  assert.equal(new Set(robots.map(({ name }) => colorOf(name, robots))).size, 3);
});
