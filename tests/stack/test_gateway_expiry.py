# SPDX-License-Identifier: Apache-2.0
"""A member's certificate ends while the robot drives: its task goes on, and driving by hand ends with zero."""

import socket
import threading
import time
from contextlib import suppress
from math import pi

import pytest

from shared import requests, topics
from shared.config import UserError
from shared.geometry import Pose2
from shared.messages import LogLine, NavState, Velocity
from shared.requests import Navigate
from shared.runners.transport import StackAddress
from shared.secure_folder import SecureFolder
from tests.stack.brief_certificate import admit_brief, brief_credentials
from tests.stack.processes import ALL, ROBOT, StackProcesses, running, wait
from zenav.client import Client
from zenav.secure import members

HOLDS_S = 9.0  # of the certificate, from before the member connects
ZERO_S = 2.0  # the robot has braked by then: the zero command comes after 0.25 s


class RemoteStack:
    """A stack whose gateway lets members in."""

    def __init__(self, stack: StackProcesses, place: SecureFolder, address: str) -> None:
        self.stack, self.place, self.address = stack, place, address
        self.lines: list[str] = []
        stack.client.listen(topics.LOG, lambda line, _: self._log(line))

    def _log(self, line: LogLine) -> None:
        self.lines.append(line.text)

    def brief_member(self) -> Client:
        """A tool's session of a member whose certificate ends soon, once the gateway lets it in."""
        self.lines.clear()
        admit_brief(self.place)
        self.stack.until(lambda: any("the gateway listens, and lets 1 member in" in line for line in self.lines), 60)
        credentials = brief_credentials(self.place, ROBOT.name, HOLDS_S)
        return Client(ROBOT.name, StackAddress(router=f"tls/{self.address}", credentials=credentials))

    def accepted_task(self, member: Client, poses: tuple[Pose2, ...]) -> int:
        """The number of a task that drives through the poses three times, once the gateway knows the member."""
        tasks: list[int] = []

        def asked() -> bool:
            request = Navigate(member.now(), poses, dwell=0.0, loops=3, any_heading=False)
            with suppress(UserError):
                reply = member.ask(requests.NAVIGATE, request, 1.0)
                tasks.extend([reply.task_id] if reply.accepted else [])
            return bool(tasks)

        self.stack.until(asked)
        return tasks[0]

    def is_cut_off(self) -> bool:
        return any("brief (operator) disconnected" in line for line in self.lines)

    def turn_rate(self) -> float:
        """rad/s of the simulated robot."""
        truth = self.stack.client.latest(topics.TRUTH)
        assert truth is not None
        return abs(truth.w)


@pytest.fixture(scope="module")
def remote(tmp_path_factory):
    folder = tmp_path_factory.mktemp("remote")
    place = SecureFolder(folder / "secure")
    members.init_folder("x80sv", str(place.path), [])
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        address = f"127.0.0.1:{probe.getsockname()[1]}"
    settings = (f"gateway.port.device=tls://{address}", f"gateway.folder={place.path}")
    with running(folder, (*ALL, "gateway"), settings=settings) as stack:
        yield RemoteStack(stack, place, address)


def test_a_task_goes_on_when_the_certificate_of_its_member_ends(remote):
    stack = remote.stack
    with remote.brief_member() as member:
        poses = (Pose2(0.8, 0.0, 0.0), Pose2(0.0, 0.0, pi))
        task = remote.accepted_task(member, poses)
        stack.until(remote.is_cut_off, 40)
        status = stack.client.latest(topics.NAV_STATUS)
        assert status is not None
        assert (status.task_id, status.state) == (task, NavState.NAVIGATING), "ended before its certificate"
        stack.until(stack.reached(task), 90)


def test_a_robot_that_a_member_drives_by_hand_stands_when_its_certificate_ends(remote):
    """To and fro, 20 times a second, until long after the end."""
    stack = remote.stack
    with remote.brief_member() as member:
        ended = threading.Event()

        def drive() -> None:
            while not ended.wait(0.05):
                turn = 0.8 if time.monotonic() % 6 < 3 else -0.8
                member.publish(topics.TELEOP(Velocity(member.now(), 0.0, turn, "")))

        driver = threading.Thread(target=drive)
        driver.start()
        try:
            stack.until(lambda: remote.turn_rate() > 0.3, 20)
            stack.until(remote.is_cut_off, 40)
            until = time.monotonic() + ZERO_S
            stack.until(lambda: time.monotonic() > until)
            until += 2
            while time.monotonic() < until:
                assert remote.turn_rate() < 0.02
                wait(0.05)
        finally:
            ended.set()
            driver.join()
