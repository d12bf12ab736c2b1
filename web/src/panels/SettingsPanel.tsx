// SPDX-License-Identifier: Apache-2.0
// Choices of this browser, the robot's settings, and the keys.

import { Account } from "../components/Account";
import { Choice, Field, Section } from "../components/controls";
import { send } from "../connection";
import { language, pageName, theme } from "../preferences";
import { hello } from "../state";
import { t } from "../texts";
import { isSite } from "../fleet";
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
      {!isSite.value && <ConfigurationSection />}
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
