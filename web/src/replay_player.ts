// SPDX-License-Identifier: Apache-2.0
// The time of a replay as a state machine: opened, played, sought, closed. At most one order to the server waits.

import { signal } from "@preact/signals";

import { type Reply } from "./protocol";
import { type OpenedReplay, type ReplayState } from "./records";

export const REPLAY_TICK_MS = 100; // at most 10 orders a second
export const SPEEDS = ["1", "2", "5", "10"] as const;
export type Speed = (typeof SPEEDS)[number];
const TIMEOUT_MS = 100_000; // the whole recording is read once, again after the tools ended for idleness

type Run = (op: string, args: object, timeout?: number) => Promise<Reply>;

/** What the player does to the page. */
export interface Stage {
  /** A recording is shown from now on. */
  readonly begin: (opened: OpenedReplay) => void;
  readonly show: (state: ReplayState) => void;
  /** The page is live again. */
  readonly end: () => void;
  readonly refuse: (reply: Reply) => void;
}

export class ReplayPlayer {
  readonly opened = signal<OpenedReplay | null>(null);
  /** Name of the recording that is being opened, "" without one. */
  readonly opening = signal("");
  /** s since the begin of the recording. */
  readonly position = signal(0);
  readonly playing = signal(false);
  readonly speed = signal<Speed>("1");
  /** Counts openings and closings: replies to an earlier one are late. */
  private n = 0;
  private nSeeks = 0;
  private waits = false;
  private stale = false;
  /** s: the moment whose map the page has; null: it needs all tiles. */
  private has: number | null = null;

  constructor(
    private readonly run: Run,
    private readonly stage: Stage,
  ) {}

  async open(name: string): Promise<void> {
    const n = ++this.n;
    this.opening.value = name;
    const reply = await this.run("replay_open", { name }, TIMEOUT_MS);
    if (n !== this.n) return;
    this.opening.value = "";
    if (!reply.accepted) return this.stage.refuse(reply);
    this.opened.value = reply.data as OpenedReplay;
    this.stage.begin(this.opened.value);
    this.waits = this.playing.value = false;
    this.seek(this.opened.value.start);
  }

  close(): void {
    this.n++;
    this.opening.value = "";
    this.playing.value = this.waits = this.stale = false;
    if (this.opened.peek() === null) return;
    this.opened.value = null;
    this.stage.end();
  }

  /** Shows the moment `t`, s, with the next tick. */
  seek(t: number): void {
    this.nSeeks++;
    this.has = null;
    this.move(t);
  }

  /** Plays or stands; at the end it begins again. */
  toggle(): void {
    const opened = this.opened.peek();
    if (opened === null) return;
    if (!this.playing.peek() && this.position.peek() >= opened.length) this.seek(0);
    this.playing.value = !this.playing.peek();
  }

  /** To be called each REPLAY_TICK_MS. elapsed: ms since the last time. */
  tick(elapsed: number): void {
    const opened = this.opened.peek();
    if (opened === null) return;
    if (this.playing.peek()) {
      this.move(this.position.peek() + (elapsed / 1e3) * Number(this.speed.peek()));
      if (this.position.peek() >= opened.length) this.playing.value = false;
    }
    if (this.stale && !this.waits) void this.ask(opened.name);
  }

  private move(t: number): void {
    this.position.value = Math.min(Math.max(t, 0), this.opened.peek()?.length ?? 0);
    this.stale = true;
  }

  /** Asks for the moment, part by part. A reply is late after a close, and one of playing after a seek. */
  private async ask(name: string): Promise<void> {
    const { n, nSeeks, has } = this;
    const t = this.position.peek();
    const since = has === null ? {} : { since: has };
    this.waits = true;
    this.stale = false;
    for (let first = 0, left = 1; left > 0; ) {
      const reply = await this.run("replay_at", { name, t, first, ...since }, TIMEOUT_MS);
      if (n !== this.n) return;
      if (!reply.accepted) {
        this.playing.value = false;
        this.stage.refuse(reply);
        break;
      }
      const sought = nSeeks !== this.nSeeks;
      if (sought && has !== null) break;
      const state = reply.data as ReplayState;
      this.stage.show(state);
      left = state.tiles.left;
      first += state.tiles.rows.length;
      if (sought) break;
      this.has = left > 0 ? null : t;
    }
    this.waits = false;
  }
}
