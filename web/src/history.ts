// SPDX-License-Identifier: Apache-2.0
// The last ten minutes of a few numbers, two samples a second, for the charts. A gap is null.

import { signal } from "@preact/signals";

import { health, isOld, latest, rtt } from "./state";

const PERIOD_MS = 500;
export const WINDOW_S = 600;
const MAX_SAMPLES = (WINDOW_S * 1000) / PERIOD_MS;

export const SERIES = ["speed", "command", "rtt", "handler", "quality"] as const;
export type SeriesName = (typeof SERIES)[number];

/** s since 1970 of each sample. */
export const times: number[] = [];
export const samples: Record<SeriesName, (number | null)[]> = { speed: [], command: [], rtt: [], handler: [], quality: [] };
/** Counts samples: charts follow it. */
export const sampled = signal(0);

export function startHistory(): void {
  setInterval(sample, PERIOD_MS);
}

function sample(): void {
  const at = performance.now();
  const handlers = [...health.peek().values()].filter((entry) => at - entry.at < 3000).map((entry) => entry.message.handler_ms);
  const values: Record<SeriesName, number | null> = {
    speed: isOld("odom", at) ? null : latest.odom.peek()!.message.v,
    command: isOld("cmd/vel", at) ? null : latest["cmd/vel"].peek()!.message.v,
    rtt: rtt.peek(),
    handler: handlers.length === 0 ? null : Math.max(...handlers),
    quality: isOld("pose", at) ? null : latest.pose.peek()!.message.quality * 100,
  };
  times.push(Date.now() / 1000);
  for (const name of SERIES) samples[name].push(values[name]);
  if (times.length > MAX_SAMPLES) {
    times.shift();
    for (const name of SERIES) samples[name].shift();
  }
  sampled.value++;
}
