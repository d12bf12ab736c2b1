// SPDX-License-Identifier: Apache-2.0
// Commands to the robot: goals, routes, pose, zones, places. Each refusal becomes a notice with its reason and hint.

import { ask, run } from "../connection";
import { type Point, type Pose } from "../geometry";
import { type Zone } from "../messages";
import { notify } from "../notices";
import { type Reply } from "../protocol";
import { latest } from "../state";
import { reasonText, t } from "../texts";
import { chooseTool, editedZone, newPlace, route, setPlaces, type NamedPlace, type Tool } from "./tools";
import { placesFrom } from "../records";
import { encodeFloat64s } from "../wire";

/** Shows why a command was refused. Returns whether it was accepted. */
export function report(reply: Reply, done = ""): boolean {
  if (reply.accepted) {
    if (done !== "") notify("info", done, "");
    return true;
  }
  const { text, hint } = reasonText(reply.reason);
  const cause = text || t("refused");
  notify("warning", reply.detail === "" ? cause : `${cause}: ${reply.detail}`, hint || reply.hint);
  return false;
}

/** What a pose that was drawn with a tool is for. */
export async function finishPose(tool: Tool, pose: Pose, hasHeading: boolean): Promise<void> {
  chooseTool("look");
  if (tool === "goal") await goTo(pose, !hasHeading);
  else if (tool === "pose") report(await run("set_pose", { pose }), t("pose_is_set"));
  else if (tool === "place") newPlace.value = pose;
}

export async function goTo(pose: Pose, anyHeading: boolean): Promise<boolean> {
  return report(await ask("request/navigate", { poses: [pose], dwell: 0, loops: 1, any_heading: anyHeading }));
}

/** Drives the route that was put together; `loops` 0 is for ever. */
export async function startRoute(loops: number): Promise<void> {
  const rows = route.peek();
  const args = {
    poses: rows.map(({ pose }) => pose),
    dwell: 0,
    dwells: rows.map(({ dwell }) => dwell),
    loops,
    any_heading: false,
  };
  if (report(await ask("request/navigate", args))) {
    route.value = [];
    chooseTool("look");
  }
}

export async function explore(): Promise<void> {
  report(await ask("request/explore", {}));
}

export async function pause(paused: boolean): Promise<void> {
  report(await ask("request/pause", { paused }));
}

export async function cancel(): Promise<void> {
  report(await ask("request/cancel", {}));
}

/** A zone with plain numbers, as panels show it. */
export interface ZoneRow {
  readonly name: string;
  readonly kind: Zone["kind"];
  readonly corners: readonly Point[];
  /** m/s in a speed zone. */
  readonly speed: number;
}

export function zoneRows(): ZoneRow[] {
  return (latest.zones.value?.message.zones ?? []).map(({ name, kind, xs, ys, speed }) => ({
    name,
    kind,
    corners: Array.from(xs, (x, i): Point => [x, ys[i]!]),
    speed: speed ?? 20,
  }));
}

/** Lets exactly these zones hold, beside those of the robot's file. */
export async function setZones(rows: readonly ZoneRow[]): Promise<boolean> {
  const known = new Map((latest.zones.peek()?.message.zones ?? []).map((zone) => [zone.name, zone]));
  const zones = rows.map(({ name, kind, corners, speed }) => ({
    stamp: 0,
    name,
    kind,
    xs: encodeFloat64s(corners.map((corner) => corner[0])),
    ys: encodeFloat64s(corners.map((corner) => corner[1])),
    speed,
    share: known.get(name)?.share ?? 1,
  }));
  return report(await ask("request/set_zones", { zones }));
}

/** Sends the corners of the zone that was edited. */
export async function saveEditedZone(): Promise<void> {
  const edited = editedZone.peek();
  if (edited === null) return;
  const rows = zoneRows().map((row) => (row.name === edited.name ? { ...row, corners: edited.corners } : row));
  if (await setZones(rows)) editedZone.value = null;
}

export async function loadPlaces(): Promise<void> {
  const reply = await run("places");
  if (reply.accepted) setPlaces(placesFrom(reply.data));
}

export async function savePlace(place: NamedPlace): Promise<void> {
  if (report(await run("place_set", { name: place.name, pose: place.pose, ...mapOf(place) }))) {
    newPlace.value = null;
    await loadPlaces();
  }
}

export async function deletePlace(place: NamedPlace): Promise<void> {
  if (report(await run("place_delete", { name: place.name, ...mapOf(place) }))) await loadPlaces();
}

/** The map of a place, left out where it is none of a map. */
function mapOf(place: NamedPlace): { map?: string } {
  return place.map === "" ? {} : { map: place.map };
}
