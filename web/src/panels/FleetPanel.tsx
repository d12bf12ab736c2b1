// SPDX-License-Identifier: Apache-2.0
// Every robot that the page's server hears: state, task, battery, link, version; STOP for all.

import { useSignal } from "@preact/signals";
import { useEffect } from "preact/hooks";

import { Button, Empty } from "../components/controls";
import { colorOf, fleet, isOnMap, selected, selectRobot, stateText, stopAll } from "../fleet";
import { type FleetRobot } from "../protocol";
import { connected, hello, mapName } from "../state";
import { t } from "../texts";
import { mapView } from "../ui";

const ASK_MS = 4000;

export function FleetPanel() {
  const own = hello.value?.robot.name ?? "";
  return (
    <>
      <StopAll />
      {fleet.value.length === 0 && <Empty text={t("no_robots")} />}
      <ul class="list fleet-list">
        {fleet.value.map((robot) => (
          <li key={robot.name} class={robot.state === "silent" ? "list-item fleet-silent" : "list-item"}>
            <button
              type="button"
              class="fleet-robot"
              aria-pressed={robot.name === (selected.value || own)}
              onClick={() => select(robot, own)}
            >
              <span class="fleet-dot" style={{ background: colorOf(robot.name, fleet.value) }} aria-hidden="true" />
              <span class="fleet-name">{robot.name}</span>
              <span class={`tag fleet-${robot.state}`}>{stateText(robot.state)}</span>
            </button>
            <dl class="fleet-facts">
              <Facts robot={robot} own={own} />
            </dl>
          </li>
        ))}
      </ul>
    </>
  );
}

function select(robot: FleetRobot, own: string): void {
  selectRobot(robot.name);
  if (robot.x !== null && robot.y !== null && isOnMap(robot, own, mapName.peek())) mapView.peek()?.show([robot.x, robot.y]);
}

function Facts({ robot, own }: { robot: FleetRobot; own: string }) {
  const link = robot.received === null || robot.delay === null ? null : robot;
  const map = robot.map || t("map_unnamed");
  const rows: [string, string | null][] = [
    [t("fleet_reason"), robot.reason || null],
    [t("panel_task"), robot.task || null],
    [t("battery"), robot.battery === null ? null : `${robot.battery.toFixed(1)} V`],
    [t("fleet_link"), link && `${(link.received! * 100).toFixed(0)} % · ${(link.delay! * 1e3).toFixed(0)} ms`],
    [t("fleet_map"), isOnMap(robot, own, mapName.value) ? map : t("other_map", { map })],
    [t("fleet_version"), [robot.version, robot.address].filter(Boolean).join(" · ") || null],
  ];
  return (
    <>
      {rows.map(
        ([name, value]) =>
          value !== null && (
            <div key={name}>
              <dt>{name}</dt>
              <dd>{value}</dd>
            </div>
          ),
      )}
    </>
  );
}

/** STOP for all: the second press does it, the first one asks. */
function StopAll() {
  const asked = useSignal(false);
  useEffect(() => {
    if (!asked.value) return undefined;
    const timer = setTimeout(() => (asked.value = false), ASK_MS);
    return () => clearTimeout(timer);
  }, [asked.value]);
  return (
    <Button
      label={asked.value ? t("stop_all_really", { n: fleet.value.length }) : t("stop_all")}
      kind="danger"
      icon="stop"
      disabled={!connected.value || fleet.value.length === 0}
      onClick={() => {
        if (asked.value) stopAll();
        asked.value = !asked.value;
      }}
    />
  );
}
