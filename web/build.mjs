// SPDX-License-Identifier: Apache-2.0
// Writes the bundle to services/dashboard/static, the same bytes for the same sources; with --test the tests to .test/.

import { build } from "esbuild";
import { cpSync, mkdirSync, readFileSync, readdirSync, rmSync, writeFileSync } from "node:fs";
import { dirname, join } from "node:path";
import { fileURLToPath } from "node:url";
import { gzipSync } from "node:zlib";

const HERE = dirname(fileURLToPath(import.meta.url));
const STATIC = join(HERE, "..", "services", "dashboard", "static");
const MAX_GZIPPED = 200_000; // bytes of app.js and app.css together
const BUNDLED = ["preact", "@preact/signals", "@preact/signals-core", "@msgpack/msgpack", "uplot"];

if (process.argv.includes("--test")) {
  rmSync(join(HERE, ".test"), { recursive: true, force: true });
  const tests = readdirSync(join(HERE, "test")).filter((name) => name.endsWith(".test.ts"));
  await build({
    absWorkingDir: HERE,
    entryPoints: tests.map((name) => `test/${name}`),
    outdir: ".test",
    outExtension: { ".js": ".mjs" },
    bundle: true,
    platform: "node",
    format: "esm",
    sourcemap: "inline",
    logLevel: "warning",
  });
} else {
  rmSync(STATIC, { recursive: true, force: true });
  mkdirSync(STATIC, { recursive: true });
  await build({
    absWorkingDir: HERE,
    entryPoints: { app: "src/main.tsx" },
    outdir: STATIC,
    bundle: true,
    minify: true,
    format: "iife",
    target: "es2021",
    charset: "utf8",
    legalComments: "none", // all notices are in licenses.txt
    logLevel: "warning",
  });
  cpSync(join(HERE, "public"), STATIC, { recursive: true });
  writeFileSync(join(STATIC, "licenses.txt"), BUNDLED.map(notice).join("\n\n"));
  const size = ["app.js", "app.css"].reduce((sum, name) => sum + gzipSync(readFileSync(join(STATIC, name))).length, 0);
  process.stdout.write(`bundle: ${(size / 1000).toFixed(1)} kB gzipped\n`);
  if (size > MAX_GZIPPED) throw new Error(`the bundle has ${size} bytes gzipped, the limit is ${MAX_GZIPPED}`);
}

/** Name, version and license text of a bundled package. */
function notice(name) {
  const folder = join(HERE, "node_modules", name);
  const { version, license } = JSON.parse(readFileSync(join(folder, "package.json"), "utf8"));
  const file = readdirSync(folder).find((entry) => /^licen[cs]e/i.test(entry));
  return `${name} ${version} (${license})\n\n${file ? readFileSync(join(folder, file), "utf8").trim() : ""}\n`;
}
