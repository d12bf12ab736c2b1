// SPDX-License-Identifier: Apache-2.0
import "./browser_globals";

import assert from "node:assert/strict";
import { test } from "node:test";

import { mayReplaySend, type Reply } from "../src/protocol";
import { type ReplayState, trailUntil } from "../src/records";
import { ReplayPlayer } from "../src/replay_player";
import { isShownOld, latest, replayed, replaying, replayStamp, shown } from "../src/state";

interface Order {
  readonly op: string;
  readonly args: { readonly name: string; readonly t: number; readonly since?: number; readonly first: number };
  readonly answer: (fields: object, left?: number) => Promise<void>;
}

const ACCEPTED = { t: "reply", id: 0, accepted: true, reason: "", detail: "", hint: "" } as const;
const OPENED = { name: "a.mcap", begin: 1000, length: 60, start: 0, robot: null, marks: [], trail: [], problems: [] };

/** A player whose orders wait until a test answers them, and what it has shown. */
function rig() {
  const orders: Order[] = [];
  const shownStates: ReplayState[] = [];
  const events: string[] = [];
  const run = (op: string, args: object): Promise<Reply> =>
    new Promise((resolve) => {
      const answer = async (fields: object, left = 0): Promise<void> => {
        const { t, first } = args as Order["args"];
        const tiles = { rows: Array(left > 0 ? 256 : 1).fill(0), left, began: 0 };
        const data = op === "replay_open" ? OPENED : { t, stamp: t * 1e9, messages: [], tiles, first };
        resolve({ ...ACCEPTED, data, ...fields });
        await new Promise((done) => setTimeout(done));
      };
      orders.push({ op, args: args as Order["args"], answer });
    });
  const player = new ReplayPlayer(run, {
    begin: () => events.push("begin"),
    show: (state) => shownStates.push(state),
    end: () => events.push("end"),
    refuse: (reply) => events.push(reply.detail),
  });
  return { player, orders, events, moments: () => shownStates.map((state) => state.t) };
}

async function opened() {
  const all = rig();
  void all.player.open("a.mcap");
  await all.orders[0]!.answer({});
  all.player.tick(100);
  await all.orders[1]!.answer({});
  return all;
}

test("a recording opens at its begin, with all tiles", async () => {
  const { orders, events, moments } = await opened();
  assert.deepEqual(orders.map((order) => order.op), ["replay_open", "replay_at"]);
  assert.deepEqual([orders[1]!.args.t, orders[1]!.args.since], [0, undefined]);
  assert.deepEqual([events, moments()], [["begin"], [0]]);
});

test("a recording opens where the robot's state is first known", async () => {
  const { player, orders } = rig();
  void player.open("a.mcap");
  await orders[0]!.answer({ data: { ...OPENED, start: 1.5 } });
  player.tick(100);
  assert.equal(orders[1]!.args.t, 1.5);
  player.seek(0);
  assert.equal(player.position.peek(), 0);
});

test("playing goes on by the speed, asks only for changed tiles, and stands at the end", async () => {
  const { player, orders, moments } = await opened();
  player.speed.value = "10";
  player.toggle();
  player.tick(100);
  assert.deepEqual([orders[2]!.args.t, orders[2]!.args.since], [1, 0]);
  await orders[2]!.answer({});
  player.tick(100);
  assert.deepEqual([orders[3]!.args.t, orders[3]!.args.since], [2, 1]);
  await orders[3]!.answer({});
  player.tick(60_000);
  assert.deepEqual([player.position.value, player.playing.value], [60, false]);
  assert.deepEqual(moments(), [0, 1, 2]);
  player.toggle();
  assert.deepEqual([player.position.value, player.playing.value], [0, true]);
});

