// SPDX-License-Identifier: Apache-2.0
// Charts of the last ten minutes with uPlot: speed, latency, pose quality.

import { useEffect, useRef } from "preact/hooks";
import uPlot from "uplot";
import "uplot/dist/uPlot.min.css";

import { sampled, samples, times, WINDOW_S, type SeriesName } from "../history";
import { isDark, language } from "../preferences";
import { t } from "../texts";

const HEIGHT_PX = 132;
const MIN_WINDOW_S = 60; // shown while the page is new

interface ChartProps {
  title: string;
  unit: string;
  series: readonly (readonly [SeriesName, string, "a" | "b"])[];
  range?: [number, number];
}

export function ChartsPanel() {
  return (
    <>
      <Chart
        title={t("chart_speed")}
        unit="m/s"
        series={[
          ["command", t("commanded"), "b"],
          ["speed", t("measured"), "a"],
        ]}
      />
      <Chart
        title={t("chart_latency")}
        unit="ms"
        series={[
          ["handler", t("slowest_handler"), "b"],
          ["rtt", t("link_rtt"), "a"],
        ]}
      />
      <Chart title={t("chart_quality")} unit="%" series={[["quality", t("pose_quality"), "a"]]} range={[0, 100]} />
    </>
  );
}

function Chart({ title, unit, series, range }: ChartProps) {
  const box = useRef<HTMLDivElement>(null);
  useEffect(() => {
    if (box.current === null) return undefined;
    const colors = isDark.value ? DARK : LIGHT;
    const axis = { stroke: colors.text, grid: { stroke: colors.grid, width: 1 }, ticks: { show: false }, font: "11px system-ui" };
    const plot = new uPlot(
      {
        width: box.current.clientWidth,
        height: HEIGHT_PX,
        cursor: { sync: { key: "history" }, drag: { x: false, y: false } },
        legend: { live: true },
        scales: {
          x: { range: () => [firstTime(), Date.now() / 1000] },
          y: range ? { range } : { range: (_, low, high) => [Math.min(0, low ?? 0), Math.max(0.1, (high ?? 0) * 1.1)] },
        },
        axes: [
          { ...axis, size: 26, space: 80, values: "{HH}:{mm}:{ss}" },
          { ...axis, size: 40, space: 26 },
        ],
        series: [
          { value: "{HH}:{mm}:{ss}" },
          ...series.map(([, label, color]) => ({
            label,
            stroke: colors[color],
            width: 1.5,
            points: { show: false },
            value: (_: uPlot, value: number | null) => (value === null ? "–" : `${value.toFixed(2)} ${unit}`),
          })),
        ],
      },
      data(series),
      box.current,
    );
    const observer = new ResizeObserver(([entry]) => {
      if (entry) plot.setSize({ width: entry.contentRect.width, height: HEIGHT_PX });
    });
    observer.observe(box.current);
    const stop = sampled.subscribe(() => plot.setData(data(series)));
    return () => {
      stop();
      observer.disconnect();
      plot.destroy();
    };
  }, [isDark.value, language.value]);
  return (
    <section class="chart" aria-label={title}>
      <h3>
        {title} <span class="muted">{unit}</span>
      </h3>
      <div ref={box} />
    </section>
  );
}

/** Where the time axis begins: at the first sample, but one to ten minutes ago. */
function firstTime(): number {
  const now = Date.now() / 1000;
  return Math.max(now - WINDOW_S, Math.min(now - MIN_WINDOW_S, times[0] ?? now));
}

function data(series: ChartProps["series"]): uPlot.AlignedData {
  return [times, ...series.map(([name]) => samples[name])];
}

const LIGHT = { text: "#4a5361", grid: "rgba(20, 30, 45, 0.09)", a: "#0072b2", b: "#d55e00" };
const DARK = { text: "#aab3c0", grid: "rgba(220, 230, 245, 0.08)", a: "#56b4e9", b: "#e69f00" };
