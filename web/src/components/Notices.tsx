// SPDX-License-Identifier: Apache-2.0
import { dismiss, notices } from "../notices";
import { t } from "../texts";
import { capital } from "../why";
import { Icon } from "./Icon";

export function Notices() {
  return (
    <div class="notices" role="log" aria-live="polite">
      {notices.value.map(({ id, level, text, hint }) => (
        <div key={id} class={`notice card ${level}`}>
          <Icon name={level === "info" ? "check" : "warning"} />
          <div>
            <p>{capital(text)}</p>
            {hint !== "" && <p class="muted">{capital(hint)}</p>}
          </div>
          <button type="button" class="icon-button small" aria-label={t("close")} onClick={() => dismiss(id)}>
            <Icon name="close" size={16} />
          </button>
        </div>
      ))}
    </div>
  );
}
