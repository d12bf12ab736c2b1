// SPDX-License-Identifier: Apache-2.0
// The WebSocket: connects again by itself with growing pauses, sends commands, and hands each frame to `dispatch`.

import { checkSession, needsLogin, SESSION_ENDED } from "./access";
import { notify } from "./notices";
import { type ClientFrame, mayReplaySend, type Reply, type ServerFrame } from "./protocol";
import { clock, connected, hello, link, replaying, rtt } from "./state";
import { decodeMap, encodeFrame, WireError } from "./wire";

const PING_PERIOD_MS = 2000;
const MAX_SILENCE_MS = 6000; // no frame since an unanswered ping: the link is dead though the socket looks open
const REPLY_TIMEOUT_MS = 15_000;

/** Pause before attempt n (from 0), ms: doubles up to 8 s, with up to 20 % added so that pages do not come at once. */
export function retryDelay(n: number, random: number): number {
  return Math.min(8000, 250 * 2 ** n) * (1 + 0.2 * random);
}

let socket: WebSocket | null = null;
let attempts = 0;
let nextId = 1;
let lastFrameAt = 0;
const pings = new Map<number, number>();
const pending = new Map<number, (reply: Reply) => void>();
let dispatch: (frame: ServerFrame) => void = () => undefined;
let retryTimer: ReturnType<typeof setTimeout> | undefined;

/** Begins to connect. `onFrame` gets every frame; pongs and replies are used here first. */
export function start(onFrame: (frame: ServerFrame) => void): void {
  dispatch = onFrame;
  open();
  setInterval(ping, PING_PERIOD_MS);
  window.addEventListener("online", retryNow);
}

/** Connects at once instead of at the end of the pause. */
export function retryNow(): void {
  if (link.peek().state === "waiting") open();
}

/** Sends a frame; false where there is no connection, and for commands during a replay. */
export function send(frame: ClientFrame): boolean {
  if (replaying.peek() && !mayReplaySend(frame)) return false;
  if (socket?.readyState !== WebSocket.OPEN) return false;
  socket.send(encodeFrame(frame));
  return true;
}

/** A request of shared/requests.py, such as "request/navigate". Never rejects: see `accepted`. */
export function ask(request: string, args: object): Promise<Reply> {
  return command((id) => ({ t: "ask", id, request, args }));
}

/** An operation of the server: maps, places, recordings, settings. Never rejects: see `accepted`. */
export function run(op: string, args: object = {}, timeout = REPLY_TIMEOUT_MS): Promise<Reply> {
  return command((id) => ({ t: "do", id, op, args }), timeout);
}

function command(frame: (id: number) => ClientFrame, timeout = REPLY_TIMEOUT_MS): Promise<Reply> {
  const id = nextId++;
  const failed = (reason: string): Reply => ({
    t: "reply",
    id,
    accepted: false,
    reason,
    detail: "",
    hint: "",
    data: null,
  });
  if (replaying.peek() && !mayReplaySend(frame(id))) return Promise.resolve(failed("page_replay"));
  if (!connected.peek() || !send(frame(id))) return Promise.resolve(failed("page_offline"));
  return new Promise((resolve) => {
    const timer = setTimeout(() => settle(failed("page_no_reply")), timeout);
    const settle = (reply: Reply): void => {
      clearTimeout(timer);
      pending.delete(id);
      resolve(reply);
    };
    pending.set(id, settle);
  });
}

function open(): void {
  clearTimeout(retryTimer);
  socket?.close();
  link.value = { ...link.peek(), state: "connecting" };
  const scheme = location.protocol === "https:" ? "wss" : "ws";
  const mine = new WebSocket(`${scheme}://${location.host}/ws${location.search}`);
  socket = mine;
  mine.binaryType = "arraybuffer";
  mine.onopen = () => {
    lastFrameAt = performance.now();
  };
  mine.onmessage = (event) => {
    if (socket === mine) receive(event.data);
  };
  mine.onclose = (event) => {
    if (socket !== mine) return;
    if (event.code === SESSION_ENDED) location.reload(); // it shows the login, and nothing of the robot
    else onClose(event.reason);
  };
}

function onClose(reason: string): void {
  socket = null;
  if (link.peek().state === "connecting") void stopWithoutSession();
  clock.reset();
  rtt.value = null;
  pings.clear();
  const delay = retryDelay(attempts++, Math.random());
  const since = link.peek().state === "open" ? lastFrameAt : link.peek().since;
  link.value = { state: "waiting", retryAt: performance.now() + delay, since };
  if (reason !== "") notify("warning", reason, "");
  for (const settle of [...pending.values()]) {
    settle({ t: "reply", id: 0, accepted: false, reason: "page_offline", detail: "", hint: "", data: null });
  }
  retryTimer = setTimeout(open, delay);
}

/** A connection that never opened may want a login, which no further attempt replaces. */
async function stopWithoutSession(): Promise<void> {
  if (await checkSession()) clearTimeout(retryTimer);
}

function receive(data: unknown): void {
  lastFrameAt = performance.now();
  if (!(data instanceof ArrayBuffer)) return;
  let frame: ServerFrame;
  try {
    frame = decodeMap(new Uint8Array(data)) as unknown as ServerFrame;
  } catch (error) {
    if (error instanceof WireError) return;
    throw error;
  }
  if (frame.t === "hello") {
    attempts = 0;
    needsLogin.value = false;
    hello.value = frame;
    link.value = { state: "open", retryAt: 0, since: performance.now() };
    ping();
  } else if (frame.t === "pong") {
    const sent = pings.get(frame.id);
    pings.delete(frame.id);
    if (sent === undefined) return;
    clock.update(frame.now, sent, lastFrameAt);
    rtt.value = clock.rtt;
  } else if (frame.t === "reply") {
    pending.get(frame.id)?.(frame);
  }
  dispatch(frame);
}

function ping(): void {
  if (socket?.readyState !== WebSocket.OPEN) return;
  const unanswered = pings.values().next().value ?? Infinity;
  if (performance.now() - unanswered > MAX_SILENCE_MS && lastFrameAt < unanswered) {
    const dead = socket;
    onClose(""); // close() alone may take minutes on a dead network
    dead.close();
    return;
  }
  const id = nextId++;
  pings.set(id, performance.now());
  send({ t: "ping", id });
}
