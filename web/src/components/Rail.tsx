// SPDX-License-Identifier: Apache-2.0
// The page's navigation: at the left, or at the bottom of a phone, where rarely used panels are behind "more".

import { armed } from "../driving";
import { isSite } from "../fleet";
import { hello, mayOperate } from "../state";
import { t } from "../texts";
import { layersOpen, panel, PANEL_ICONS, panels, togglePanel, type PanelName } from "../ui";
import { Icon, type IconName } from "./Icon";

const ON_PHONE: ReadonlySet<PanelName> = new Set(["task", "fleet", "places"]);

export function Rail() {
  return (
    <nav class="rail" aria-label={t("panels")}>
      <Item label={t("panel_task")} icon="task" pressed={panel.value === "task"} onClick={() => togglePanel("task")} />
      {!isSite.value && (
        <Item
          label={t("panel_drive")}
          icon="drive"
          pressed={armed.value}
          disabled={!mayOperate.value}
          title={hello.value?.role === "viewer" ? t("viewer_note") : ""}
          onClick={() => {
            armed.value = !armed.value;
            layersOpen.value = false; // they share the corner
          }}
        />
      )}
      {panels.value.filter((name) => name !== "task").map((name) => (
        <Item
          key={name}
          label={t(`panel_${name}`)}
          icon={PANEL_ICONS[name]}
          pressed={panel.value === name}
          onClick={() => togglePanel(name)}
          wideOnly={!ON_PHONE.has(name)}
        />
      ))}
      <Item
        label={t("panel_more")}
        icon="more"
        pressed={panel.value !== null && !ON_PHONE.has(panel.value as PanelName)}
        onClick={() => togglePanel("more")}
        phoneOnly
      />
    </nav>
  );
}

interface ItemProps {
  label: string;
  icon: IconName;
  pressed: boolean;
  onClick: () => void;
  disabled?: boolean;
  title?: string;
  wideOnly?: boolean;
  phoneOnly?: boolean;
}

function Item({ label, icon, pressed, onClick, disabled = false, title = "", wideOnly = false, phoneOnly = false }: ItemProps) {
  const places = `${wideOnly ? " wide-only" : ""}${phoneOnly ? " phone-only" : ""}`;
  return (
    <button type="button" class={`rail-item${places}`} aria-pressed={pressed} onClick={onClick} disabled={disabled} title={title}>
      <Icon name={icon} size={21} />
      <span>{label}</span>
    </button>
  );
}
