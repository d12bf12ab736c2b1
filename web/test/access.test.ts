// SPDX-License-Identifier: Apache-2.0
import "./browser_globals";

import assert from "node:assert/strict";
import { test } from "node:test";

import { checkSession, invitationIn, logIn, loginProblem, needsLogin } from "../src/access";

const TOKEN = "cu1aFMYmbQjqlGREZue40qtQ8kJXFiWjMOMpPm1s93c";

function answering(status: number): void {
  globalThis.fetch = () => Promise.resolve(new Response(null, { status }));
}

test("the token is found in a link and alone, and nothing else is one", () => {
  assert.equal(invitationIn(`https://robot.local:8600/#invite=${TOKEN}`), TOKEN);
  assert.equal(invitationIn(` ${TOKEN}\n`), TOKEN);
  for (const text of ["", "https://robot.local:8600/", `https://robot.local/?invite=${TOKEN}`, "#invite=short", "a b"]) {
    assert.equal(invitationIn(text), "", text);
  }
});

test("only 401 shows the login: a server that does not answer comes back by itself", async () => {
  answering(401);
  assert.equal(await checkSession(), true);
  assert.equal(needsLogin.value, true);
  answering(200);
  assert.equal(await checkSession(), false);
  globalThis.fetch = () => Promise.reject(new TypeError("network"));
  assert.equal(await checkSession(), false);
  assert.equal(needsLogin.value, false);
});

test("each outcome of a login has its text", async () => {
  const outcomes = [[200, true, ""], [401, false, "login_refused"], [429, false, "login_slowed"]] as const;
  for (const [status, enters, problem] of outcomes) {
    answering(status);
    assert.equal(await logIn(TOKEN), enters);
    assert.equal(loginProblem.value, problem);
  }
});
