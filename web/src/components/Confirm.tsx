// SPDX-License-Identifier: Apache-2.0
// A button that asks once more in its own place; the question leaves by itself.

import { useSignal } from "@preact/signals";
import { useEffect } from "preact/hooks";

import { t } from "../texts";
import { Button } from "./controls";

const ASK_MS = 4000;

export function Confirm({ label, onConfirm, disabled }: { label: string; onConfirm: () => void; disabled: boolean }) {
  const asked = useSignal(false);
  useEffect(() => {
    if (!asked.value) return undefined;
    const timer = setTimeout(() => (asked.value = false), ASK_MS);
    return () => clearTimeout(timer);
  }, [asked.value]);
  if (!asked.value) return <Button label={label} icon="trash" disabled={disabled} onClick={() => (asked.value = true)} />;
  return (
    <Button
      label={t("really_delete")}
      kind="danger"
      disabled={disabled}
      onClick={() => {
        asked.value = false;
        onConfirm();
      }}
    />
  );
}
