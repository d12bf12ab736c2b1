// SPDX-License-Identifier: Apache-2.0
// STOP with one press; release only after a hold of one second, by pointer or by Enter.

import { useSignal } from "@preact/signals";
import { useEffect, useRef } from "preact/hooks";

import { mayOperate, replaying } from "../state";
import { pressStop, releaseStop, stopPending, stopPressed } from "../stop";
import { t } from "../texts";
import { Icon } from "./Icon";

const HOLD_MS = 1000;

export function StopButton() {
  return (
    <div class={stopPressed.value ? "stop-area pressed" : "stop-area"}>
      {stopPressed.value && <ReleaseButton />}
      <button type="button" class="stop-button" onPointerDown={pressStop} onClick={pressStop} aria-keyshortcuts="Space">
        <Icon name="stop" size={24} />
        <span class="stop-word">STOP</span>
        <span class={stopPending.value || stopPressed.value || replaying.value ? "stop-state" : "stop-state idle"} role="status">
          {stopPending.value ? t("stop_pending") : stopPressed.value ? t("stop_holds") : replaying.value ? t("replay_stop") : t("stop_key")}
        </span>
      </button>
    </div>
  );
}

function ReleaseButton() {
  const holding = useSignal(false);
  const timer = useRef<ReturnType<typeof setTimeout>>(undefined);
  const begin = (): void => {
    if (holding.value || !mayOperate.value) return;
    holding.value = true;
    timer.current = setTimeout(() => {
      holding.value = false;
      releaseStop();
    }, HOLD_MS);
  };
  const end = (): void => {
    holding.value = false;
    clearTimeout(timer.current);
  };
  useEffect(() => end, []);
  return (
    <button
      type="button"
      class={holding.value ? "release-button holding" : "release-button"}
      disabled={!mayOperate.value}
      title={mayOperate.value ? "" : t("viewer_note")}
      onPointerDown={begin}
      onPointerUp={end}
      onPointerLeave={end}
      onPointerCancel={end}
      onKeyDown={(event) => {
        if (event.key === "Enter" && !event.repeat) begin();
      }}
      onKeyUp={end}
      onBlur={end}
    >
      {t("release_hold")}
    </button>
  );
}
