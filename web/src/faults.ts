// SPDX-License-Identifier: Apache-2.0
// The stops of this session with their time and how long they held, from the guard's and the base's status.

import { effect, signal } from "@preact/signals";

import { latest } from "./state";

export interface Fault {
  readonly id: number;
  readonly service: "guard" | "base";
  readonly reason: string;
  readonly detail: string;
  /** ms since 1970, in this browser. */
  readonly at: number;
  /** s that it held; null while it does. */
  readonly seconds: number | null;
  readonly severe: boolean;
}

const MAX_FAULTS = 100;

export const faults = signal<readonly Fault[]>([]);
let n = 0;

/** Begins and ends faults as their reasons come and go. To be called once. */
export function watchFaults(): void {
  effect(() => {
    const guard = latest["guard/status"].value?.message;
    if (guard === undefined) return;
    const stands = guard.state === "stopped" || guard.state === "fault" || guard.state === "hold";
    update("guard", stands ? guard.reason : "", guard.detail, guard.state !== "hold");
  });
  effect(() => {
    const base = latest["base/status"].value?.message;
    if (base !== undefined) update("base", base.fault, base.detail, true);
  });
}

function update(service: Fault["service"], reason: string, detail: string, severe: boolean): void {
  const rows = faults.peek();
  const open = rows.find((row) => row.service === service && row.seconds === null);
  if ((open?.reason ?? "") === reason) return;
  const at = Date.now();
  const ended = rows.map((row) => (row === open ? { ...row, seconds: (at - row.at) / 1e3 } : row));
  const begun: Fault[] = reason === "" ? [] : [{ id: ++n, service, reason, detail, at, seconds: null, severe }];
  faults.value = [...begun, ...ended].slice(0, MAX_FAULTS);
}
