// SPDX-License-Identifier: Apache-2.0
import { render } from "preact";

import "./style/app.css";
import { logInByAddress } from "./access";
import { App } from "./App";
import { start } from "./connection";
import { dispatcher, watchWants } from "./dispatch";
import { isTextInput, startDriving } from "./driving";
import { watchFaults } from "./faults";
import { watchStopAll } from "./fleet";
import { startHistory } from "./history";
import { onViewKey } from "./map/gestures";
import { applyPreferences } from "./preferences";
import { startReplays } from "./replay";
import { now } from "./state";
import { pressStop, watchStop } from "./stop";
import { layersOpen, mapView } from "./ui";

const NOW_PERIOD_MS = 250;

applyPreferences();
render(<App />, document.body);
watchWants();
watchStop();
watchStopAll();
watchFaults();
startDriving();
startHistory();
startReplays();
setInterval(() => (now.value = performance.now()), NOW_PERIOD_MS);

// Space is STOP wherever the focus is, except in a field of text. Buttons are worked with Enter.
window.addEventListener(
  "keydown",
  (event) => {
    if (event.code !== "Space" || isTextInput(event.target)) return;
    event.preventDefault();
    if (!event.repeat) pressStop();
  },
  { capture: true },
);
window.addEventListener(
  "keyup",
  (event) => {
    if (event.code === "Space" && !isTextInput(event.target)) event.preventDefault(); // no click on the focused button
  },
  { capture: true },
);
window.addEventListener("keydown", (event) => {
  const plain = !event.ctrlKey && !event.metaKey && !event.altKey && !event.defaultPrevented;
  const map = mapView.peek();
  if (event.key === "Escape") layersOpen.value = false;
  if (plain && map !== null && !isTextInput(event.target) && onViewKey(map, event)) event.preventDefault();
});

// A link that is opened in a page that is open already changes its address only.
window.addEventListener("hashchange", () => void logInByAddress().then((isIn) => isIn && location.reload()));
void logInByAddress().then(() => start(dispatcher((frame) => mapView.peek()?.onTiles(frame))));
