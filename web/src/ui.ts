// SPDX-License-Identifier: Apache-2.0
// Which panel is open, and the map that the controls act on.

import { computed, signal } from "@preact/signals";

import { type IconName } from "./components/Icon";
import { hasFleet, isSite } from "./fleet";
import { type MapView } from "./map/map_view";

export const PANELS = ["task", "fleet", "places", "maps", "services", "charts", "log", "recordings", "settings"] as const;
export type PanelName = (typeof PANELS)[number];

export const panel = signal<PanelName | "more" | null>(null);
export const layersOpen = signal(false);
export const mapView = signal<MapView | null>(null);

/** Panels of what does not cross to a site. */
const ROBOT_ONLY: ReadonlySet<PanelName> = new Set(["places", "maps", "recordings"]);

/** The panels of this page: that of a fleet where there is one, and at a site only what crosses. */
export const panels = computed(() =>
  PANELS.filter((name) => (name === "fleet" ? hasFleet.value : !(isSite.value && ROBOT_ONLY.has(name)))),
);

export function togglePanel(name: PanelName | "more"): void {
  panel.value = panel.peek() === name ? null : name;
}

export const PANEL_ICONS: Readonly<Record<PanelName, IconName>> = {
  task: "task",
  fleet: "fleet",
  places: "places",
  maps: "maps",
  services: "services",
  charts: "charts",
  log: "log",
  recordings: "recordings",
  settings: "settings",
};
