// SPDX-License-Identifier: Apache-2.0
// Connects the inputs of teleoperation (keys, gamepad, focus of the page) with its state machine.

import { effect, signal } from "@preact/signals";

import { send } from "./connection";
import { following } from "./map/following";
import { connected, hello } from "./state";
import { DRIVE_KEYS, gamepadDeflection, keysDeflection, Teleop, TELEOP_PERIOD_MS } from "./teleop";

export const armed = signal(false);
export const speedShare = signal(0.5);
/** The command that is sent now, or null while no input is held. */
export const command = signal<{ v: number; w: number } | null>(null);

export const teleop = new Teleop(
  (frame) => {
    send(frame);
    command.value = frame.t === "teleop" ? { v: frame.v, w: frame.w } : null;
  },
  () => {
    const robot = hello.peek()?.robot;
    return {
      forward: robot?.max_speed ?? 0,
      reverse: robot?.max_reverse_speed ?? 0,
      turn: robot?.max_turn_rate ?? 0,
    };
  },
);

const pressed = new Set<string>();
/** Keys while which a browser may not report that another one was released: Cmd on macOS, and the menu key. */
const NO_KEYUP: ReadonlySet<string> = new Set(["Meta", "ContextMenu"]);

export function isTextInput(target: EventTarget | null): boolean {
  if (target instanceof HTMLTextAreaElement) return true;
  const types = ["text", "search", "number", "url", "email", "password"];
  return target instanceof HTMLInputElement && types.includes(target.type);
}

/** Installs the inputs and every event that ends driving. To be called once. */
export function startDriving(): void {
  setInterval(() => {
    pollGamepad();
    teleop.tick();
  }, TELEOP_PERIOD_MS);
  window.addEventListener("keydown", (event) => {
    if (NO_KEYUP.has(event.key)) letGo();
    const plain = !event.ctrlKey && !event.metaKey && !event.altKey;
    if (!armed.peek() || !plain || !DRIVE_KEYS.has(event.code) || isTextInput(event.target)) return;
    if (event.target instanceof HTMLInputElement) return; // arrows move a slider
    event.preventDefault();
    if (event.repeat) return; // a key that was down before a blur does not drive again
    pressed.add(event.code);
    holdKeys();
  });
  window.addEventListener("keyup", (event) => {
    if (NO_KEYUP.has(event.key)) letGo();
    if (pressed.delete(event.code)) holdKeys();
  });
  for (const type of ["blur", "pagehide"]) window.addEventListener(type, letGo);
  document.addEventListener("visibilitychange", () => {
    if (document.hidden) letGo();
  });
  effect(() => {
    teleop.share = speedShare.value;
  });
  effect(() => {
    const on = armed.value && connected.value;
    if (!connected.value) armed.value = false;
    if (on) {
      teleop.arm();
      following.value = true; // the driver sees the robot
    }
    else {
      letGo();
      teleop.disarm();
    }
  });
}

/** Ends driving now. Each input counts again only after it was released. */
export function letGo(): void {
  pressed.clear();
  teleop.letGo();
  teleop.release("keys");
}

function holdKeys(): void {
  const deflection = keysDeflection(pressed);
  if (deflection === null) teleop.release("keys");
  else teleop.hold("keys", deflection);
}

/** Reads the first gamepad whose stick is moved. A gamepad that is unplugged counts as released. */
function pollGamepad(): void {
  if (!armed.peek() || document.hidden || !document.hasFocus()) return;
  const pads = navigator.getGamepads().filter((pad) => pad?.connected);
  const deflections = pads.map((pad) => gamepadDeflection(pad?.axes ?? []));
  const deflection = deflections.find((value) => value !== null);
  if (deflection) teleop.hold("gamepad", deflection);
  else teleop.release("gamepad");
}
