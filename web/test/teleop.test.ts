// SPDX-License-Identifier: Apache-2.0
import assert from "node:assert/strict";
import { test } from "node:test";

import { gamepadDeflection, keysDeflection, Teleop, type TeleopFrame } from "../src/teleop";

function machine(): { teleop: Teleop; sent: TeleopFrame[] } {
  const sent: TeleopFrame[] = [];
  const teleop = new Teleop(
    (frame) => sent.push(frame),
    () => ({ forward: 0.8, reverse: 0.3, turn: 2 }),
  );
  teleop.arm();
  teleop.release("gamepad"); // at rest
  teleop.share = 1;
  return { teleop, sent };
}

const AHEAD = { forward: 1, turn: 0 };

test("an input sends at once, is repeated, and lets go at its release", () => {
  const { teleop, sent } = machine();
  teleop.hold("stick", AHEAD);
  teleop.tick();
  teleop.release("stick");
  teleop.tick();
  assert.deepEqual(sent, [{ t: "teleop", v: 0.8, w: 0, n: 1 }, { t: "teleop", v: 0.8, w: 0, n: 2 }, { t: "let_go" }]);
});

test("a page that is not armed sends nothing", () => {
  const { teleop, sent } = machine();
  teleop.armed = false;
  teleop.hold("keys", AHEAD);
  teleop.tick();
  teleop.release("keys");
  assert.deepEqual(sent, []);
});

// Each way in which driving ends: blur, hidden page, cancelled pointer, STOP and a lost link call letGo or release.
const ENDS: [string, (teleop: Teleop) => void][] = [
  ["release of all inputs", (teleop) => ["stick", "keys", "gamepad"].forEach((source) => teleop.release(source))],
  ["blur or hidden page", (teleop) => teleop.letGo()],
  ["disarming", (teleop) => teleop.disarm()],
];

for (const [name, end] of ENDS) {
  test(`${name} ends with exactly one let_go, and silence`, () => {
    const { teleop, sent } = machine();
    teleop.hold("stick", AHEAD);
    teleop.hold("keys", { forward: 0, turn: 1 });
    teleop.tick();
    end(teleop);
    end(teleop);
    for (let i = 0; i < 5; i++) teleop.tick();
    assert.equal(sent.filter((frame) => frame.t === "let_go").length, 1);
    assert.equal(sent[sent.length - 1]?.t, "let_go");
    assert.equal(teleop.driving, false);
  });
}

test("any order of events ends in let_go after letGo", () => {
  let seed = 7;
  const random = (n: number): number => (seed = (seed * 1103515245 + 12345) % 2 ** 31) % n;
  for (let run = 0; run < 200; run++) {
    const { teleop, sent } = machine();
    for (let i = 0; i < 30; i++) {
      const source = ["stick", "keys", "gamepad"][random(3)]!;
      const act = random(5);
      if (act < 2) teleop.hold(source, AHEAD);
      else if (act === 2) teleop.release(source);
      else if (act === 3) teleop.tick();
      else teleop.letGo();
    }
    teleop.letGo();
    teleop.tick();
    const types = sent.map((frame) => frame.t);
    if (types.length > 0) assert.equal(types[types.length - 1], "let_go");
    types.forEach((type, i) => assert.ok(type !== "let_go" || types[i - 1] === "teleop"));
  }
});

test("an input that was let go counts again only after its release", () => {
  const { teleop, sent } = machine();
  teleop.hold("gamepad", AHEAD);
  teleop.letGo();
  teleop.hold("gamepad", AHEAD);
  teleop.tick();
  assert.equal(sent[sent.length - 1]?.t, "let_go");
  teleop.release("gamepad");
  teleop.hold("gamepad", AHEAD);
  assert.equal(sent[sent.length - 1]?.t, "teleop");
});

test("a gamepad that is deflected while the page is armed does not drive before it was at rest", () => {
  const { teleop, sent } = machine();
  teleop.disarm();
  teleop.arm();
  teleop.hold("gamepad", AHEAD);
  assert.deepEqual(sent, []);
});

test("the robot drives on while another input is held", () => {
  const { teleop, sent } = machine();
  teleop.hold("stick", AHEAD);
  teleop.hold("keys", AHEAD);
  teleop.release("stick");
  assert.ok(sent.every((frame) => frame.t === "teleop"));
  assert.equal(teleop.driving, true);
});

test("speeds stay within the limits, and backward has its own", () => {
  const { teleop } = machine();
  teleop.hold("stick", AHEAD);
  teleop.hold("keys", { forward: 1, turn: 5 });
  assert.deepEqual(teleop.velocity(), { v: 0.8, w: 2 });
  teleop.release("stick");
  teleop.hold("keys", { forward: -1, turn: 0 });
  assert.equal(teleop.velocity().v, -0.3);
  teleop.share = 0.5;
  assert.equal(teleop.velocity().v, -0.15);
});

test("the number of a frame grows over all drives", () => {
  const { teleop, sent } = machine();
  for (let i = 0; i < 3; i++) {
    teleop.hold("keys", AHEAD);
    teleop.release("keys");
  }
  assert.deepEqual(sent.flatMap((frame) => (frame.t === "teleop" ? [frame.n] : [])), [1, 2, 3]);
});

test("keys give a deflection, opposite keys a held zero, others none", () => {
  assert.deepEqual(keysDeflection(new Set(["KeyW", "KeyA"])), { forward: 1, turn: 1 });
  assert.deepEqual(keysDeflection(new Set(["ArrowDown", "ArrowRight"])), { forward: -1, turn: -1 });
  assert.deepEqual(keysDeflection(new Set(["KeyW", "KeyS"])), { forward: 0, turn: 0 });
  assert.equal(keysDeflection(new Set(["KeyX"])), null);
});

test("a gamepad's worn stick is not held; full deflection is 1", () => {
  assert.equal(gamepadDeflection([0.08, -0.1, 0, 0]), null);
  assert.deepEqual(gamepadDeflection([0, -1, 0, 0]), { forward: 1, turn: 0 });
  assert.equal(gamepadDeflection([1, 0, 0, 0])?.turn, -1);
  assert.equal(gamepadDeflection([]), null);
});
