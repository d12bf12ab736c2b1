// SPDX-License-Identifier: Apache-2.0
// The stick for teleoperation. The robot moves while it is held; every end of the touch lets go.

import { useSignal } from "@preact/signals";
import { useEffect, useRef } from "preact/hooks";

import { armed, command, speedShare, teleop } from "../driving";
import { drivers, hello, latest, mayOperate } from "../state";
import { t } from "../texts";
import { Icon } from "./Icon";
import { IconButton } from "./controls";

const RADIUS_PX = 68; // of the way of the knob

export function TeleopPad() {
  if (!armed.value) return null;
  const driver = drivers.value?.driver;
  const other = driver && driver.client !== hello.value?.client ? driver.name : drivers.value?.other ? t("another_tool") : "";
  const odom = latest.odom.value?.message;
  return (
    <section class="teleop card" aria-label={t("drive_by_hand")}>
      <header class="teleop-head">
        <h2>{t("drive_by_hand")}</h2>
        <IconButton label={t("close")} icon="close" onClick={() => (armed.value = false)} />
      </header>
      <Stick />
      <p class="teleop-speed">
        {(odom?.v ?? 0).toFixed(2)} m/s <span class="muted">· {((odom?.w ?? 0) * (180 / Math.PI)).toFixed(0)} °/s</span>
      </p>
      <label class="teleop-share">
        <span class="field-label">
          {t("top_speed")} {(speedShare.value * (hello.value?.robot.max_speed ?? 0)).toFixed(2)} m/s
        </span>
        <input
          type="range"
          min="0.1"
          max="1"
          step="0.05"
          value={speedShare.value}
          onInput={(event) => (speedShare.value = Number(event.currentTarget.value))}
        />
      </label>
      <p class="muted teleop-help">{other ? t("driven_by", { name: other }) : t("teleop_help")}</p>
    </section>
  );
}

function Stick() {
  const knob = useSignal({ x: 0, y: 0 });
  const pointer = useRef<number | null>(null);
  const end = (): void => {
    pointer.current = null;
    knob.value = { x: 0, y: 0 };
    teleop.release("stick");
  };
  const move = (event: PointerEvent): void => {
    if (event.pointerId !== pointer.current) return;
    const box = (event.currentTarget as HTMLElement).getBoundingClientRect();
    const x = event.clientX - box.left - box.width / 2;
    const y = event.clientY - box.top - box.height / 2;
    const shrink = Math.min(1, RADIUS_PX / Math.max(1, Math.hypot(x, y)));
    knob.value = { x: x * shrink, y: y * shrink };
    teleop.hold("stick", { forward: (0 - y * shrink) / RADIUS_PX, turn: (0 - x * shrink) / RADIUS_PX });
  };
  useEffect(() => end, []);
  useEffect(() => {
    if (command.value === null && pointer.current !== null) end(); // let go by blur or STOP
  }, [command.value]);
  return (
    <div
      class={command.value ? "stick active" : "stick"}
      aria-hidden="true"
      onPointerDown={(event) => {
        if (pointer.current !== null || !mayOperate.value) return;
        event.currentTarget.setPointerCapture(event.pointerId);
        pointer.current = event.pointerId;
        move(event);
      }}
      onPointerMove={move}
      onPointerUp={end}
      onPointerCancel={end}
      onLostPointerCapture={end}
    >
      <span class="stick-ahead"><Icon name="up" /></span>
      <span class="stick-knob" style={{ transform: `translate(${knob.value.x}px, ${knob.value.y}px)` }} />
    </div>
  );
}
