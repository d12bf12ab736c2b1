// SPDX-License-Identifier: Apache-2.0
import "./browser_globals";

import assert from "node:assert/strict";
import { test } from "node:test";

import { wantedKeys } from "../src/dispatch";
import { isItemName, itemName } from "../src/names";
import { mapsFrom, placesFrom, settingsFrom } from "../src/records";
import { StackClock } from "../src/stack_clock";

test("a stamp's age follows the stack's clock, half a round trip after it was read", () => {
  const clock = new StackClock();
  assert.equal(clock.age(0, 100), null);
  clock.update(50e9, 1000, 1040);
  assert.equal(clock.rtt, 40);
  assert.ok(Math.abs(clock.age(49e9, 2020)! - 2) < 1e-9);
});

test("a simulation that runs three times as fast ages three times as fast", () => {
  const clock = new StackClock();
  clock.update(50e9, 1000, 1000);
  clock.update(56e9, 3000, 3000);
  assert.ok(Math.abs(clock.age(56e9, 4000)! - 3) < 1e-9);
});

test("only offered keys are wanted, families by their members, debug keys on demand", () => {
  const offered = ["pose", "health/mapper", "log/guard", "debug/costmap", "base/report"];
  assert.deepEqual(wantedKeys(offered, false), ["pose", "health/mapper", "log/guard"]);
  assert.deepEqual(wantedKeys(offered, true), ["pose", "health/mapper", "log/guard", "debug/costmap"]);
});

test("lists of the server are read whatever their rows lack", () => {
  assert.deepEqual(mapsFrom(["office"]), [{ name: "office", size: null, modified: null }]);
  assert.deepEqual(placesFrom([{ name: "dock", pose: [1, 2, 0.5], map: "office" }]), [
    { name: "dock", pose: [1, 2, 0.5], map: "office", hasHeading: true },
  ]);
  assert.equal(placesFrom([{ name: "dock", x: 1, y: 2, yaw: null }])[0]?.hasHeading, false);
  assert.deepEqual(placesFrom([{ name: "nowhere" }, { pose: [1, 2, 3] }, null]), []);
  assert.equal(settingsFrom([{ name: "a.b", value: [1, 2], origin: "default", description: "m" }])[0]?.value, "[1,2]");
});

test("a setting has an editor only where it may change while the robot runs", () => {
  const fixed = { name: "a.b", value: 1, origin: "default", description: "m" };
  const rows = [fixed, { ...fixed, kind: "number", low: 0, high: null, unit: "m", is_limit: true, started: 2 }];
  const [first, second] = settingsFrom(rows);
  assert.equal(first?.editor, null);
  assert.deepEqual(second?.editor, {
    kind: "number",
    choices: [],
    low: 0,
    high: null,
    unit: "m",
    isLimit: true,
    started: "2",
  });
  assert.equal(settingsFrom([{ ...fixed, kind: "something new" }])[0]?.editor, null);
});

test("names of maps and places are those that files may have", () => {
  assert.equal(itemName("  meeting room"), "meeting_room");
  assert.ok(isItemName("Küche_2") && isItemName("a-b"));
  for (const bad of ["", "2nd", "a/b", "../x", "a b", "x".repeat(65)]) assert.ok(!isItemName(bad), bad);
});
