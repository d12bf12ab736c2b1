// SPDX-License-Identifier: Apache-2.0
// Zoom, follow, north, whole map, layers; and the tools that draw on the map.

import { isSite } from "../fleet";
import { following } from "../map/following";
import { view } from "../map/map_view";
import { mapEdits, undoEdit } from "../map/map_edits";
import { chooseTool, closePolygon, draftCorners, editKind, tool, type Tool } from "../map/tools";
import { layers, LAYERS, type Layer } from "../preferences";
import { mayOperate } from "../state";
import { t } from "../texts";
import { layersOpen, mapView } from "../ui";
import { Button, IconButton, Switch } from "./controls";
import { Icon } from "./Icon";

export function MapControls() {
  const map = mapView.value;
  return (
    <div class="map-controls">
      {layersOpen.value && <Layers />}
      <div class="card button-stack">
        <IconButton
          label={t("layers")}
          icon="layers"
          pressed={layersOpen.value}
          onClick={() => (layersOpen.value = !layersOpen.value)}
        />
        <IconButton
          label={t("follow")}
          icon="follow"
          pressed={following.value}
          onClick={() => (following.value = !following.value)}
        />
        <IconButton
          label={t("whole_map")}
          icon="fit"
          onClick={() => {
            following.value = false;
            map?.fit();
          }}
        />
        {view.value.rotation !== 0 && (
          <IconButton label={t("north_up")} icon="compass" onClick={() => map?.rotate(-view.value.rotation)} />
        )}
        <IconButton label={t("zoom_in")} icon="plus" onClick={() => map?.zoom(1.4)} />
        <IconButton label={t("zoom_out")} icon="minus" onClick={() => map?.zoom(1 / 1.4)} />
      </div>
    </div>
  );
}

function Layers() {
  const toggle = (layer: Layer, on: boolean): void => {
    layers.value = on ? [...layers.value, layer] : layers.value.filter((shown) => shown !== layer);
  };
  return (
    <div class="card layers" role="group" aria-label={t("layers")}>
      <h2>{t("layers")}</h2>
      {LAYERS.map((layer) => (
        <Switch
          key={layer}
          label={t(`layer_${layer}`)}
          on={layers.value.includes(layer)}
          onChange={(on) => toggle(layer, on)}
        />
      ))}
    </div>
  );
}

const SITE_TOOLS: readonly Tool[] = ["look", "goal", "route"];
const TOOLS: readonly Tool[] = [...SITE_TOOLS, "place", "zone", "wall", "erase", "pose"];

export function Toolbar() {
  if (!mayOperate.value) return null;
  return (
    <div class="tools">
      {tool.value !== "look" && <ToolHint />}
      <div class="card toolbar" role="toolbar" aria-label={t("tools")}>
        {(isSite.value ? SITE_TOOLS : TOOLS).map((name) => (
          <button
            key={name}
            type="button"
            class="tool"
            aria-pressed={tool.value === name}
            title={t(`tool_hint_${name}`)}
            onClick={() => chooseTool(name)}
          >
            <Icon name={name === "place" ? "places" : name} />
            <span>{t(`tool_${name}`)}</span>
          </button>
        ))}
      </div>
    </div>
  );
}

function ToolHint() {
  return (
    <div class="card tool-hint">
      <span>{t(`tool_hint_${tool.value}`)}</span>
      {tool.value === "zone" && draftCorners.value.length >= 3 && (
        <Button label={t("close_polygon")} onClick={closePolygon} kind="primary" />
      )}
      {editKind(tool.value) !== null && mapEdits().length > 0 && (
        <Button label={t("undo")} icon="undo" onClick={() => void undoEdit()} />
      )}
    </div>
  );
}
