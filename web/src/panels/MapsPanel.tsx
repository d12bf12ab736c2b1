// SPDX-License-Identifier: Apache-2.0
// Saved maps: save, load, continue, rename, delete, download, upload; and the robot's pose on the map.

import { useSignal } from "@preact/signals";
import { useEffect } from "preact/hooks";

import { Confirm } from "../components/Confirm";
import { Button, Empty, Field, Section } from "../components/controls";
import { changeMap, loadMaps, maps, uploadMap } from "../lists";
import { chooseTool } from "../map/tools";
import { isItemName, itemName } from "../names";
import { notify } from "../notices";
import { type SavedMap } from "../records";
import { latest, mapName, mayAdminister, mayOperate } from "../state";
import { dateText, sizeText, t } from "../texts";
import { MapEdits } from "./MapEdits";

export function MapsPanel() {
  useEffect(() => void loadMaps(), []);
  const mode = latest.pose.value?.message.mode ?? "map";
  const off = !mayOperate.value;
  return (
    <>
      <Section title={t("map_in_use")}>
        <p class="facts">
          <span>{[mapName.value || t("map_without_name"), t(`mode_${mode}`)].join(" · ")}</span>
        </p>
        <SaveForm />
        <Button label={t("tool_hint_pose_short")} icon="pose" onClick={() => chooseTool("pose")} disabled={off} />
      </Section>
      <MapEdits />
      <Section title={t("saved_maps")}>
        {maps.value === null && <Empty text={t("loading")} />}
        {maps.value?.length === 0 && <Empty text={t("no_maps")} />}
        <ul class="list">
          {maps.value?.map((map) => (
            <MapItem key={map.name} map={map} />
          ))}
        </ul>
      </Section>
      <Upload />
    </>
  );
}

function SaveForm() {
  const name = useSignal(mapName.peek());
  const save = (): void => void changeMap("map_save", { name: name.value }, t("map_saved"));
  return (
    <form
      class="form-row"
      onSubmit={(event) => {
        event.preventDefault();
        if (isItemName(name.value)) save();
      }}
    >
      <Field label={t("save_as")}>
        <input
          type="text"
          maxLength={64}
          value={name.value}
          onInput={(event) => (name.value = itemName(event.currentTarget.value))}
        />
      </Field>
      <Button label={t("save")} onClick={save} disabled={!mayOperate.value || !isItemName(name.value)} />
    </form>
  );
}

function MapItem({ map }: { map: SavedMap }) {
  const open = useSignal(false);
  const to = useSignal(map.name);
  const off = !mayOperate.value;
  const load = (mode: string): void => void changeMap("map_load", { name: map.name, mode }, t("map_loaded"));
  return (
    <li class="list-item">
      <button type="button" class="list-row expander" aria-expanded={open.value} onClick={() => (open.value = !open.value)}>
        <span class="list-name">{map.name}</span>
        <span class="muted number">
          {[map.name === mapName.value ? t("in_use") : "", sizeText(map.size), dateText(map.modified)].filter(Boolean).join(" · ")}
        </span>
      </button>
      {open.value && (
        <div class="list-detail">
          <div class="button-row">
            <Button label={t("localize")} kind="primary" onClick={() => load("localize")} disabled={off} />
            <Button label={t("continue_map")} onClick={() => load("continue")} disabled={off} />
            <a class="button plain" href={`/maps/${encodeURIComponent(map.name)}.zip`} download>
              {t("download")}
            </a>
          </div>
          <div class="form-row">
            <Field label={t("rename_to")}>
              <input
                type="text"
                maxLength={64}
                value={to.value}
                onInput={(event) => (to.value = itemName(event.currentTarget.value))}
              />
            </Field>
            <Button
              label={t("rename")}
              disabled={!mayAdminister.value || !isItemName(to.value) || to.value === map.name}
              onClick={() => void changeMap("map_rename", { name: map.name, to: to.value }, t("renamed"))}
            />
            <Confirm
              label={t("delete")}
              disabled={!mayAdminister.value}
              onConfirm={() => void changeMap("map_delete", { name: map.name }, t("deleted"))}
            />
          </div>
        </div>
      )}
    </li>
  );
}

function Upload() {
  const file = useSignal<File | null>(null);
  const busy = useSignal(false);
  const name = itemName(file.value?.name.replace(/\.zip$/i, "") ?? "");
  const send = async (): Promise<void> => {
    if (file.value === null) return;
    busy.value = true;
    const problem = await uploadMap(name, file.value);
    busy.value = false;
    notify(problem === "" ? "info" : "error", problem === "" ? t("uploaded") : problem, "");
  };
  return (
    <Section title={t("upload_map")}>
      <Field label={t("upload_hint")}>
        <input type="file" accept=".zip" onChange={(event) => (file.value = event.currentTarget.files?.[0] ?? null)} />
      </Field>
      <Button
        label={t("upload")}
        icon="upload"
        onClick={() => void send()}
        disabled={file.value === null || busy.value || !mayOperate.value}
      />
    </Section>
  );
}
