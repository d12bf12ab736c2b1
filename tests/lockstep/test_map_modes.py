# SPDX-License-Identifier: Apache-2.0
"""A map saved by one stack, taken by another: until the robot is found nothing drives but a person's hand."""

import pytest

from services.mapper.maps.map_file import unpack_map
from shared import reasons, topics
from shared.messages import Localization, MapMode, NavState, Velocity
from shared.recording import CONFIG, Writer, sink
from shared.runners.lockstep import Lockstep
from tests.lockstep.stack import HALL, QUICK, LockstepStack
from zenav.client.map_transfer import fetch_map, give_map, start_mode
from zenav.client.navigation_client import RequestRefusedError
from zenav.replay.reprocess import replay_file
from zenav.stack.service_loader import build_service

ELSEWHERE = HALL.replace("start: {x: 1.0, y: 2.0}", "start: {x: 6.5, y: 1.6, yaw_deg: 115}")


class StackMapClient:
    """A tool on a lockstep stack."""

    def __init__(self, lockstep: Lockstep) -> None:
        self.lockstep = lockstep
        self.wait = lockstep.run

    def now(self):
        return self.lockstep.now

    def ask(self, request, message):
        return self.lockstep.ask(request, message)


def fetch(stack: LockstepStack) -> bytes:
    asker = StackMapClient(stack.lockstep)
    return fetch_map(asker, asker.wait)


def start(stack: LockstepStack, mode: MapMode, content: bytes = b"", at=None) -> None:
    asker = StackMapClient(stack.lockstep)
    transfer = give_map(asker, asker.wait, content) if content else 0
    assert start_mode(asker, asker.wait, mode, transfer, at).accepted


def by_hand(stack: LockstepStack, v: float, w: float, seconds: float) -> None:
    for _ in range(round(seconds * 20)):
        stack.lockstep.publish(topics.TELEOP(Velocity(stack.now, v, w, "")))
        stack.lockstep.run(0.05)


@pytest.fixture(scope="module")
def saved(tmp_path_factory) -> bytes:
    """A map of the hall, saved while the robot drives on."""
    stack = LockstepStack(tmp_path_factory.mktemp("saved"), settings=QUICK)
    stack.go(7.0)
    stack.drives()
    early = unpack_map(fetch(stack), "early")
    stack.until(stack.reached, 40.0)
    stack.go(0.5, 0.5)
    stack.drives()
    content = fetch(stack)
    assert stack.commanded, "it was not stopped for that"
    assert len(unpack_map(content, "late").keyframes) > len(early.keyframes) > 0
    return content


def test_on_a_loaded_map_nothing_drives_until_the_robot_was_driven_to_be_found(saved, tmp_path):
    stack = LockstepStack(tmp_path, ELSEWHERE, settings=QUICK)
    start(stack, MapMode.LOCALISE, saved)
    stack.lockstep.run(0.5)
    assert stack.newest["pose"].state is Localization.LOST
    stack.go(2.0)
    stack.stands_for(5.0)
    assert stack.newest["nav/status"].reason == reasons.POSE_LOST.code
    assert stack.newest["pose"].state is Localization.LOST, "a standing robot sees too little"
    for k in range(40):
        by_hand(stack, 0.25, 0.35 if k % 4 < 2 else -0.35, 1.0)
        if stack.newest["pose"].state is Localization.GOOD:
            break
    assert stack.newest["pose"].state is Localization.GOOD
    assert stack.newest["pose"].mode is MapMode.LOCALISE
    by_hand(stack, 0.0, 0.0, 0.5)  # a pose is a tenth of a second old: compared while it turns, that is 15 cm over 4 m
    hall_from_map = stack.truth.world_from_base @ stack.newest["pose"].map_from_base.inverse()
    assert (hall_from_map.x, hall_from_map.y, hall_from_map.yaw) == pytest.approx((1.0, 2.0, 0.0), abs=0.05)
    stack.until(stack.reached, 60.0)
    assert fetch(stack) == saved, "to the byte"


def test_a_map_that_is_refused_stops_nothing(saved, tmp_path):
    stack = LockstepStack(tmp_path, settings=QUICK)
    stack.go(4.0)
    stack.drives()
    with pytest.raises(RequestRefusedError, match="checksum"):
        start(stack, MapMode.LOCALISE, saved[:-1] + b"?")
    assert stack.commanded
    stack.until(stack.reached, 30.0)


def test_a_task_ends_with_its_map(tmp_path):
    stack = LockstepStack(tmp_path, settings=QUICK)
    stack.go(7.0)
    stack.drives()
    start(stack, MapMode.LOCALISE)
    stack.drives()
    assert stack.newest["nav/status"].state is NavState.NAVIGATING, "it is the same map"
    start(stack, MapMode.MAP)
    stack.until(lambda: not stack.commanded, 3.0)
    stack.lockstep.run(0.5)
    stack.stands_for(2.0)
    assert stack.newest["nav/status"].state is NavState.CANCELED
    assert stack.newest["nav/status"].reason == reasons.OTHER_MAP.code


def test_a_run_in_which_maps_come_and_go_is_replayed_to_the_byte(saved, tmp_path):
    path, names = tmp_path / "run.mcap", ("sim", "base_driver", "odometry", "mapper")
    world = tmp_path / "world.yaml"
    world.write_text(HALL)
    file = LockstepStack(tmp_path).file
    with Writer(path, {"robot": file.robot.name}, {CONFIG: file.text.encode()}) as writer:
        lockstep = Lockstep({name: build_service(name, file, file.robot) for name in names}, sink(writer))
        asker = StackMapClient(lockstep)
        lockstep.run(2.0)
        parts = saved + bytes(3 * 2**20)  # what is no map, in more parts than one journal message holds
        with pytest.raises(RequestRefusedError):
            start_mode(asker, asker.wait, MapMode.CONTINUE, give_map(asker, asker.wait, parts))
        start_mode(asker, asker.wait, MapMode.LOCALISE, give_map(asker, asker.wait, saved))
        lockstep.run(1.5)
        assert fetch_map(asker, asker.wait) == saved
        start_mode(asker, asker.wait, MapMode.MAP)
        lockstep.run(1.5)
        lockstep.flush()
    report = replay_file(
        path, ["mapper"], None, lambda name: build_service(name, file, file.robot), lambda done, of: None
    )
    assert report.notes == []
    assert report.equal, report.topics
