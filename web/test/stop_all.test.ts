// SPDX-License-Identifier: Apache-2.0
import assert from "node:assert/strict";
import { mock, test } from "node:test";

import { decode, encode } from "@msgpack/msgpack";

import "./browser_globals";
import { start } from "../src/connection";
import { dispatcher } from "../src/dispatch";
import { stopAll, stopAllPending, watchStopAll } from "../src/fleet";

const HELLO = { t: "hello", client: 1, login: true, robot: { name: "red" }, keys: [], reasons: {}, site: true };

/** A connection whose other end is the test. */
class FakeSocket {
  static readonly OPEN = 1;
  static readonly opened: FakeSocket[] = [];
  readonly frames: { t: string }[] = [];
  readyState = FakeSocket.OPEN;
  onopen = (): void => undefined;
  onmessage: (event: { data: unknown }) => void = () => undefined;
  onclose: (event: { code: number; reason: string }) => void = () => undefined;

  constructor() {
    FakeSocket.opened.push(this);
  }

  send(data: Uint8Array): void {
    this.frames.push(decode(data) as { t: string });
  }

  close(): void {
    this.readyState = 3;
  }

  receive(frame: object): void {
    const bytes = encode(frame);
    this.onmessage({ data: bytes.buffer.slice(bytes.byteOffset, bytes.byteOffset + bytes.byteLength) });
  }

  breaks(): void {
    this.close();
    this.onclose({ code: 1006, reason: "" });
  }

  get nStops(): number {
    return this.frames.filter((frame) => frame.t === "stop_all").length;
  }
}

Object.assign(globalThis, {
  WebSocket: FakeSocket,
  window: { addEventListener: () => undefined },
  location: { protocol: "http:", host: "robot", search: "", reload: () => undefined },
  document: { title: "" },
});

test("STOP for all goes out again after a link that broke with it, until the server answers", () => {
  const timers = { apis: ["setInterval", "setTimeout"] }; // the types are those of Node 20.9, which took a list
  mock.timers.enable(timers as unknown as Parameters<typeof mock.timers.enable>[0]);
  watchStopAll();
  start(dispatcher(() => undefined));
  const first = FakeSocket.opened[0]!;
  first.receive(HELLO);
  stopAll();
  assert.equal(first.nStops, 1);
  first.breaks();
  mock.timers.tick(1000);
  const second = FakeSocket.opened[1]!;
  assert.equal(second.nStops, 0, "nothing is sent before the server says hello");
  second.receive(HELLO);
  mock.timers.tick(2000);
  assert.equal(second.nStops, 3);
  second.receive({ t: "note", level: "info", text: "another note", hint: "" });
  assert.equal(stopAllPending.value, true);
  second.receive({ t: "note", level: "info", text: "STOP is pressed on red", hint: "", answers: "stop_all" });
  assert.equal(stopAllPending.value, false);
  mock.timers.tick(5000);
  assert.equal(second.nStops, 3);
  mock.timers.reset();
});
