// SPDX-License-Identifier: Apache-2.0
// The user of this page and those of the others, and the logout.

import { logOut } from "../access";
import { clients, hello } from "../state";
import { t } from "../texts";
import { Button } from "./controls";

export function Account() {
  const me = hello.value;
  const pages = clients.value.map((client) => `${client.name} (${t(`role_${client.role}`)})`);
  return (
    <>
      <dl class="facts-list">
        <dt>{t("role")}</dt>
        <dd>{me ? t(`role_${me.role}`) : "–"}</dd>
        <dt>{t("version")}</dt>
        <dd>{me?.version ?? "–"}</dd>
        <dt>{t("pages_open")}</dt>
        <dd>{pages.join(", ") || "–"}</dd>
      </dl>
      {me?.login && <Button label={t("log_out")} onClick={() => void logOut(me.csrf)} />}
    </>
  );
}
