// SPDX-License-Identifier: Apache-2.0
import "./browser_globals";

import assert from "node:assert/strict";
import { readFileSync } from "node:fs";
import { test } from "node:test";

import { language } from "../src/preferences";
import { REASON_TEXTS } from "../src/reason_texts";
import { hello } from "../src/state";
import { reasonText, t, TEXTS } from "../src/texts";
import { why, type Situation } from "../src/why";

const REASONS = readFileSync("../shared/reasons.py", "utf8");
const CODES = [...REASONS.matchAll(/= Reason\("(\w+)"/g)].map((match) => match[1]!);

test("every text is there in both languages, with the same places to fill in", () => {
  const places = (text: string): string[] => (text.match(/\{\w+\}/g) ?? []).sort();
  for (const [key, [english, german]] of Object.entries(TEXTS)) {
    assert.ok(english.trim() !== "" && german.trim() !== "", key);
    assert.deepEqual(places(english), places(german), key);
  }
});

test("every reason of the stack is there in German", () => {
  assert.ok(CODES.length > 40);
  assert.deepEqual(CODES.filter((code) => (REASON_TEXTS[code]?.de[0] ?? "") === ""), []);
});

test("no text is for a reason that the stack does not have", () => {
  assert.deepEqual(Object.keys(REASON_TEXTS).filter((code) => code !== "role" && !CODES.includes(code)), []);
});

test("values are filled in, in the chosen language", () => {
  language.value = "en";
  assert.equal(t("retry_in", { n: 3 }), "Next attempt in 3 s");
  language.value = "de";
  assert.equal(t("retry_in", { n: 3 }), "Nächster Versuch in 3 s");
  language.value = "en";
});

test("a reason without a row shows its code", () => {
  assert.equal(reasonText("new_reason").text, "new_reason");
  assert.deepEqual(reasonText(""), { text: "", hint: "" });
});

const IDLE: Situation = {
  guard: { stamp: 1, state: "idle", source: "", reason: "no_command", detail: "", speed_limit: 1, stopped: 0 },
  nav: null,
  follow: null,
  estop: false,
  driver: "",
};

function headline(change: Partial<Situation>): string {
  return why({ ...IDLE, ...change }).headline;
}

test("the headline says why the robot stands: STOP first, then the guard, then the task", () => {
  hello.value = { reasons: Object.fromEntries(CODES.map((code) => [code, [`text of ${code}`, "hint", "hold"]])) } as never;
  const hold = { ...IDLE.guard!, state: "hold", reason: "obstacle" } as const;
  const nav = { state: "failed", reason: "unreachable", detail: "", distance_left: 2, time_left: 61 } as never;
  assert.equal(headline({ guard: null }), TEXTS.no_data_yet[0]);
  assert.equal(headline({}), "Ready");
  assert.equal(headline({ guard: hold, nav, estop: true }), "Text of estop");
  assert.equal(headline({ guard: hold, nav }), "Text of obstacle");
  assert.equal(headline({ nav }), "Text of unreachable");
  const driving = { ...IDLE.guard!, state: "active", source: "nav", reason: "" } as const;
  const going = { ...(nav as object), state: "navigating", reason: "", n_waypoints: 1 } as never;
  assert.equal(headline({ guard: driving, nav: going }), "Driving · 2.0 m left · 1:01 min");
  const byHand = { ...driving, source: "teleop" } as const;
  assert.equal(headline({ guard: byHand, driver: "page 3" }), "page 3 drives by hand");
  assert.equal(headline({ guard: byHand, driver: null }), "You drive");
});

