// SPDX-License-Identifier: Apache-2.0
// Short notices that the user should read; they leave by themselves, errors later.

import { signal } from "@preact/signals";

export interface Notice {
  readonly id: number;
  readonly level: "info" | "warning" | "error";
  readonly text: string;
  readonly hint: string;
}

const MAX_NOTICES = 4;
const LIFE_MS = { info: 4000, warning: 8000, error: 12_000 };

export const notices = signal<readonly Notice[]>([]);
let n = 0;

export function notify(level: Notice["level"], text: string, hint: string): void {
  const id = ++n;
  const others = notices.peek().filter((notice) => notice.text !== text);
  notices.value = [...others.slice(1 - MAX_NOTICES), { id, level, text, hint }];
  setTimeout(() => dismiss(id), LIFE_MS[level]);
}

export function dismiss(id: number): void {
  notices.value = notices.peek().filter((notice) => notice.id !== id);
}
