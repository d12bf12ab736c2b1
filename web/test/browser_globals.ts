// SPDX-License-Identifier: Apache-2.0
// The few globals of a browser that modules read when they are loaded. To be imported first.

const stored = new Map<string, string>();
Object.assign(globalThis, {
  localStorage: {
    getItem: (key: string) => stored.get(key) ?? null,
    setItem: (key: string, value: string) => void stored.set(key, value),
  },
});
if (!("navigator" in globalThis)) Object.assign(globalThis, { navigator: { language: "en" } });
