// SPDX-License-Identifier: Apache-2.0
// STOP: sent at once, again until the robot confirms it, and first of all after a lost link comes back.

import { computed, effect, signal } from "@preact/signals";

import { send } from "./connection";
import { isSite } from "./fleet";
import { connected, latest } from "./state";
import { letGo } from "./driving";

const REPEAT_MS = 250;

/** STOP was pressed here and the robot has not confirmed it. */
export const stopPending = signal(false);
/** Whether STOP holds. `estop` does not cross to a site: there the guard says it. */
export const stopPressed = computed(() =>
  isSite.value ? latest["guard/status"].value?.message.state === "stopped" : latest.estop.value?.message.pressed === true,
);

let pressedAt = 0;

export function pressStop(): void {
  letGo();
  stopPending.value = true;
  pressedAt = performance.now();
  send({ t: "stop" });
}

/** Releases STOP. It never moves the robot. */
export function releaseStop(): void {
  stopPending.value = false;
  send({ t: "release" });
}

/** Repeats an unconfirmed STOP. To be called once. */
export function watchStop(): void {
  effect(() => {
    const estop = latest.estop.value;
    const guard = latest["guard/status"].value;
    const published = estop !== null && estop.message.pressed && estop.at >= pressedAt;
    const confirmed = guard !== null && guard.message.reason === "estop" && guard.at >= pressedAt;
    if (published || confirmed) stopPending.value = false;
  });
  effect(() => {
    if (!stopPending.value || !connected.value) return undefined;
    send({ t: "stop" });
    const timer = setInterval(() => send({ t: "stop" }), REPEAT_MS);
    return () => clearInterval(timer);
  });
}
