// SPDX-License-Identifier: Apache-2.0
// The task: go to a place or to coordinates, drive a route, explore, pause, cancel.

import { useSignal } from "@preact/signals";

import { Button, Empty, Field, IconButton, Section, Switch } from "../components/controls";
import { degrees, radians } from "../geometry";
import { cancel, explore, goTo, pause, startRoute } from "../map/commands";
import { chooseTool, moveWaypoint, places, removeWaypoint, route, setDwell, tool } from "../map/tools";
import { latest, mayOperate } from "../state";
import { t } from "../texts";

export function TaskPanel() {
  const state = latest["nav/status"].value?.message.state;
  const busy = state === "navigating" || state === "exploring" || state === "recovering" || state === "paused";
  const off = !mayOperate.value;
  return (
    <>
      <div class="button-row">
        {state === "paused" ? (
          <Button label={t("resume")} icon="play" kind="primary" onClick={() => void pause(false)} disabled={off} />
        ) : (
          <Button label={t("pause")} icon="pause" onClick={() => void pause(true)} disabled={off || !busy} />
        )}
        <Button label={t("cancel_task")} icon="close" onClick={() => void cancel()} disabled={off || !busy} />
        <Button label={t("explore")} icon="explore" onClick={() => void explore()} disabled={off} />
      </div>
      <RouteEditor />
      <PlaceList />
      <Coordinates />
    </>
  );
}

function PlaceList() {
  return (
    <Section title={t("go_to_place")}>
      {places.value.length === 0 && <Empty text={t("no_places")} />}
      <ul class="list">
        {places.value.map((place) => (
          <li key={`${place.map}/${place.name}`} class="list-row">
            <span class="list-name">
              {place.name}
              {place.map !== "" && <span class="muted"> {place.map}</span>}
            </span>
            <Button
              label={t("go")}
              onClick={() => void goTo(place.pose, !place.hasHeading)}
              disabled={!mayOperate.value}
            />
          </li>
        ))}
      </ul>
    </Section>
  );
}

function RouteEditor() {
  const loop = useSignal(false);
  const rows = route.value;
  return (
    <Section title={t("route")}>
      {rows.length === 0 && <Empty text={t("route_empty")} />}
      <ol class="list">
        {rows.map(({ id, pose, dwell }, i) => (
          <li key={id} class="list-row route-row">
            <span class="route-number">{i + 1}</span>
            <span class="list-name number">
              {pose[0].toFixed(1)}, {pose[1].toFixed(1)}
            </span>
            <label class="dwell">
              <input
                type="number"
                min="0"
                max="3600"
                value={dwell}
                aria-label={t("dwell_at", { n: i + 1 })}
                onInput={(event) => setDwell(i, Math.max(0, event.currentTarget.valueAsNumber || 0))}
              />
              <span class="muted">s</span>
            </label>
            <IconButton label={t("earlier")} icon="up" disabled={i === 0} onClick={() => moveWaypoint(i, -1)} />
            <IconButton label={t("later")} icon="down" disabled={i === rows.length - 1} onClick={() => moveWaypoint(i, 1)} />
            <IconButton label={t("delete")} icon="trash" onClick={() => removeWaypoint(i)} />
          </li>
        ))}
      </ol>
      {rows.length > 0 && <Switch label={t("loop")} on={loop.value} onChange={(on) => (loop.value = on)} />}
      <div class="button-row">
        <Button
          label={tool.value === "route" ? t("stop_adding") : t("add_waypoints")}
          icon="route"
          onClick={() => chooseTool("route")}
          disabled={!mayOperate.value}
        />
        {rows.length > 0 && (
          <Button
            label={t("start_route")}
            icon="play"
            kind="primary"
            onClick={() => void startRoute(loop.value ? 0 : 1)}
            disabled={!mayOperate.value}
          />
        )}
      </div>
    </Section>
  );
}

function Coordinates() {
  const x = useSignal("");
  const y = useSignal("");
  const yaw = useSignal("");
  const valid = [x.value, y.value].every((text) => text.trim() !== "" && Number.isFinite(Number(text)));
  const go = (): void => {
    if (valid) void goTo([Number(x.value), Number(y.value), radians(Number(yaw.value) || 0)], yaw.value.trim() === "");
  };
  const goal = latest.goal.value?.message;
  return (
    <Section title={t("go_to_coordinates")}>
      <form
        class="form-row"
        onSubmit={(event) => {
          event.preventDefault();
          go();
        }}
      >
        <Field label="x, m">
          <input type="number" step="0.01" value={x.value} onInput={(event) => (x.value = event.currentTarget.value)} />
        </Field>
        <Field label="y, m">
          <input type="number" step="0.01" value={y.value} onInput={(event) => (y.value = event.currentTarget.value)} />
        </Field>
        <Field label={t("heading")}>
          <input type="number" step="1" value={yaw.value} onInput={(event) => (yaw.value = event.currentTarget.value)} />
        </Field>
        <Button label={t("go")} onClick={go} disabled={!valid || !mayOperate.value} />
      </form>
      {goal?.active && (
        <p class="muted number">
          {t("goal_now")} {goal.map_from_goal[0].toFixed(2)}, {goal.map_from_goal[1].toFixed(2)},{" "}
          {degrees(goal.map_from_goal[2]).toFixed(0)}°
        </p>
      )}
    </Section>
  );
}
