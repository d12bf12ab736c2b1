// SPDX-License-Identifier: Apache-2.0
// Link, battery, teleop arbitration and other pages, in short.

import { isOld, clients, drivers, hello, latest, link, now, rtt } from "../state";
import { t } from "../texts";
import { Icon } from "./Icon";

const MAX_GOOD_RTT_MS = 150;

export function Chips() {
  const battery = latest["base/status"].value?.message.battery;
  const batteryOld = isOld("base/status", now.value);
  const open = link.value.state === "open";
  const slow = rtt.value !== null && rtt.value > MAX_GOOD_RTT_MS;
  const others = clients.value.length;
  const driver = drivers.value?.driver;
  return (
    <div class="chips card" aria-label={t("state_of_link")} role="group">
      <span class={!open ? "chip bad" : slow ? "chip warn" : "chip"} title={t("link_title")}>
        <Icon name="link" size={16} />
        {open ? (rtt.value === null ? "…" : `${rtt.value.toFixed(0)} ms`) : t("offline")}
      </span>
      {battery !== undefined && !Number.isNaN(battery) && (
        <span class={batteryOld ? "chip old" : "chip"} title={t("battery")}>
          <Icon name="battery" size={16} />
          {battery.toFixed(1)} V
        </span>
      )}
      {others > 1 && (
        <span class="chip" title={clients.value.map((client) => client.name).join(", ")}>
          <Icon name="people" size={16} />
          {others}
        </span>
      )}
      {driver ? (
        <span class="chip warn">
          <Icon name="drive" size={16} />
          {driver.client === hello.value?.client ? t("you_drive") : driver.name}
        </span>
      ) : (
        drivers.value?.other && (
          <span class="chip warn">
            <Icon name="drive" size={16} />
            {t("another_tool")}
          </span>
        )
      )}
    </div>
  );
}
