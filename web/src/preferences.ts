// SPDX-License-Identifier: Apache-2.0
// What a user chose for this browser: theme, language, layers, name. Stored in localStorage where it is allowed.

import { effect, signal, type Signal } from "@preact/signals";

export type Theme = "system" | "light" | "dark";
export type Language = "en" | "de";
export const LAYERS = ["trail", "scan", "plan", "zones", "walls", "places", "rollouts", "costmap", "closures", "people", "grid"] as const;
export type Layer = (typeof LAYERS)[number];
export const DEBUG_LAYERS: readonly Layer[] = ["rollouts", "costmap", "closures"];

export const theme = stored<Theme>("theme", "system");
export const language = stored<Language>("language", navigator.language.startsWith("de") ? "de" : "en");
export const layers = stored<readonly Layer[]>("layers", ["trail", "scan", "plan", "zones", "walls", "places", "people", "grid"]);
export const pageName = stored<string>("name", "");

/** Whether the dark colours apply. */
export const isDark = signal(false);

function stored<T>(name: string, initial: T): Signal<T> {
  const key = `zenav.${name}`;
  let value = initial;
  try {
    const text = localStorage.getItem(key);
    if (text !== null) value = JSON.parse(text) as T;
  } catch {
    // storage is off or holds something else: the initial value applies
  }
  const result = signal(value);
  let first = true;
  effect(() => {
    const text = JSON.stringify(result.value);
    if (first) {
      first = false;
      return;
    }
    try {
      localStorage.setItem(key, text);
    } catch {
      // storage is off: the choice lasts until the page closes
    }
  });
  return result;
}

/** Applies theme and language to the document, now and at each change. */
export function applyPreferences(): void {
  const system = matchMedia("(prefers-color-scheme: dark)");
  const update = (): void => {
    isDark.value = theme.peek() === "dark" || (theme.peek() === "system" && system.matches);
    document.documentElement.dataset["theme"] = isDark.peek() ? "dark" : "light";
  };
  system.addEventListener("change", update);
  effect(() => {
    void theme.value;
    update();
  });
  effect(() => {
    document.documentElement.lang = language.value;
  });
}
