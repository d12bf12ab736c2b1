// SPDX-License-Identifier: Apache-2.0
// The services' log with a filter by level, service and text; newest first.

import { useSignal } from "@preact/signals";

import { Choice, Empty, Field } from "../components/controls";
import { log } from "../state";
import { clockText, t } from "../texts";

const LEVELS = ["DEBUG", "INFO", "WARNING", "ERROR"] as const;
type Level = (typeof LEVELS)[number];
const MAX_ROWS = 250;

export function LogPanel() {
  const level = useSignal<Level>("INFO");
  const filter = useSignal("");
  const wanted = filter.value.trim().toLowerCase();
  const rows = log.value.filter(
    (line) =>
      LEVELS.indexOf(line.level as Level) >= LEVELS.indexOf(level.value) &&
      `${line.service} ${line.text}`.toLowerCase().includes(wanted),
  );
  return (
    <>
      <Choice
        label={t("level")}
        value={level.value}
        options={LEVELS.map((name) => [name, t(`level_${name}`)] as const)}
        onChange={(value) => (level.value = value)}
      />
      <Field label={t("filter")}>
        <input type="search" value={filter.value} onInput={(event) => (filter.value = event.currentTarget.value)} />
      </Field>
      {rows.length === 0 && <Empty text={t("no_lines")} />}
      <ol class="log" aria-label={t("panel_log")}>
        {rows
          .slice(-MAX_ROWS)
          .reverse()
          .map((line) => (
            <li key={line.id} class={`log-line ${line.level.toLowerCase()}`}>
              <span class="log-time number">{clockText(line.stamp / 1e6)}</span>
              <span class="log-service">{line.service}</span>
              <span class="log-text">{line.text}</span>
            </li>
          ))}
      </ol>
    </>
  );
}
