// SPDX-License-Identifier: Apache-2.0
// Choices of this browser, the robot's settings, and the keys.

import { Choice, Field, Section } from "../components/controls";
import { send } from "../connection";
import { language, pageName, theme } from "../preferences";
import { clients, hello } from "../state";
import { t } from "../texts";
import { ConfigurationSection } from "./ConfigurationSection";

const MAX_NAME = 40; // characters, as the server takes it

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
            value={pageName.value}
            placeholder={hello.value?.name ?? ""}
            onChange={(event) => {
              pageName.value = event.currentTarget.value.trim();
              if (pageName.value !== "") send({ t: "name", name: pageName.value });
            }}
          />
        </Field>
        <dl class="facts-list">
          <dt>{t("role")}</dt>
          <dd>{hello.value ? t(`role_${hello.value.role}`) : "–"}</dd>
          <dt>{t("version")}</dt>
          <dd>{hello.value?.version ?? "–"}</dd>
          <dt>{t("pages_open")}</dt>
          <dd>{clients.value.map((client) => client.name).join(", ") || "–"}</dd>
        </dl>
      </Section>
      <ConfigurationSection />
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
