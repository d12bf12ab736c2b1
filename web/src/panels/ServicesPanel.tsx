// SPDX-License-Identifier: Apache-2.0
// Services with state, rate, latency, CPU and memory; and the faults of this session with their time.

import { useSignal } from "@preact/signals";

import { Empty, Section } from "../components/controls";
import { Icon } from "../components/Icon";
import { faults } from "../faults";
import { type Health } from "../messages";
import { health, now, type Received } from "../state";
import { clockText, reasonText, t } from "../texts";
import { capital } from "../why";

const MAX_AGE_S = 3; // health comes once a second

export function ServicesPanel() {
  const rows = [...health.value.entries()].sort(([a], [b]) => a.localeCompare(b));
  return (
    <>
      <section class="section">
        {rows.length === 0 && <Empty text={t("no_data_yet")} />}
        <div class="service-numbers service-head" aria-hidden="true">
          <span>{t("cpu")}</span>
          <span>{t("memory")}</span>
          <span>{t("handler")}</span>
        </div>
        <ul class="list">
          {rows.map(([name, entry]) => (
            <ServiceItem key={name} name={name} entry={entry} />
          ))}
        </ul>
      </section>
      <Section title={t("faults")}>
        {faults.value.length === 0 && <Empty text={t("no_faults")} />}
        <ul class="list">
          {faults.value.map((fault) => (
            <li key={fault.id} class="list-row fault">
              <Icon name={fault.severe ? "stop" : "hold"} size={18} />
              <div class="list-name">
                <span>{capital(reasonText(fault.reason).text)}</span>
                <span class="muted">{[fault.service, fault.detail].filter(Boolean).join(" · ")}</span>
              </div>
              <span class="muted number">
                {clockText(fault.at)}
                {fault.seconds !== null && ` · ${fault.seconds.toFixed(0)} s`}
              </span>
            </li>
          ))}
        </ul>
      </Section>
    </>
  );
}

function ServiceItem({ name, entry }: { name: string; entry: Received<Health> }) {
  const open = useSignal(false);
  const { message, at } = entry;
  const age = (now.value - at) / 1e3;
  const silent = age > MAX_AGE_S;
  const troubled = !silent && message.last_error !== "";
  return (
    <li class="list-item">
      <button type="button" class="service expander" aria-expanded={open.value} onClick={() => (open.value = !open.value)}>
        <span class={`service-mark ${silent ? "silent" : troubled ? "troubled" : "well"}`}>
          <Icon name={silent || troubled ? "warning" : "check"} size={14} />
        </span>
        <span class="list-name">
          <span>{name}</span>
          <span class="muted">{silent ? t("silent_for", { n: age.toFixed(0) }) : message.state}</span>
        </span>
        <span class={silent ? "service-numbers number old" : "service-numbers number"}>
          <span title={t("cpu")}>{(message.cpu * 100).toFixed(0)} %</span>
          <span title={t("memory")}>{message.memory.toFixed(0)} MB</span>
          <span title={t("slowest_handler")}>{message.handler_ms.toFixed(1)} ms</span>
        </span>
      </button>
      {open.value && (
        <div class="list-detail">
          {message.last_error !== "" && <p class="bad-text">{message.last_error}</p>}
          <table class="rates">
            <thead>
              <tr>
                <th scope="col">{t("topic")}</th>
                <th scope="col">Hz</th>
                <th scope="col">{t("age_ms")}</th>
              </tr>
            </thead>
            <tbody>
              {message.rates.map(([topic, hz, old]) => (
                <tr key={topic}>
                  <td>{topic}</td>
                  <td class="number">{hz.toFixed(1)}</td>
                  <td class="number">{(old * 1e3).toFixed(1)}</td>
                </tr>
              ))}
            </tbody>
          </table>
          <p class="muted number">{t("counts", { dropped: message.dropped, bad: message.bad_messages })}</p>
        </div>
      )}
    </li>
  );
}
