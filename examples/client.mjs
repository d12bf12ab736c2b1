// SPDX-License-Identifier: Apache-2.0
// Prints the robot's pose and sends a goal, over the page's WebSocket (docs/page.md).
//
//   npm install @msgpack/msgpack ws; zenav schema --json > schema.json
//   node client.mjs 1.0 0.5 [http://127.0.0.1:8600]
import { readFileSync } from "node:fs";
import WebSocket from "ws";
import { decode, encode, unpack } from "./wire.mjs";

const [x = "1", y = "0", page = "http://127.0.0.1:8600"] = process.argv.slice(2);
const { $defs } = JSON.parse(readFileSync("schema.json", "utf8"));
const socket = new WebSocket(`${page.replace("http", "ws")}/ws`, { origin: page });
let task = -1;

const send = (frame) => socket.send(encode(frame));
const end = (status, words) => {
  console.log(words);
  socket.close();
  process.exitCode = status;
};

socket.on("error", (error) => end(2, `no page at ${page}: ${error.message}`));
socket.on("message", (bytes) => {
  const frame = unpack(bytes);
  if (frame.t === "hello") {
    console.log(`connected to ${frame.robot.name} as ${frame.role}`);
    send({ t: "want", keys: ["pose", "nav/status"] });
    const route = { poses: [[Number(x), Number(y), 0]], dwell: 0, loops: 1, any_heading: true };
    send({ t: "ask", id: 1, request: "request/navigate", args: route });
  } else if (frame.t === "reply" && !frame.accepted) {
    end(1, `refused: ${frame.reason}: ${frame.detail}; hint: ${frame.hint}`);
  } else if (frame.t === "reply") {
    task = Number(frame.data.task_id);
  } else if (frame.t === "m" && frame.k === "pose") {
    const [px, py, yaw] = decode(frame.b, "PoseEstimate", $defs).map_from_base;
    console.log(`pose ${px.toFixed(2)} ${py.toFixed(2)} ${yaw.toFixed(2)}`);
  } else if (frame.t === "m" && frame.k === "nav/status") {
    const status = decode(frame.b, "NavStatus", $defs);
    const isFinal = ["reached", "failed", "canceled"].includes(status.state);
    if (Number(status.task_id) === task && isFinal) end(status.state === "reached" ? 0 : 1, `task ${task} ${status.state}`);
  }
});
