// SPDX-License-Identifier: Apache-2.0
// A recording on the page: its messages, tiles and trail beside the live ones, which go on unseen.

import { batch } from "@preact/signals";

import { run } from "./connection";
import { armed } from "./driving";
import { report } from "./map/commands";
import { replayTrack, setRecordedRobot } from "./map/robot_pose";
import { cancelDrawing } from "./map/tools";
import { type Odometry } from "./messages";
import { notify } from "./notices";
import { type OpenedReplay, type ReplayState, trailUntil } from "./records";
import { ReplayPlayer, REPLAY_TICK_MS } from "./replay_player";
import { replayed, replaying, replayStamp, type SingleKey, topicOf } from "./state";
import { t } from "./texts";
import { mapView, panel } from "./ui";
import { decodeMessage, WireError } from "./wire";

export const player = new ReplayPlayer(run, { begin, show, end, refuse: (reply) => void report(reply) });

/** Lets time pass in a replay. To be called once. */
export function startReplays(): void {
  let last = performance.now();
  setInterval(() => {
    const at = performance.now();
    player.tick(at - last);
    last = at;
  }, REPLAY_TICK_MS);
}

function begin(opened: OpenedReplay): void {
  armed.value = false;
  cancelDrawing();
  panel.value = null;
  setRecordedRobot(opened.robot);
  for (const key of Object.values(replayed)) key.value = null;
  replayTrack.set([], []);
  replaying.value = true;
  mapView.peek()?.beginReplay();
  if (opened.problems.length > 0) notify("warning", t("replay_damaged"), opened.problems.join(" · "));
}

function end(): void {
  replaying.value = false;
  mapView.peek()?.endReplay();
}

function show(state: ReplayState): void {
  if (state.messages.length > 0) showMessages(state);
  mapView.peek()?.onReplayTiles(state.tiles);
}

function showMessages(state: ReplayState): void {
  const newest = new Map<SingleKey, unknown>();
  const odometry: Odometry[] = [];
  for (const [key, bytes] of state.messages) {
    const topic = topicOf(key);
    if (topic === null || topic === "health" || topic === "log") continue;
    try {
      const message = decodeMessage(topic, bytes);
      newest.set(topic, { message, at: 0 });
      if (topic === "odom") odometry.push(message as Odometry);
    } catch (error) {
      if (!(error instanceof WireError)) throw error; // a message of another version is left out
    }
  }
  batch(() => {
    replayStamp.value = state.stamp;
    for (const key of Object.keys(replayed) as SingleKey[]) {
      (replayed[key] as { value: unknown }).value = newest.get(key) ?? null;
    }
    const trail = player.opened.peek()?.trail ?? [];
    replayTrack.set(odometry, trailUntil(trail, state.tiles.began, state.t));
  });
}
