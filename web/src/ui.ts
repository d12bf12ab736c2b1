// SPDX-License-Identifier: Apache-2.0
// Which panel is open, and the map that the controls act on.

import { signal } from "@preact/signals";

import { type IconName } from "./components/Icon";
import { type MapView } from "./map/map_view";

export const PANELS = ["task", "places", "maps", "services", "charts", "log", "recordings", "settings"] as const;
export type PanelName = (typeof PANELS)[number];

export const panel = signal<PanelName | "more" | null>(null);
export const layersOpen = signal(false);
export const mapView = signal<MapView | null>(null);

export function togglePanel(name: PanelName | "more"): void {
  panel.value = panel.peek() === name ? null : name;
}

export const PANEL_ICONS: Readonly<Record<PanelName, IconName>> = {
  task: "task",
  places: "places",
  maps: "maps",
  services: "services",
  charts: "charts",
  log: "log",
  recordings: "recordings",
  settings: "settings",
};
