// SPDX-License-Identifier: Apache-2.0
// Why the robot stands or moves, in one line and a hint, from the guard's, navigator's and local control's status.

import { type FollowStatus, type GuardStatus, type NavStatus } from "./messages";
import { reasonText, t, type TextKey } from "./texts";

export type Tone = "moving" | "ready" | "wait" | "stop" | "unknown";

export interface Why {
  readonly tone: Tone;
  readonly headline: string;
  readonly hint: string;
}

export interface Situation {
  readonly guard: GuardStatus | null;
  readonly nav: NavStatus | null;
  readonly follow: FollowStatus | null;
  readonly estop: boolean;
  /** Name of the page that drives by hand, "" for another tool, null for this page. */
  readonly driver: string | null;
}

/** Reasons of the guard that are no news while the robot drives or waits for its first goal. */
const QUIET = new Set(["", "no_command", "estop_released", "dwelling"]);

export function why({ guard, nav, follow, estop, driver }: Situation): Why {
  if (guard === null) return { tone: "unknown", headline: t("no_data_yet"), hint: t("no_data_hint") };
  if (estop) return because("estop", guard.reason === "estop" ? guard.detail : "", "stop");
  if (guard.state === "stopped" || guard.state === "fault") return because(guard.reason, guard.detail, "stop");
  if (guard.state === "hold" && !QUIET.has(guard.reason)) return because(guard.reason, guard.detail, "wait");
  if (guard.source === "teleop") {
    const headline = driver === null ? t("you_drive") : t("driven_by", { name: driver || t("another_tool") });
    return { tone: "moving", headline, hint: slowed(guard) };
  }
  if (nav === null) return { tone: "ready", headline: t("ready"), hint: t("ready_hint") };
  const blocked = follow?.state === "blocked" || follow?.state === "failed" ? follow.reason : "";
  switch (nav.state) {
    case "navigating":
    case "exploring":
      if (blocked !== "") return because(blocked, nav.detail, "wait");
      if (!QUIET.has(nav.reason)) return because(nav.reason, nav.detail, "wait");
      return { tone: "moving", headline: progress(nav), hint: slowed(guard) };
    case "recovering":
      return { tone: "wait", headline: recovering(nav), hint: joined(reasonText(nav.reason).text, nav.detail) };
    case "failed":
      return because(nav.reason, nav.detail, "wait");
    case "paused":
      return { tone: "wait", headline: t("paused"), hint: t("paused_hint") };
    case "reached":
      return { tone: "ready", headline: t("reached"), hint: t("ready_hint") };
    case "canceled":
      return { tone: "ready", headline: t("canceled"), hint: t("ready_hint") };
    case "idle":
      return { tone: "ready", headline: t("ready"), hint: t("ready_hint") };
  }
}

function because(code: string, detail: string, tone: Tone): Why {
  const { text, hint } = reasonText(code);
  return { tone, headline: capital(text) || t("stands"), hint: joined(capital(hint), detail) };
}

/** How far the task is: "Driving: 12.3 m left". */
function progress(nav: NavStatus): string {
  const distance = nav.distance_left.toFixed(1);
  if (nav.state === "exploring") return t("exploring");
  const minutes = Math.floor(nav.time_left / 60);
  const time = `${minutes}:${String(Math.floor(nav.time_left % 60)).padStart(2, "0")}`;
  if (nav.n_waypoints < 2) return t("driving_left", { distance, time });
  return t("route_left", { i: nav.waypoint + 1, n: nav.n_waypoints, distance, time });
}

function recovering(nav: NavStatus): string {
  const key: TextKey = nav.recovery === "turn" ? "recovery_turn" : nav.recovery === "wait" ? "recovery_wait" : "recovery_back_up";
  return t(key);
}

function slowed(guard: GuardStatus): string {
  return QUIET.has(guard.reason) ? "" : capital(reasonText(guard.reason).text);
}

function joined(first: string, second: string): string {
  return [first, second].filter((part) => part !== "").join(" · ");
}

export function capital(text: string): string {
  return text.charAt(0).toUpperCase() + text.slice(1);
}
