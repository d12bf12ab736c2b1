// SPDX-License-Identifier: Apache-2.0
// Replies of the mock to `ask` and `do`.

import { float64s } from "./stream.mjs";

const now = Date.now() / 1000;
let maps = [
  { name: "office", size: 2_400_000, modified: now - 86_400 },
  { name: "office_old", size: 1_900_000, modified: now - 9 * 86_400 },
];
let places = [
  { name: "kitchen", pose: [12.6, 5.5, 1.57], map: "office" },
  { name: "dock", pose: [4.6, 9.5, 0], map: "office" },
  { name: "meeting_room", pose: [20.6, 6, -1.57], map: "office" },
];
let recordings = [
  { name: "2026-03-04T09-12-31.mcap", size: 41_000_000, modified: now, marked: false, current: true },
  { name: "2026-03-03T16-40-02.mcap", size: 182_000_000, modified: now - 60_000, marked: true, current: false },
];
const number = { kind: "number", choices: [], low: 0, high: 100, unit: "", is_limit: false };
const settings = [
  ["robot.name", "x80", "robots/x80sv.yaml:4", "the robot's name on the wire", {}],
  ["robot.drive.max_speed", 0.8, "robots/x80sv.yaml:13", "m/s, forward", { ...number, unit: "m/s", is_limit: true }],
  ["planner.cost.clearance_weight", 4.0, "default", "how much clearance counts against length", number],
  ["planner.cost.unknown", "costly", "default", "paths through unknown space", { kind: "choice", choices: ["allowed", "costly"] }],
  ["local_ctrl.costmap.scan", true, "default", "mark and clear by the laser scan", { kind: "switch" }],
  ["guard.view.min_share", 0.2, "--set", "share of beams that must return", {}],
].map(([name, value, origin, description, editor]) => ({ name, value, origin, description, started: value, file: origin, ...editor }));

function setSetting({ name, value }) {
  const row = settings.find((setting) => setting.name === name);
  row.value = value === "" ? row.started : JSON.parse(/^[a-z]+$/.test(value) && row.kind === "choice" ? `"${value}"` : value);
  row.origin = row.value === row.started ? row.file : "set at run time";
}

const ASK = {
  "request/navigate": (robot, { poses }) => {
    if (poses.some(([x, y]) => x < 0 || y < 0 || x > 30 || y > 20)) return refused("goal_outside");
    return robot.navigate(poses);
  },
  "request/explore": (robot) => Object.assign(robot, { nav: "exploring", laps: true, paused: false }) && undefined,
  "request/cancel": (robot) => robot.stop("canceled", "canceled"),
  "request/pause": (robot, { paused }) => void (robot.paused = paused),
  "request/set_zones": (robot, { zones }) => {
    robot.zones = zones.map((zone) => ({ ...zone, xs: float64s(zone.xs), ys: float64s(zone.ys) }));
  },
  "request/edit_map": (robot, { add, remove = [] }) => {
    const kept = robot.edits.filter((edit) => !remove.includes(edit.id));
    const first = Math.max(0, ...kept.map((edit) => edit.id)) + 1;
    robot.edits = [...kept, ...add.map((edit, i) => ({ ...edit, id: first + i, xs: float64s(edit.xs), ys: float64s(edit.ys) }))];
  },
};

const DO = {
  maps: () => ({ data: maps }),
  map_save: (_, { name }) => void (maps = [...maps.filter((m) => m.name !== name), { name, size: 2_500_000, modified: now }]),
  map_load: () => undefined,
  map_rename: (_, { name, to }) => void (maps = maps.map((m) => (m.name === name ? { ...m, name: to } : m))),
  map_delete: (_, { name }) => void (maps = maps.filter((m) => m.name !== name)),
  places: () => ({ data: places }),
  place_set: (_, place) => void (places = [...places.filter((p) => p.name !== place.name), place]),
  place_delete: (_, { name }) => void (places = places.filter((p) => p.name !== name)),
  set_pose: (robot, { pose }) => void (robot.pose = pose),
  recordings: () => ({ data: recordings }),
  recording_mark: () => undefined,
  recording_delete: (_, { name }) => void (recordings = recordings.filter((r) => r.name !== name)),
  settings: () => ({ data: settings }),
  setting_set: (_, order) => void setSetting(order),
  mock_block: (robot, { seconds }) => void (robot.blockedFor = seconds),
};

const refused = (reason) => ({ accepted: false, reason });

export function answer(robot, frame) {
  const act = frame.t === "ask" ? ASK[frame.request] : DO[frame.op];
  return act ? (act(robot, frame.args) ?? {}) : refused("bad_request");
}
