// SPDX-License-Identifier: Apache-2.0
// The page: the map over all of it, panels above.

import { effect } from "@preact/signals";
import { useEffect, useLayoutEffect, useRef } from "preact/hooks";

import { needsLogin } from "./access";
import { Chips } from "./components/Chips";
import { LoginView } from "./components/LoginView";
import { MapControls, Toolbar } from "./components/MapControls";
import { Notices } from "./components/Notices";
import { OfflineBanner } from "./components/OfflineBanner";
import { Panel } from "./components/Panel";
import { Rail } from "./components/Rail";
import { ReplayBand } from "./components/ReplayBand";
import { StatusCard } from "./components/StatusCard";
import { StopButton } from "./components/StopButton";
import { TeleopPad } from "./components/TeleopPad";
import { armed } from "./driving";
import { installGestures } from "./map/gestures";
import { MapView } from "./map/map_view";
import { closedPolygon, newPlace, tool } from "./map/tools";
import { connected, replaying } from "./state";
import { t } from "./texts";
import { mapView, panel } from "./ui";

export function App() {
  const classes = [
    "app",
    connected.value ? "" : "is-offline",
    panel.value === null ? "" : "has-panel",
    armed.value ? "has-teleop" : "",
    tool.value === "look" ? "" : "has-tool",
    replaying.value ? "is-replay" : "",
  ];
  useEffect(
    () =>
      effect(() => {
        const onPhone = matchMedia("(max-width: 720px)").matches;
        if (onPhone && tool.value !== "look") panel.value = null; // its sheet would cover the map
        if (newPlace.value !== null || closedPolygon.value !== null) panel.value = "places"; // its form asks for the name
      }),
    [],
  );
  if (needsLogin.value) {
    return (
      <div class="app">
        <LoginView />
        <Notices />
      </div>
    );
  }
  return (
    <div class={classes.filter(Boolean).join(" ")}>
      <MapCanvas />
      {!replaying.value && <Rail />}
      <StatusCard />
      <div class="corner">
        {!replaying.value && <Chips />}
        <StopButton />
      </div>
      {!replaying.value && <Panel />}
      <MapControls />
      <Toolbar />
      <TeleopPad />
      <ReplayBand />
      <Notices />
      <OfflineBanner />
    </div>
  );
}

function MapCanvas() {
  const below = useRef<HTMLCanvasElement>(null);
  const above = useRef<HTMLCanvasElement>(null);
  useLayoutEffect(() => {
    if (below.current === null || above.current === null) return;
    const map = new MapView(below.current, above.current);
    installGestures(map, above.current);
    mapView.value = map;
  }, []);
  return (
    <main class="map">
      <canvas ref={below} class="map-canvas" aria-hidden="true" />
      <canvas
        ref={above}
        class={`map-canvas map-overlay tool-${tool.value}`}
        tabIndex={0}
        role="application"
        aria-label={t("map_label")}
      />
      <span class="crosshair" aria-hidden="true" />
    </main>
  );
}
