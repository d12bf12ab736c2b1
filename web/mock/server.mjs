// SPDX-License-Identifier: Apache-2.0
// A stand-in for services/dashboard: static files and a made-up robot. `npm run mock`, then http://127.0.0.1:8690.
// ?large=4000 in the page's address is not needed: `node mock/server.mjs --large 4000` serves a map of 4000 x 4000 cells.

import { decode, encode } from "@msgpack/msgpack";
import { createReadStream, existsSync, readFileSync } from "node:fs";
import { createServer } from "node:http";
import { dirname, extname, join, normalize } from "node:path";
import { fileURLToPath } from "node:url";
import { WebSocketServer } from "ws";

import { answer } from "./answers.mjs";
import { Robot } from "./robot.mjs";
import { events, fast, health, KEYS, logLine, medium, slow } from "./stream.mjs";
import { ALL_TILES, largeTiles, tilesFrame } from "./world.mjs";

const HERE = dirname(fileURLToPath(import.meta.url));
const STATIC = join(HERE, "..", "..", "services", "dashboard", "static");
const option = (name, otherwise) => Number(process.argv[process.argv.indexOf(name) + 1] ?? NaN) || otherwise;
const PORT = process.argv.includes("--port") ? option("--port", 8690) : 8690;
const LARGE = process.argv.includes("--large") ? option("--large", 4000) : 0;
const TYPES = { ".html": "text/html", ".js": "text/javascript", ".css": "text/css", ".svg": "image/svg+xml", ".txt": "text/plain" };
const MAX_PART = 64; // tiles in a frame
const MAX_UNSENT = 1_000_000; // bytes: a slow page gets fewer messages

const robot = new Robot();
const pages = new Map();
let nextClient = 1;

const server = createServer((request, response) => {
  const path = new URL(request.url, "http://mock").pathname;
  const file = normalize(join(STATIC, path === "/" ? "index.html" : path.replace(/^\/static\//, "")));
  if (!file.startsWith(STATIC) || !existsSync(file)) return response.writeHead(404).end("not found");
  response.writeHead(200, {
    "Content-Type": TYPES[extname(file)] ?? "application/octet-stream",
    "Content-Security-Policy": "default-src 'self'; frame-ancestors 'none'; base-uri 'none'; form-action 'self'",
    "X-Content-Type-Options": "nosniff",
  });
  return createReadStream(file).pipe(response);
});

new WebSocketServer({ server, path: "/ws", maxPayload: 65536 }).on("connection", (socket) => {
  const client = nextClient++;
  const page = { client, name: `page ${client}`, socket, keys: new Set(), hasMap: false };
  pages.set(client, page);
  send(page, hello(page));
  drivers();
  clients();
  socket.on("message", (data) => onFrame(page, decode(data)));
  socket.on("close", () => {
    pages.delete(client);
    if (robot.teleop.client === client) robot.teleop = { at: -1, v: 0, w: 0, client: null };
    drivers();
    clients();
  });
});

function hello({ client, name }) {
  const text = readFileSync(join(HERE, "..", "..", "shared", "reasons.py"), "utf8");
  const rows = [...text.matchAll(/Reason\("(\w+)", "([^"]*)", "([^"]*)", "(\w+)"\)/g)];
  const outline = [[0.2, -0.085], [0.2, 0.085], [0.085, 0.2], [-0.085, 0.2], [-0.2, 0.085], [-0.2, -0.085], [-0.085, -0.2], [0.085, -0.2]];
  return {
    t: "hello", client, name, role: "admin", login: false, simulated: true, version: "mock", csrf: "mock", keys: KEYS,
    robot: { name: "x80", outline, laser_mount: [0.13, 0, -Math.PI / 2], max_speed: 0.8, max_reverse_speed: 0.3, max_turn_rate: 2 },
    reasons: Object.fromEntries(rows.map(([, code, words, hint, severity]) => [code, [words, hint, severity]])),
  };
}

function onFrame(page, frame) {
  if (frame.t === "want") {
    page.keys = new Set(frame.keys);
    publish(events(robot), page);
    if (page.keys.has("map") && !page.hasMap) sendMap(page);
  } else if (frame.t === "teleop") {
    robot.teleop = { at: performance.now(), v: frame.v, w: frame.w, client: page.client };
    drivers();
  } else if (frame.t === "let_go") {
    robot.teleop = { at: -1, v: 0, w: 0, client: null };
    drivers();
  } else if (frame.t === "stop" || frame.t === "release") {
    robot.estop = frame.t === "stop";
    if (robot.estop) robot.stop("canceled", "estop");
    publish(events(robot));
  } else if (frame.t === "name") {
    page.name = frame.name;
    clients();
  } else if (frame.t === "ping") {
    send(page, { t: "pong", id: frame.id, now: BigInt(Date.now()) * 1000000n });
  } else if (frame.t === "ask" || frame.t === "do") {
    const reply = { accepted: true, reason: "", detail: "", hint: "", data: null, ...answer(robot, frame) };
    setTimeout(() => send(page, { t: "reply", id: frame.id, ...reply }), 60);
    publish(events(robot));
  }
}

function sendMap(page) {
  page.hasMap = true;
  if (LARGE) for (const frame of largeTiles(LARGE)) send(page, frame);
  else for (let i = 0; i < ALL_TILES.length; i += MAX_PART) send(page, tilesFrame(ALL_TILES.slice(i, i + MAX_PART), i === 0));
}

function send(page, frame) {
  if (page.socket.readyState === 1) page.socket.send(encode(frame, { useBigInt64: true }));
}

function broadcast(frame) {
  for (const page of pages.values()) send(page, frame);
}

function publish(messages, only) {
  for (const page of only ? [only] : pages.values()) {
    if (page.socket.bufferedAmount > MAX_UNSENT) continue;
    for (const [k, b] of Object.entries(messages)) if (page.keys.has(k)) send(page, { t: "m", k, b });
  }
}

let shown = "";
function drivers() {
  const page = pages.get(robot.teleop.client);
  const frame = { t: "drivers", driver: page ? { client: page.client, name: page.name } : null, other: false, source: robot.guard(performance.now()).source };
  if (JSON.stringify(frame) !== shown) broadcast(frame);
  shown = JSON.stringify(frame);
}

function clients() {
  broadcast({ t: "clients", clients: [...pages.values()].map(({ client, name }) => ({ client, name, role: "admin" })) });
}

setInterval(() => {
  robot.step(performance.now(), 0.02);
  publish(fast(robot));
}, 20);
setInterval(() => publish(medium(robot, performance.now())), 100);
setInterval(() => publish(slow(robot)), 250);
setInterval(() => {
  publish(health());
  drivers();
}, 1000);
setInterval(() => {
  if (!LARGE) for (const page of pages.values()) if (page.hasMap) send(page, tilesFrame([ALL_TILES[Math.floor(Math.random() * 60)]], false, Math.random()));
}, 500);
const LINES = [["INFO", "mapper", "keyframe 214: 3 constraints, 1 closure"], ["INFO", "planner", "plan of 14.2 m in 11 ms"], ["WARNING", "lidar_driver", "a sweep without a start mark"], ["DEBUG", "local_ctrl", "2 of 400 rollouts are free"], ["ERROR", "recorder", "part 7 is not closed: the disk is slow"]];
let line = 0;
setInterval(() => {
  const [level, name, text] = LINES[line++ % LINES.length];
  publish({ [`log/${name}`]: logLine(level, text) });
}, 1500);

server.listen(PORT, "127.0.0.1", () => process.stdout.write(`http://127.0.0.1:${PORT}\n`));
