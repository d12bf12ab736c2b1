// SPDX-License-Identifier: Apache-2.0
// Colours of the map, from the Okabe-Ito palette, for a dark and a light page.

import { type CellColors } from "../tile_atlas";

export interface Palette {
  readonly background: string;
  readonly grid: string;
  readonly robot: string;
  readonly robotEdge: string;
  readonly old: string;
  readonly scan: string;
  readonly plan: string;
  readonly chosen: string;
  readonly trail: string;
  readonly goal: string;
  readonly keepOut: string;
  readonly slow: string;
  readonly wall: string;
  /** #rrggbb */
  readonly erased: string;
  readonly place: string;
  readonly people: string;
  readonly truth: string;
  readonly label: string;
  readonly labelBack: string;
  readonly cells: CellColors;
}

type Rgb = readonly [number, number, number];

export const LIGHT: Palette = {
  background: "#dfe3e8",
  grid: "rgba(20, 30, 45, 0.07)",
  robot: "#0072b2",
  robotEdge: "#ffffff",
  old: "#7b828c",
  scan: "#d55e00",
  plan: "#0072b2",
  chosen: "#009e73",
  trail: "rgba(0, 114, 178, 0.4)",
  goal: "#009e73",
  keepOut: "#d55e00",
  slow: "#b07900",
  wall: "#a8200d",
  erased: "#009e73",
  place: "#8a4a73",
  people: "#cc79a7",
  truth: "#e69f00",
  label: "#14181f",
  labelBack: "rgba(255, 255, 255, 0.86)",
  cells: cellColors([223, 227, 232], [255, 255, 255], [30, 36, 46]),
};

export const DARK: Palette = {
  background: "#101419",
  grid: "rgba(220, 230, 245, 0.055)",
  robot: "#56b4e9",
  robotEdge: "#0b0e12",
  old: "#8b939e",
  scan: "#f0a23c",
  plan: "#56b4e9",
  chosen: "#2fc79a",
  trail: "rgba(86, 180, 233, 0.38)",
  goal: "#2fc79a",
  keepOut: "#ff7a2e",
  slow: "#f0e442",
  wall: "#ff5a3c",
  erased: "#2fc79a",
  place: "#e3a3c6",
  people: "#cc79a7",
  truth: "#e69f00",
  label: "#eef1f5",
  labelBack: "rgba(16, 20, 25, 0.82)",
  cells: cellColors([16, 20, 25], [38, 45, 54], [214, 221, 230]),
};

/** Colours from unknown, and from free (0) to occupied (100). */
function cellColors(unknown: Rgb, free: Rgb, occupied: Rgb): CellColors {
  const colors = new Uint32Array(102);
  const packed = ([r, g, b]: Rgb): number => ((255 << 24) | (b << 16) | (g << 8) | r) >>> 0;
  colors[0] = packed(unknown);
  for (let i = 0; i <= 100; i++) {
    const mix = (k: 0 | 1 | 2): number => Math.round(free[k] + ((occupied[k] - free[k]) * i) / 100);
    colors[i + 1] = packed([mix(0), mix(1), mix(2)]);
  }
  return colors;
}
