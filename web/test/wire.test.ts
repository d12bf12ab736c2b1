// SPDX-License-Identifier: Apache-2.0
import "./browser_globals";

import assert from "node:assert/strict";
import { test } from "node:test";

import { type Key, type MessageOf } from "../src/messages";
import { decodeMap, decodeMessage, encodeFloat64s, encodeFrame, WireError } from "../src/wire";
import { topicOf } from "../src/state";
import SAMPLES from "./wire_samples.json";

function sample<K extends Key>(key: K, name: keyof typeof SAMPLES = key as keyof typeof SAMPLES): MessageOf[K] {
  return decodeMessage(key, bytes(name));
}

function bytes(name: keyof typeof SAMPLES): Uint8Array {
  return new Uint8Array(Buffer.from(SAMPLES[name], "hex"));
}

test("a scan of the codec has its ranges, NaN and infinity", () => {
  const scan = sample("scan");
  assert.equal(scan.angle_increment, 0.5);
  assert.deepEqual([...scan.ranges], [0.5, NaN, Infinity, 3.25]);
});

test("poses, enums and numbers of the codec are plain values", () => {
  const pose = sample("pose");
  assert.deepEqual(pose.map_from_base, [1.5, -2.25, 0.5]);
  assert.equal(pose.state, "good");
  assert.equal(pose.quality, 0.875);
  assert.deepEqual([...pose.covariance], [1, 0, 0, 0, 1, 0, 0, 0, 1]);
  assert.ok(Math.abs(pose.stamp - 1_700_000_000_123_456_789) < 1000);
  assert.deepEqual(sample("odom").odom_from_base, [1.5, -2.25, 0.5]);
});

test("arrays of nested messages are decoded", () => {
  const [zone] = sample("zones").zones;
  assert.equal(zone?.kind, "keep_out");
  assert.deepEqual([...zone.xs], [0, 1, 1, 0]);
  assert.deepEqual([...zone.ys], [0, 0, 2, 2]);
});

test("arrays of two axes keep their shape", () => {
  const { cells } = sample("debug/costmap");
  assert.deepEqual([cells.rows, cells.columns, [...cells.values]], [2, 3, [0, 50, 100, -1, 99, 1]]);
  const { xs, costs } = sample("debug/rollouts");
  assert.deepEqual([xs.rows, xs.columns, costs.length], [2, 3, 2]);
});

test("lists of tuples are lists", () => {
  assert.deepEqual(sample("health", "health/mapper").rates, [["scan", 10, 0.004]]);
});

test("keys of families have the topic of their first part", () => {
  assert.equal(topicOf("health/mapper"), "health");
  assert.equal(topicOf("log/guard"), "log");
  assert.equal(topicOf("guard/status"), "guard/status");
  assert.equal(topicOf("journal/mapper"), null);
});

test("an array is decoded wherever it begins in memory", () => {
  const padded = new Uint8Array([0, 0, 0, ...bytes("plan")]).subarray(3);
  assert.deepEqual([...decodeMessage("plan", padded).xs], [0, 1, 1, 0]);
});

test("bytes that are no message raise WireError", () => {
  const scan = bytes("scan");
  for (const bad of [new Uint8Array(), scan.subarray(0, 40), new Uint8Array([0x93, 1, 2, 3]), bytes("estop").fill(0xc1)]) {
    assert.throws(() => decodeMessage("scan", bad), WireError);
  }
  assert.throws(() => decodeMessage("debug/costmap", encodeFrame({ stamp: 1, cells: new Uint8Array(20) })), WireError);
  assert.throws(() => decodeMessage("plan", encodeFrame({ stamp: 1, xs: scan })), WireError);
});

test("a float64 array is packed as the codec packs it", () => {
  const tree = decodeMap(bytes("plan")) as { xs: Uint8Array };
  assert.deepEqual([...encodeFloat64s([0, 1, 1, 0])], [...tree.xs]);
});
