// SPDX-License-Identifier: Apache-2.0
// The edits of the map in use: draw, list, undo.

import { Button, Empty, IconButton, Section } from "../components/controls";
import { mapEdits, removeEdit, undoEdit } from "../map/map_edits";
import { chooseTool } from "../map/tools";
import { mayOperate } from "../state";
import { t } from "../texts";

export function MapEdits() {
  const off = !mayOperate.value;
  const edits = mapEdits();
  return (
    <Section title={t("map_edits")}>
      {edits.length === 0 && <Empty text={t("no_map_edits")} />}
      <ul class="list">
        {edits.map(({ id, kind }) => {
          const name = t(`edit_${kind}`, { n: id });
          return (
            <li key={id} class="list-row">
              <div class="list-name">
                <span>{name}</span>
              </div>
              <IconButton
                label={t("delete_named", { name })}
                icon="trash"
                onClick={() => void removeEdit(id)}
                disabled={off}
              />
            </li>
          );
        })}
      </ul>
      <div class="button-row">
        <Button label={t("tool_erase")} icon="erase" onClick={() => chooseTool("erase")} disabled={off} />
        <Button label={t("tool_wall")} icon="wall" onClick={() => chooseTool("wall")} disabled={off} />
        <Button label={t("undo")} icon="undo" onClick={() => void undoEdit()} disabled={off || edits.length === 0} />
      </div>
    </Section>
  );
}
