# SPDX-License-Identifier: Apache-2.0
"""A manoeuvre on a running stack: through the guard like any teleop, with everything that is heard kept in a log."""

import sys
import threading
import time
from typing import Any

from shared import topics
from shared.config import Robot, UserError
from shared.messages import EmergencyStop, Message, NavState, Velocity
from shared.runners.transport import stack_address
from zenav.calibrate.log import TOPICS, calibration_log
from zenav.calibrate.manoeuvre import HZ, Manoeuvre, StackState, T, VelocityStep
from zenav.client import Client
from zenav.console.shutdown import StopFlag, stop_on_signal

BY = "zenav calibrate"
WAIT = 5.0  # s for the stack to answer
BUSY = (NavState.NAVIGATING, NavState.EXPLORING, NavState.RECOVERING)
LAST_WORDS = 5  # zeros that are sent at the end, one a step: a lost one must not matter


def confirm(what: str, yes: bool) -> None:
    """Shows the operator what the robot will do, and asks. Raises UserError where the answer is not yes."""
    sys.stderr.write(f"{what}\nCtrl-C stops it at any time; keep the STOP button at hand.\n")
    if yes:
        return
    if not sys.stdin.isatty():
        raise UserError("no terminal to confirm the drive", "say --yes where the floor is free")
    sys.stderr.write("Go? [y/N] ")
    sys.stderr.flush()
    if sys.stdin.readline().strip().lower() not in ("y", "yes"):
        raise UserError("not started", "answer y when the floor is free")


class ManoeuvreRunner:
    """A session that drives manoeuvres and keeps what is heard meanwhile."""

    def __init__(self, robot: Robot, stack: str) -> None:
        self.log = calibration_log(robot)
        self._client = Client(robot.name, stack_address(stack))
        self._lock = threading.Lock()
        self._pressed = False  # by us
        self._others = False  # somebody else pressed STOP

    def __enter__(self) -> "ManoeuvreRunner":
        self._client.__enter__()
        for topic in TOPICS:
            self._client.listen(topic, lambda message, _: self._keep(message))
        self._client.follow(topics.ODOM, topics.POSE, topics.GUARD, topics.NAV_STATUS)
        self._client.listen(topics.ESTOP, lambda stop, _: self._hear(stop))
        return self

    def __exit__(self, *error: Any) -> None:
        self._client.__exit__(*error)

    def perform(self, manoeuvre: Manoeuvre[T]) -> T:
        """Drives it to its end. Ctrl-C, SIGTERM and every error stop the robot first.

        Raises KeyboardInterrupt where it was interrupted, UserError where the robot cannot do it.
        """
        client = self._client
        if client.wait(topics.GUARD, lambda _: True, WAIT) is None:
            raise UserError("the guard does not answer", "start the stack: zenav up")
        nav = client.latest(topics.NAV_STATUS) or client.latched_value(topics.NAV_STATUS, 1.0)
        if nav is not None and nav.state in BUSY:
            raise UserError(f"the robot is {nav.state}", "end its task first: zenav cancel")
        with stop_on_signal() as stop:
            try:
                return self._performed(manoeuvre, stop)
            except KeyboardInterrupt:
                sys.stderr.write("interrupted: the robot is commanded to stop\n")
                raise
            finally:
                self._stand()

    def _performed(self, manoeuvre: Manoeuvre[T], stop: StopFlag) -> T:
        ask, due = next(manoeuvre), time.monotonic()
        while True:
            self._send(ask)
            due = max(due + 1 / HZ, time.monotonic())
            if stop.wait(max(0.0, due - time.monotonic())):
                raise KeyboardInterrupt
            if self._others:
                raise UserError("somebody pressed STOP", "look at the robot; then: zenav estop --release")
            try:
                ask = manoeuvre.send(self._seen())
            except StopIteration as end:
                return end.value  # type: ignore[no-any-return]  # the generator's own type

    def _seen(self) -> StackState:
        latest = self._client.latest
        return StackState(self._client.now(), latest(topics.ODOM), latest(topics.POSE), latest(topics.GUARD))

    def _send(self, ask: VelocityStep) -> None:
        client = self._client
        if ask.say:
            sys.stderr.write(f"{ask.say}\n")
        if ask.stop != self._pressed:
            self._pressed = ask.stop
            client.publish(topics.ESTOP(EmergencyStop(client.now(), ask.stop, BY)))
        client.publish(topics.TELEOP(Velocity(client.now(), ask.v, ask.w, "")))

    def _stand(self) -> None:
        """Zero, a few times; and our own STOP is released, which moves nothing, unless somebody else pressed it too."""
        for _ in range(LAST_WORDS):
            self._client.publish(topics.TELEOP(Velocity(self._client.now(), 0.0, 0.0, "")))
            if self._pressed and not self._others:
                self._client.publish(topics.ESTOP(EmergencyStop(self._client.now(), False, BY)))
            time.sleep(1 / HZ)  # noqa: TID251  # nothing to wait for: the zeros must not come in one burst
        self._pressed = False

    def _keep(self, message: Message) -> None:
        with self._lock:
            self.log.add(message)

    def _hear(self, stop: EmergencyStop) -> None:
        self._others = stop.pressed and (stop.by != BY or self._others)
