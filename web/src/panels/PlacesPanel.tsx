// SPDX-License-Identifier: Apache-2.0
// Places and zones: name what was drawn on the map, edit and delete.

import { useSignal } from "@preact/signals";

import { Button, Choice, Empty, Field, IconButton, Section } from "../components/controls";
import { degrees, type Point, type Pose } from "../geometry";
import { deletePlace, goTo, saveEditedZone, savePlace, setZones, zoneRows, type ZoneRow } from "../map/commands";
import { cancelDrawing, chooseTool, closedPolygon, editedZone, newPlace, places } from "../map/tools";
import { hello, mapName, mayOperate } from "../state";
import { isItemName, itemName } from "../names";
import { t } from "../texts";

export function PlacesPanel() {
  const off = !mayOperate.value;
  return (
    <>
      {newPlace.value !== null && <NewPlace pose={newPlace.value} />}
      {closedPolygon.value !== null && <NewZone corners={closedPolygon.value} />}
      <Section title={t("places")}>
        {places.value.length === 0 && <Empty text={t("no_places")} />}
        <ul class="list">
          {places.value.map((place) => (
            <li key={`${place.map}/${place.name}`} class="list-row">
              <div class="list-name">
                <span>{place.name}</span>
                <span class="muted number">
                  {place.pose[0].toFixed(1)}, {place.pose[1].toFixed(1)}
                  {place.hasHeading && `, ${degrees(place.pose[2]).toFixed(0)}°`}
                  {place.map !== "" && ` · ${place.map}`}
                </span>
              </div>
              <Button label={t("go")} onClick={() => void goTo(place.pose, !place.hasHeading)} disabled={off} />
              <IconButton
                label={t("delete_named", { name: place.name })}
                icon="trash"
                onClick={() => void deletePlace(place)}
                disabled={off}
              />
            </li>
          ))}
        </ul>
        <Button label={t("add_place")} icon="plus" onClick={() => chooseTool("place")} disabled={off} />
      </Section>
      <Section title={t("zones")}>
        {zoneRows().length === 0 && <Empty text={t("no_zones")} />}
        <ul class="list">
          {zoneRows().map((zone) => (
            <ZoneItem key={zone.name} zone={zone} />
          ))}
        </ul>
        <Button label={t("add_zone")} icon="plus" onClick={() => chooseTool("zone")} disabled={off} />
      </Section>
    </>
  );
}

function ZoneItem({ zone }: { zone: ZoneRow }) {
  const edited = editedZone.value?.name === zone.name;
  const remove = (): void => void setZones(zoneRows().filter((row) => row.name !== zone.name));
  return (
    <li class="list-row">
      <span class={`zone-mark ${zone.kind}`} aria-hidden="true" />
      <div class="list-name">
        <span>{zone.name}</span>
        <span class="muted">
          {t(`zone_${zone.kind}`)}
          {zone.kind === "slow" && zone.speed < 20 && ` · ${zone.speed.toFixed(2)} m/s`}
        </span>
      </div>
      {edited ? (
        <>
          <Button label={t("save")} kind="primary" onClick={() => void saveEditedZone()} />
          <IconButton label={t("cancel")} icon="close" onClick={() => (editedZone.value = null)} />
        </>
      ) : (
        <>
          <IconButton
            label={t("edit_corners", { name: zone.name })}
            icon="edit"
            disabled={!mayOperate.value}
            onClick={() => {
              chooseTool("look");
              editedZone.value = { name: zone.name, corners: zone.corners };
            }}
          />
          <IconButton
            label={t("delete_named", { name: zone.name })}
            icon="trash"
            onClick={remove}
            disabled={!mayOperate.value}
          />
        </>
      )}
    </li>
  );
}

function NewPlace({ pose }: { pose: Pose }) {
  const name = useSignal("");
  const save = (): void => {
    if (isItemName(name.value)) void savePlace({ name: name.value, pose, map: mapName.peek(), hasHeading: true });
  };
  return (
    <form
      class="draft"
      onSubmit={(event) => {
        event.preventDefault();
        save();
      }}
    >
      <Field label={t("name_of_place")}>
        <input
          type="text"
          maxLength={64}
          value={name.value}
          ref={focus}
          onInput={(event) => (name.value = itemName(event.currentTarget.value))}
        />
      </Field>
      {name.value !== "" && !isItemName(name.value) && <p class="bad-text">{t("name_rule")}</p>}
      <div class="button-row">
        <Button label={t("save")} kind="primary" onClick={save} disabled={!isItemName(name.value)} />
        <Button label={t("cancel")} onClick={cancelDrawing} />
      </div>
    </form>
  );
}

function NewZone({ corners }: { corners: readonly Point[] }) {
  const name = useSignal(freeName());
  const kind = useSignal<ZoneRow["kind"]>("keep_out");
  const speed = useSignal(((hello.value?.robot.max_speed ?? 0.6) / 3).toFixed(2));
  const save = async (): Promise<void> => {
    const row = { name: name.value.trim(), kind: kind.value, corners, speed: kind.value === "slow" ? Number(speed.value) : 20 };
    if (await setZones([...zoneRows().filter((zone) => zone.name !== row.name), row])) closedPolygon.value = null;
  };
  const valid = name.value.trim() !== "" && (kind.value === "keep_out" || Number(speed.value) >= 0.01);
  return (
    <form
      class="draft"
      onSubmit={(event) => {
        event.preventDefault();
        if (valid) void save();
      }}
    >
      <Field label={t("name_of_zone")}>
        <input
          type="text"
          maxLength={40}
          value={name.value}
          onInput={(event) => (name.value = event.currentTarget.value)}
        />
      </Field>
      <Choice
        label={t("kind")}
        value={kind.value}
        options={[
          ["keep_out", t("zone_keep_out")],
          ["slow", t("zone_slow")],
        ]}
        onChange={(value) => (kind.value = value)}
      />
      {kind.value === "slow" && (
        <Field label={t("speed_limit")}>
          <input
            type="number"
            min="0.01"
            max="20"
            step="0.01"
            value={speed.value}
            onInput={(event) => (speed.value = event.currentTarget.value)}
          />
        </Field>
      )}
      <div class="button-row">
        <Button label={t("save")} kind="primary" onClick={() => void save()} disabled={!valid} />
        <Button label={t("cancel")} onClick={cancelDrawing} />
      </div>
    </form>
  );
}

function focus(input: HTMLInputElement | null): void {
  input?.focus();
}

function freeName(): string {
  const names = new Set(zoneRows().map((row) => row.name));
  let n = 1;
  while (names.has(`${t("zone")} ${n}`)) n++;
  return `${t("zone")} ${n}`;
}
