// SPDX-License-Identifier: Apache-2.0
// Choices of this browser, and the robot's settings with their origin, read-only.

import { useComputed, useSignal } from "@preact/signals";
import { useEffect } from "preact/hooks";

import { Account } from "../components/Account";
import { Choice, Empty, Field, Section } from "../components/controls";
import { send } from "../connection";
import { loadSettings, settings } from "../lists";
import { language, pageName, theme } from "../preferences";
import { hello } from "../state";
import { t } from "../texts";

const MAX_NAME = 40; // characters, as the server takes it
const MAX_ROWS = 120; // shown at once: a filter finds the others

export function SettingsPanel() {
  return (
    <>
      <Section title={t("this_page")}>
        <Choice
          label={t("theme")}
          value={theme.value}
          options={[
            ["system", t("theme_system")],
            ["light", t("theme_light")],
            ["dark", t("theme_dark")],
          ]}
          onChange={(value) => (theme.value = value)}
        />
        <Choice
          label={t("language")}
          value={language.value}
          options={[
            ["en", "English"],
            ["de", "Deutsch"],
          ]}
          onChange={(value) => (language.value = value)}
        />
        <Field label={t("page_name")}>
          <input
            type="text"
            maxLength={MAX_NAME}
            value={hello.value?.login ? hello.value.name : pageName.value}
            disabled={hello.value?.login ?? false}
            placeholder={hello.value?.name ?? ""}
            onChange={(event) => {
              pageName.value = event.currentTarget.value.trim();
              if (pageName.value !== "") send({ t: "name", name: pageName.value });
            }}
          />
        </Field>
        <Account />
      </Section>
      <Configuration />
      <Section title={t("keys")}>
        <dl class="keys">
          {KEYS.map(([keys, text]) => (
            <div key={keys}>
              <dt>
                {keys.split(" ").map((key) => (
                  <kbd key={key}>{key}</kbd>
                ))}
              </dt>
              <dd>{t(text)}</dd>
            </div>
          ))}
        </dl>
      </Section>
    </>
  );
}

const KEYS = [
  ["Space", "key_stop"],
  ["W A S D", "key_drive"],
  ["+ −", "key_zoom"],
  ["Q E", "key_turn"],
  ["F", "key_follow"],
  ["Enter", "key_enter"],
  ["Esc", "key_escape"],
] as const;

function Configuration() {
  useEffect(() => void loadSettings(), []);
  const filter = useSignal("");
  const rows = useComputed(() => {
    const wanted = filter.value.trim().toLowerCase();
    return (settings.value ?? []).filter((row) => `${row.name} ${row.description}`.toLowerCase().includes(wanted));
  });
  return (
    <Section title={t("configuration")}>
      <Field label={t("filter")}>
        <input type="search" value={filter.value} onInput={(event) => (filter.value = event.currentTarget.value)} />
      </Field>
      {settings.value === null && <Empty text={t("loading")} />}
      <ul class="list">
        {rows.value.slice(0, MAX_ROWS).map((row) => (
          <li key={row.name} class="setting">
            <div class="setting-line">
              <span class="setting-name">{row.name}</span>
              <span class="setting-value number">{row.value}</span>
            </div>
            <span class="muted">{[row.description, row.origin].filter(Boolean).join(" · ")}</span>
          </li>
        ))}
      </ul>
      {rows.value.length > MAX_ROWS && <Empty text={t("more_rows", { n: rows.value.length - MAX_ROWS })} />}
    </Section>
  );
}
