// SPDX-License-Identifier: Apache-2.0
// The robot's settings with their origin. Those that may change while it runs have a control; others are read-only.

import { useComputed, useSignal } from "@preact/signals";
import { useEffect } from "preact/hooks";

import { Button, Choice, Empty, Field, Section, Switch } from "../components/controls";
import { changeSetting, loadSettings, settings } from "../lists";
import { RUN_TIME, type Setting, type SettingEditor } from "../records";
import { hello, mayOperate } from "../state";
import { t } from "../texts";

const MAX_ROWS = 120; // shown at once: a filter finds the others

export function ConfigurationSection() {
  useEffect(() => void loadSettings(), []);
  const filter = useSignal("");
  const changeableOnly = useSignal(false);
  const rows = useComputed(() => {
    const wanted = filter.value.trim().toLowerCase();
    return (settings.value ?? []).filter(
      (row) =>
        (row.editor !== null || !changeableOnly.value) &&
        `${row.name} ${row.description}`.toLowerCase().includes(wanted),
    );
  });
  return (
    <Section title={t("configuration")}>
      <Field label={t("filter")}>
        <input type="search" value={filter.value} onInput={(event) => (filter.value = event.currentTarget.value)} />
      </Field>
      <Switch
        label={t("changeable_only")}
        on={changeableOnly.value}
        onChange={(only) => (changeableOnly.value = only)}
      />
      {settings.value === null && <Empty text={t("loading")} />}
      <ul class="list">
        {rows.value.slice(0, MAX_ROWS).map((row) => (
          <SettingRow key={row.name} row={row} />
        ))}
      </ul>
      {rows.value.length > MAX_ROWS && <Empty text={t("more_rows", { n: rows.value.length - MAX_ROWS })} />}
    </Section>
  );
}

function SettingRow({ row }: { row: Setting }) {
  const { editor } = row;
  const isSet = row.origin === RUN_TIME;
  const origin = isSet ? t("set_at_run_time") : row.origin;
  const rule = editor?.isLimit ? t("only_lower") : "";
  const isAllowed = mayOperate.value && (!editor?.isLimit || hello.value?.role === "admin");
  return (
    <li class="setting">
      <div class="setting-line">
        <span class="setting-name">{row.name}</span>
        <span class="setting-value number">{row.value}</span>
      </div>
      <span class="muted">{[row.description, rule, origin].filter(Boolean).join(" · ")}</span>
      {editor && isAllowed && <Editor key={row.value} row={row} editor={editor} />}
      {editor && isAllowed && isSet && (
        <Button label={t("back_to", { value: editor.started })} onClick={() => void changeSetting(row.name, "")} />
      )}
    </li>
  );
}

function Editor({ row, editor }: { row: Setting; editor: SettingEditor }) {
  const change = (value: string): void => void changeSetting(row.name, value);
  if (editor.kind === "switch") {
    return <Switch label={t("switched_on")} on={row.value === "true"} onChange={(on) => change(String(on))} />;
  }
  if (editor.kind === "choice") {
    const options = editor.choices.map((choice) => [choice, choice] as const);
    return <Choice label={t("setting_value")} value={row.value} options={options} onChange={change} />;
  }
  return <NumberForm row={row} editor={editor} onChange={change} />;
}

interface NumberFormProps {
  row: Setting;
  editor: SettingEditor;
  onChange: (value: string) => void;
}

/** A number with its unit and bounds. The bounds of the browser are a help: the services check every value. */
function NumberForm({ row, editor, onChange }: NumberFormProps) {
  const text = useSignal(row.value);
  return (
    <form
      class="form-row"
      onSubmit={(event) => {
        event.preventDefault();
        if (text.value !== "" && text.value !== row.value) onChange(text.value);
      }}
    >
      <Field label={boundsText(editor)}>
        <input
          type="number"
          aria-label={row.name}
          step={editor.kind === "integer" ? 1 : "any"}
          min={editor.low ?? undefined}
          max={(editor.isLimit ? Number(editor.started) : editor.high) ?? undefined}
          value={text.value}
          onInput={(event) => (text.value = event.currentTarget.value)}
        />
      </Field>
      <button type="submit" class="button plain">
        {t("set_value")}
      </button>
    </form>
  );
}

function boundsText({ low, high, started, unit, isLimit }: SettingEditor): string {
  const most = isLimit ? started : high === null ? "" : String(high);
  return [low === null && most === "" ? "" : `${low ?? ""} … ${most}`, unit].filter(Boolean).join(" ");
}
