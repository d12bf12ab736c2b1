// SPDX-License-Identifier: Apache-2.0
// The open panel: beside the rail, or a sheet above it on a phone.

import { type ComponentType } from "preact";

import { ChartsPanel } from "../panels/ChartsPanel";
import { FleetPanel } from "../panels/FleetPanel";
import { LogPanel } from "../panels/LogPanel";
import { MapsPanel } from "../panels/MapsPanel";
import { PlacesPanel } from "../panels/PlacesPanel";
import { RecordingsPanel } from "../panels/RecordingsPanel";
import { ServicesPanel } from "../panels/ServicesPanel";
import { SettingsPanel } from "../panels/SettingsPanel";
import { TaskPanel } from "../panels/TaskPanel";
import { t } from "../texts";
import { panel, PANEL_ICONS, panels, type PanelName } from "../ui";
import { IconButton } from "./controls";
import { Icon } from "./Icon";
import { RoleNote } from "./RoleNote";

const CONTENT: Readonly<Record<PanelName, ComponentType>> = {
  task: TaskPanel,
  fleet: FleetPanel,
  places: PlacesPanel,
  maps: MapsPanel,
  services: ServicesPanel,
  charts: ChartsPanel,
  log: LogPanel,
  recordings: RecordingsPanel,
  settings: SettingsPanel,
};

const ON_RAIL: ReadonlySet<PanelName> = new Set(["task", "fleet", "places"]); // of a phone

export function Panel() {
  const name = panel.value;
  if (name === null) return null;
  const Content = name === "more" ? MoreMenu : CONTENT[name];
  return (
    <aside class={`panel card panel-${name}`} aria-label={t(`panel_${name}`)}>
      <header class="panel-head">
        <h2>{t(`panel_${name}`)}</h2>
        <IconButton label={t("close")} icon="close" onClick={() => (panel.value = null)} />
      </header>
      <div class="panel-body">
        <RoleNote panel={name} />
        <Content />
      </div>
    </aside>
  );
}

function MoreMenu() {
  return (
    <div class="more-menu">
      {panels.value.filter((name) => !ON_RAIL.has(name)).map((name) => (
        <button key={name} type="button" class="more-item" onClick={() => (panel.value = name)}>
          <Icon name={PANEL_ICONS[name]} size={22} />
          <span>{t(`panel_${name}`)}</span>
        </button>
      ))}
    </div>
  );
}
