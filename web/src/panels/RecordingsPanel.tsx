// SPDX-License-Identifier: Apache-2.0
// Recordings: mark the one that runs, download, delete.

import { useSignal } from "@preact/signals";
import { useEffect } from "preact/hooks";

import { Confirm } from "../components/Confirm";
import { Button, Empty, Field, Section } from "../components/controls";
import { changeRecording, loadRecordings, recordings } from "../lists";
import { player } from "../replay";
import { mayAdminister, mayOperate } from "../state";
import { dateText, sizeText, t } from "../texts";

export function RecordingsPanel() {
  useEffect(() => void loadRecordings(), []);
  return (
    <>
      <MarkForm />
      <Section title={t("recordings")}>
        {recordings.value === null && <Empty text={t("loading")} />}
        {recordings.value?.length === 0 && <Empty text={t("no_recordings")} />}
        <ul class="list">
          {recordings.value?.map(({ name, size, modified, current, marked }) => (
            <li key={name} class="list-item">
              <div class="list-name">
                <span class="file-name">{name}</span>
                {current && <span class="tag">{t("being_written")}</span>}
                {marked && <span class="tag">{t("marked")}</span>}
                <span class="muted number">{[sizeText(size), dateText(modified)].filter(Boolean).join(" · ")}</span>
              </div>
              <div class="button-row">
                <Button label={t("replay")} icon="play" onClick={() => void player.open(name)} />
                {mayOperate.value && (
                  <a class="button plain" href={`/recordings/${encodeURIComponent(name)}`} download>
                    {t("download")}
                  </a>
                )}
                <Confirm
                  label={t("delete")}
                  disabled={!mayAdminister.value || current}
                  onConfirm={() => void changeRecording("recording_delete", { name }, t("deleted"))}
                />
              </div>
            </li>
          ))}
        </ul>
      </Section>
    </>
  );
}

function MarkForm() {
  const text = useSignal("");
  const mark = async (): Promise<void> => {
    await changeRecording("recording_mark", { text: text.value.trim() }, t("marked"));
    text.value = "";
  };
  return (
    <Section title={t("mark_title")}>
      <form
        class="form-row"
        onSubmit={(event) => {
          event.preventDefault();
          if (text.value.trim()) void mark();
        }}
      >
        <Field label={t("mark_hint")}>
          <input
            type="text"
            maxLength={200}
            value={text.value}
            onInput={(event) => (text.value = event.currentTarget.value)}
          />
        </Field>
        <Button
          label={t("mark")}
          icon="flag"
          onClick={() => void mark()}
          disabled={!mayOperate.value || text.value.trim() === ""}
        />
      </form>
    </Section>
  );
}