test("one order waits at a time, and of many moments that are sought the newest is asked for", async () => {
  const { player, orders, moments } = await opened();
  for (const t of [10, 11, 12]) {
    player.seek(t);
    player.tick(100);
  }
  assert.equal(orders.length, 3);
  await orders[2]!.answer({});
  player.tick(100);
  assert.deepEqual([orders[3]!.args.t, orders[3]!.args.since], [12, undefined]);
  await orders[3]!.answer({});
  player.tick(100);
  assert.equal(orders.length, 4, "nothing has changed");
  assert.deepEqual(moments(), [0, 10, 12]);
});

test("a reply of playing is dropped after a seek", async () => {
  const { player, orders, moments } = await opened();
  player.toggle();
  player.tick(100);
  player.seek(40);
  await orders[2]!.answer({});
  assert.deepEqual(moments(), [0]);
  player.toggle();
  player.tick(100);
  assert.deepEqual([orders[3]!.args.t, orders[3]!.args.since], [40, undefined]);
});

test("a large map comes in parts", async () => {
  const { player, orders } = await opened();
  player.seek(5);
  player.tick(100);
  await orders[2]!.answer({}, 44);
  assert.deepEqual([orders[3]!.args.t, orders[3]!.args.first], [5, 256]);
  await orders[3]!.answer({});
  player.toggle();
  player.tick(100);
  assert.equal(orders[4]!.args.since, 5, "the page has the whole map");
});

test("a reply that comes after a close or for another recording is dropped", async () => {
  const { player, orders, events, moments } = await opened();
  player.seek(7);
  player.tick(100);
  player.close();
  await orders[2]!.answer({});
  player.tick(100);
  assert.deepEqual([moments(), events, orders.length], [[0], ["begin", "end"], 3]);
  void player.open("a.mcap");
  player.close();
  await orders[3]!.answer({});
  assert.deepEqual([player.opened.value, player.opening.value, events], [null, "", ["begin", "end"]]);
});

test("a refusal is told, and playing ends", async () => {
  const { player, orders, events } = await opened();
  player.toggle();
  player.tick(100);
  await orders[2]!.answer({ accepted: false, detail: "it is gone" });
  assert.deepEqual([player.playing.value, events.at(-1)], [false, "it is gone"]);
});

test("during a replay nothing may be sent that commands the robot, but STOP", () => {
  assert.ok(mayReplaySend({ t: "stop" }) && mayReplaySend({ t: "let_go" }));
  assert.ok(mayReplaySend({ t: "do", id: 1, op: "replay_at", args: {} }));
  assert.ok(!mayReplaySend({ t: "release" }) && !mayReplaySend({ t: "teleop", v: 0, w: 0, n: 1 }));
  assert.ok(!mayReplaySend({ t: "ask", id: 1, request: "request/navigate", args: {} }));
  assert.ok(!mayReplaySend({ t: "do", id: 1, op: "map_load", args: {} }));
});

test("what is shown is the replay's while it lasts, with its ages, and the newest live message after it", () => {
  const set = (target: object, value: unknown): void => void ((target as { value: unknown }).value = value);
  const stamp = (): number | undefined => shown.pose.value?.message.stamp;
  set(latest.pose, { message: { stamp: 1 }, at: 0 });
  replaying.value = true;
  assert.equal(stamp(), undefined);
  set(replayed.pose, { message: { stamp: 10e9 }, at: 0 });
  set(latest.pose, { message: { stamp: 2 }, at: 0 });
  replayStamp.value = 10.5e9;
  assert.deepEqual([stamp(), isShownOld("pose", 0)], [10e9, false]);
  replayStamp.value = 12e9;
  assert.ok(isShownOld("pose", 0));
  replaying.value = false;
  assert.equal(stamp(), 2);
});

test("the trail is that of the map that is shown, until the moment", () => {
  const flat = [0, 1, 1, 2, 2, 2, 4, 3, 3, 6, 4, 4];
  assert.deepEqual(trailUntil(flat, 1, 4), [[2, 2], [3, 3]]);
});
