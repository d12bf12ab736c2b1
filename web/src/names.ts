// SPDX-License-Identifier: Apache-2.0
// Names of maps and places: they become names of files and keys.

const ITEM_NAME = /^[\p{L}_][\p{L}\p{N}_-]{0,63}$/u;

export function isItemName(name: string): boolean {
  return ITEM_NAME.test(name);
}

/** What a user types, with blanks as underscores. */
export function itemName(text: string): string {
  return text.trimStart().replace(/\s/g, "_");
}
