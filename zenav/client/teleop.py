# SPDX-License-Identifier: Apache-2.0
"""`zenav teleop`: keys or a gamepad to velocities, 20 times a second."""

import os
import select
import sys
import time
from math import radians

from shared import requests, topics
from shared.config import load_robot
from shared.messages import Velocity
from shared.requests import Override
from shared.runners.transport import stack_address
from shared.stop_button import StopButton
from shared.task_state import stop_reason
from zenav.client import Client
from zenav.client.gamepad_device import GamepadDevice
from zenav.client.navigation_client import refusal_error
from zenav.console.raw_terminal import raw_terminal
from zenav.console.shutdown import stop_on_signal

PERIOD = 0.05  # s
OVERRIDE, AGAIN = 1.0, 0.4  # s that the field is overridden for, and after which that is asked for again
OVERRIDE_WARNING = "\a\033[1;31mOVERRIDE: the guard does not stop for anything in the way\033[0m\n"
KEY_HOLD_S = 0.6  # s that a key counts as held: longer than a terminal waits before it repeats
KEYS = {
    "w": (1, 0), "s": (-1, 0), "a": (0, 1), "d": (0, -1), "q": None, "\x03": None, "\x04": None,
    "\x1b[A": (1, 0), "\x1b[B": (-1, 0), "\x1b[D": (0, 1), "\x1b[C": (0, -1),
    "\x1bOA": (1, 0), "\x1bOB": (-1, 0), "\x1bOD": (0, 1), "\x1bOC": (0, -1),
}  # fmt: skip


class TeleopKeys:
    """Which way the held keys point. Forward and turn are held apart, so that w and a together drive a curve."""

    def __init__(self) -> None:
        self._forward = self._turn = (0, float("-inf"))
        self.ended = False

    def press(self, text: str, now: float) -> None:
        """Takes what the terminal sent, at `now` s."""
        while text:
            key = next((k for k in KEYS if text.startswith(k)), text[0])
            text = text[len(key) :]
            direction = KEYS.get(key, (0, 0))
            if direction is None:
                self.ended = True
            elif direction == (0, 0):  # space, or any other key: stand
                self._forward = self._turn = (0, now)
            elif direction[0]:
                self._forward = direction[0], now
            else:
                self._turn = direction[1], now

    def direction(self, now: float) -> tuple[int, int]:
        """(forward, turn), each -1, 0 or 1, at `now` s; a key that is no longer held counts for nothing."""
        return tuple(sign if now - at < KEY_HOLD_S else 0 for sign, at in (self._forward, self._turn))  # type: ignore[return-value]  # two in, two out


def teleop(robot: str, stack: str, speed: float, turn: float, override: bool) -> None:
    """Drives by keys until q; speed in m/s, turn in degrees/s. While it runs, it has the robot: no key is to stand.

    override: nothing but the driver keeps the robot from what is in its way. Raises UserError where the guard refuses.
    """
    keys = TeleopKeys()
    last_override = float("-inf")
    with (
        raw_terminal() as terminal,
        stop_on_signal() as stop,
        Client(load_robot(robot).robot.name, stack_address(stack)) as client,
    ):
        client.follow(topics.GUARD, topics.ODOM)
        sys.stderr.write("w a s d or arrows drive, space stops, q quits\n" + (OVERRIDE_WARNING if override else ""))
        due = time.monotonic()
        while not (stop.is_set() or keys.ended):
            readable, _, _ = select.select([terminal], [], [], max(0.0, due - time.monotonic()))
            if readable:
                keys.press(os.read(terminal, 256).decode(errors="replace") or "q", time.monotonic())
                continue
            due += PERIOD
            if override and due - last_override >= AGAIN:
                _override(client, OVERRIDE)
                last_override = due
            forward, turning = keys.direction(time.monotonic())
            client.publish(topics.TELEOP(Velocity(client.now(), forward * speed, turning * radians(turn), "")))
            _show(client)
        client.publish(topics.TELEOP(Velocity(client.now(), 0.0, 0.0, "")))
        if override:
            _override(client, 0.0)
    sys.stderr.write("\n")


def teleop_gamepad(robot: str, stack: str, speed: float, turn: float, device: str) -> None:
    """Drives by a gamepad until Ctrl-C; speed in m/s, turn in degrees/s, at full stick.

    It publishes while the dead-man button is held, then zero once. So other tools may drive meanwhile. A gamepad that
    is gone counts as released. device: its path; empty: the first one.
    """
    with (
        stop_on_signal() as stop,
        GamepadDevice(device) as gamepad,
        Client(load_robot(robot).robot.name, stack_address(stack)) as client,
    ):
        client.follow(topics.GUARD, topics.ODOM)
        sys.stderr.write("hold a shoulder button and use the sticks; B or circle is STOP; Ctrl-C quits\n")
        due, drove, stop_button = time.monotonic(), False, StopButton()
        while not stop.is_set():
            descriptor = gamepad.descriptor
            waiting = [descriptor] if descriptor is not None else []
            readable, _, _ = select.select(waiting, [], [], max(0.0, due - time.monotonic()))
            if readable:
                gamepad.read()
                continue
            due = max(due + PERIOD, time.monotonic())
            is_there = gamepad.open()
            if gamepad.gamepad.take_stop():
                client.publish(topics.ESTOP(stop_button.set(True, "gamepad", client.now())))
            if (guard := client.latest(topics.GUARD)) is not None:
                stop_button.confirm(guard)
            pressed, _ = stop_button.tick(client.now())
            if pressed is not None:
                client.publish(topics.ESTOP(pressed))
            drives = gamepad.gamepad.drives(due)
            if drives or drove:
                forward, turning = gamepad.gamepad.direction(due)
                client.publish(topics.TELEOP(Velocity(client.now(), forward * speed, turning * radians(turn), "")))
            drove = drives
            if is_there:
                _show(client)
            else:
                _show_line(gamepad.detail)
        client.publish(topics.TELEOP(Velocity(client.now(), 0.0, 0.0, "")))
    sys.stderr.write("\n")


def _override(client: Client, seconds: float) -> None:
    """Asks the guard; a guard that does not answer at once is asked in vain, and the robot stands."""
    reply = client.ask(requests.OVERRIDE, Override(client.now(), seconds), timeout=1.0)
    if not reply.accepted:
        raise refusal_error(reply)


def _show(client: Client) -> None:
    odom, guard = client.latest(topics.ODOM), client.latest(topics.GUARD)
    if guard is None or client.age(topics.GUARD) > 1.0:
        line = "the guard does not answer: start the stack: zenav up"
    else:
        driven = f"{odom.v:+.2f} m/s {odom.w:+.2f} rad/s" if odom else "no odometry"
        line = f"{driven}  {guard.state}  {stop_reason(None, guard)}"
    _show_line(line)


def _show_line(line: str) -> None:
    sys.stderr.write(f"\r\033[K{line[:100]}")
    sys.stderr.flush()
