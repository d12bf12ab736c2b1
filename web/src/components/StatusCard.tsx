// SPDX-License-Identifier: Apache-2.0
// Why the robot stands or moves, large, with the hint. It turns grey with its age when the guard is not heard.

import { shownRobot } from "../map/robot_pose";
import { connected, drivers, hello, isShownOld, now, replaying, replayStamp, shown, shownAge } from "../state";
import { reasonText, t } from "../texts";
import { why, type Tone } from "../why";
import { Icon, type IconName } from "./Icon";

const ICONS: Record<Tone, IconName> = { moving: "play", ready: "check", wait: "hold", stop: "stop", unknown: "unknown" };

export function StatusCard() {
  void replayStamp.value; // ages follow it
  const guard = shown["guard/status"].value?.message ?? null;
  const driver = drivers.value?.driver;
  const { tone, headline, hint } = why({
    guard,
    nav: shown["nav/status"].value?.message ?? null,
    follow: shown["follow/status"].value?.message ?? null,
    estop: shown.estop.value?.message.pressed === true,
    driver: replaying.value ? "" : driver?.client === hello.value?.client && driver ? null : (driver?.name ?? ""),
  });
  const old = isShownOld("guard/status", now.value);
  const age = shownAge("guard/status", now.value);
  const base = shown["base/status"].value?.message;
  const fault = base && base.fault !== "" ? reasonText(base.fault).text : "";
  return (
    <section class={`status card tone-${old ? "unknown" : tone}`} aria-label={t("status")}>
      <span class="status-icon">
        <Icon name={ICONS[old ? "unknown" : tone]} size={26} />
      </span>
      <div class="status-words" role="status">
        <p class="status-robot">
          {shownRobot()?.name ?? "zenav"}
          {replaying.value && <span class="tag">{t("replay")}</span>}
          {!replaying.value && hello.value?.simulated && <span class="tag">{t("simulated")}</span>}
        </p>
        <p class={old ? "status-headline old" : "status-headline"}>
          {old && guard ? t("last_known", { text: headline }) : headline}
        </p>
        {old && age !== null && connected.value && <p class="status-hint">{t("data_is_old", { n: age.toFixed(0) })}</p>}
        {!old && (hint || fault) && <p class="status-hint">{[fault, hint].filter(Boolean).join(" · ")}</p>}
      </div>
    </section>
  );
}
