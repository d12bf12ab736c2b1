// SPDX-License-Identifier: Apache-2.0
// Reads the golden bytes by the example's reader: node golden_reader.mjs wire.mjs golden.json schema.json
import { readFileSync } from "node:fs";
import { pathToFileURL } from "node:url";

const [reader, goldenFile, schemaFile] = process.argv.slice(2);
const { decode } = await import(pathToFileURL(reader).href);
const golden = JSON.parse(readFileSync(goldenFile, "utf8"));
const { $defs } = JSON.parse(readFileSync(schemaFile, "utf8"));

/** A value as golden.json has it. */
function json(value) {
  if (value instanceof Uint8Array) return Buffer.from(value).toString("hex");
  if (typeof value === "bigint") return Number(value);
  if (typeof value === "number") return Number.isFinite(value) ? value : null;
  if (Array.isArray(value)) return value.map(json);
  if (value === null || typeof value !== "object") return value;
  return Object.fromEntries(Object.entries(value).map(([key, item]) => [key, json(item)]));
}

/** What is in both, in the order of their keys: an array with a default may be left out while it is empty. */
function compared(value) {
  return JSON.stringify(value, (_, item) =>
    item !== null && typeof item === "object" && !Array.isArray(item)
      ? Object.fromEntries(Object.entries(item).filter(([, v]) => !Array.isArray(v) || v.length > 0).sort())
      : item,
  );
}

const wrong = Object.entries(golden).filter(
  ([name, { bytes, value }]) => compared(json(decode(Buffer.from(bytes, "hex"), name, $defs))) !== compared(value),
);
const stamp = decode(Buffer.from(golden.Clock.bytes, "hex"), "Clock", $defs).stamp;
console.log(JSON.stringify({ read: Object.keys(golden).length, wrong: wrong.map(([name]) => name), stamp: `${stamp}` }));
