// SPDX-License-Identifier: Apache-2.0
// Says large that the link is lost, since when, and when the next attempt is.

import { needsLogin } from "../access";
import { retryNow } from "../connection";
import { hello, link, now } from "../state";
import { stopPending } from "../stop";
import { t } from "../texts";
import { Button } from "./controls";

const GRACE_MS = 400; // a link that comes up at once needs no banner

export function OfflineBanner() {
  const { state, retryAt, since } = link.value;
  if (needsLogin.value || state === "open" || (hello.value === null && now.value < GRACE_MS)) return null;
  const seconds = Math.max(0, Math.ceil((retryAt - now.value) / 1000));
  const lost = ((now.value - since) / 1000).toFixed(0);
  return (
    <div class="offline" role="alert">
      <p class="offline-title">{hello.value === null ? t("connecting") : t("link_lost")}</p>
      <p>{state === "waiting" ? t("retry_in", { n: seconds }) : t("connecting_now")}</p>
      {hello.value !== null && <p>{t("data_from", { n: lost })}</p>}
      {stopPending.value && <p class="offline-stop">{t("stop_waits")}</p>}
      {state === "waiting" && <Button label={t("retry_now")} onClick={retryNow} kind="primary" />}
    </div>
  );
}
