// SPDX-License-Identifier: Apache-2.0
// Teleoperation as a state machine: the robot moves only while an input is held, and `let_go` follows at once after it.

/** Share of the top speed: `forward` 1 ahead .. -1 back, `turn` 1 left .. -1 right. */
export interface Deflection {
  readonly forward: number;
  readonly turn: number;
}

/** Top speeds, m/s and rad/s. */
export interface SpeedLimits {
  readonly forward: number;
  readonly reverse: number;
  readonly turn: number;
}

export type TeleopFrame = { t: "teleop"; v: number; w: number; n: number } | { t: "let_go" };

export const TELEOP_PERIOD_MS = 50; // 20 Hz; the robot gets zero 200 ms after the last frame

export class Teleop {
  /** Inputs count only while the panel is armed. */
  armed = false;
  /** Share of the top speeds, 0 .. 1. */
  share = 0.5;
  private readonly held = new Map<string, Deflection>();
  /** Inputs that were let go while they were still deflected: each must be released before it counts again. */
  private readonly locked = new Set<string>();
  private n = 0;

  constructor(
    private readonly send: (frame: TeleopFrame) => void,
    private readonly limits: () => SpeedLimits,
  ) {}

  get driving(): boolean {
    return this.held.size > 0;
  }

  /** An input ("stick", "keys", "gamepad") is held at this deflection. The first one sends a frame at once. */
  hold(source: string, deflection: Deflection): void {
    if (!this.armed || this.locked.has(source)) return;
    const starts = !this.driving;
    this.held.set(source, deflection);
    if (starts) this.tick();
  }

  /** An input is no longer held. The last one lets go. */
  release(source: string): void {
    this.locked.delete(source);
    if (this.held.delete(source) && !this.driving) this.send({ t: "let_go" });
  }

  /** Lets go of all inputs: blur, hidden page, cancelled pointer, lost link, STOP. */
  letGo(): void {
    if (!this.driving) return;
    for (const source of this.held.keys()) this.locked.add(source);
    this.held.clear();
    this.send({ t: "let_go" });
  }

  /** Inputs count from now on, a gamepad only after it was at rest. */
  arm(): void {
    if (!this.armed) this.locked.add("gamepad");
    this.armed = true;
  }

  disarm(): void {
    this.armed = false;
    this.letGo();
  }

  /** To be called each TELEOP_PERIOD_MS: repeats the command while an input is held. */
  tick(): void {
    if (!this.driving) return;
    const { v, w } = this.velocity();
    this.send({ t: "teleop", v, w, n: ++this.n });
  }

  /** The command of all held inputs together, m/s and rad/s. */
  velocity(): { v: number; w: number } {
    let forward = 0;
    let turn = 0;
    for (const deflection of this.held.values()) {
      forward += deflection.forward;
      turn += deflection.turn;
    }
    const limits = this.limits();
    const v = clamp(forward) * this.share * (forward < 0 ? limits.reverse : limits.forward);
    return { v, w: clamp(turn) * this.share * limits.turn };
  }
}

/** Deflection of the pressed keys, or null where none of them drives. */
export function keysDeflection(codes: ReadonlySet<string>): Deflection | null {
  const sum = (plus: readonly string[], minus: readonly string[]): number =>
    Number(plus.some((code) => codes.has(code))) - Number(minus.some((code) => codes.has(code)));
  if (![...codes].some((code) => DRIVE_KEYS.has(code))) return null;
  return { forward: sum(AHEAD, BACK), turn: sum(LEFT, RIGHT) };
}

const AHEAD = ["KeyW", "ArrowUp"];
const BACK = ["KeyS", "ArrowDown"];
const LEFT = ["KeyA", "ArrowLeft"];
const RIGHT = ["KeyD", "ArrowRight"];
export const DRIVE_KEYS: ReadonlySet<string> = new Set([...AHEAD, ...BACK, ...LEFT, ...RIGHT]);

const MIN_AXIS = 0.12; // of a gamepad's axis: worn sticks do not return to 0

/** Deflection of a gamepad's axes (left stick: ahead; left or right stick: turn), or null in its dead zone. */
export function gamepadDeflection(axes: readonly number[]): Deflection | null {
  const axis = (value: number | undefined): number => {
    const size = Math.abs(value ?? 0);
    return size < MIN_AXIS ? 0 : (Math.sign(value ?? 0) * (size - MIN_AXIS)) / (1 - MIN_AXIS);
  };
  const forward = 0 - axis(axes[1]);
  const turn = 0 - (axis(axes[0]) || axis(axes[2]));
  return forward === 0 && turn === 0 ? null : { forward, turn };
}

function clamp(value: number): number {
  return Math.min(1, Math.max(-1, value));
}
