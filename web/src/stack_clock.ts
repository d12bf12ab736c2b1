// SPDX-License-Identifier: Apache-2.0
// The stack's clock as this page sees it: from pongs. It may run faster than the browser's, in simulation.

const MAX_RATE = 100; // a simulation is not faster

export class StackClock {
  /** Round trip time of the newest ping, ms; null before the first. */
  rtt: number | null = null;
  private stamp = 0; // ns
  private at = 0; // ms of performance.now() at which the stack's clock had `stamp`
  private rate = 1; // stack seconds in a browser second

  /** A pong with the stack's time `now` (ns) came at `at` (ms) for a ping of `sent` (ms). */
  update(now: number, sent: number, at: number): void {
    this.rtt = at - sent;
    const middle = (at + sent) / 2;
    const elapsed = middle - this.at;
    if (this.stamp > 0 && elapsed > 500) {
      const rate = (now - this.stamp) / 1e6 / elapsed;
      if (rate >= 0 && rate < MAX_RATE) this.rate = Math.abs(rate - 1) < 0.05 ? 1 : rate;
    }
    this.stamp = now;
    this.at = middle;
  }

  reset(): void {
    this.rtt = null;
    this.stamp = 0;
    this.rate = 1;
  }

  /** Age of a stamp (ns) at `at` (ms), in s of the stack's clock; null before the first pong. */
  age(stamp: number, at: number): number | null {
    return this.stamp === 0 ? null : (this.stamp - stamp) / 1e9 + ((at - this.at) / 1e3) * this.rate;
  }
}
