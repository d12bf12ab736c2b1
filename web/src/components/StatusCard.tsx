// SPDX-License-Identifier: Apache-2.0
// Why the robot stands or moves, large, with the hint. It turns grey with its age when the guard is not heard.

import { ageOf, connected, drivers, hello, isOld, latest, now } from "../state";
import { stopPressed } from "../stop";
import { reasonText, t } from "../texts";
import { why, type Tone } from "../why";
import { Icon, type IconName } from "./Icon";

const ICONS: Record<Tone, IconName> = { moving: "play", ready: "check", wait: "hold", stop: "stop", unknown: "unknown" };

export function StatusCard() {
  const guard = latest["guard/status"].value?.message ?? null;
  const driver = drivers.value?.driver;
  const { tone, headline, hint } = why({
    guard,
    nav: latest["nav/status"].value?.message ?? null,
    follow: latest["follow/status"].value?.message ?? null,
    estop: stopPressed.value,
    driver: driver?.client === hello.value?.client && driver ? null : (driver?.name ?? ""),
  });
  const old = isOld("guard/status", now.value);
  const age = ageOf("guard/status", now.value);
  const base = latest["base/status"].value?.message;
  const fault = base && base.fault !== "" ? reasonText(base.fault).text : "";
  return (
    <section class={`status card tone-${old ? "unknown" : tone}`} aria-label={t("status")}>
      <span class="status-icon">
        <Icon name={ICONS[old ? "unknown" : tone]} size={26} />
      </span>
      <div class="status-words" role="status">
        <p class="status-robot">
          {hello.value?.robot.name ?? "zenav"}
          {hello.value?.simulated && <span class="tag">{t("simulated")}</span>}
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
