# SPDX-License-Identifier: Apache-2.0
"""A laser that goes wrong now and then: the robot arrives all the same, and whole sweeps of nonsense stop it."""

from dataclasses import replace
from functools import partial
from math import pi
from typing import ClassVar

import numpy as np
import pytest

from services.sim.service import SimService
from shared import topics
from shared.messages import GuardState, LaserScan, Velocity
from tests.lockstep.stack import MS, QUICK, LockstepStack

pytestmark = pytest.mark.timeout(600)  # with an empty cache the kernels are compiled here

MOUNT_YAW = -pi / 2


def ahead(scan: LaserScan, half: float) -> np.ndarray:
    """Which beams of the X80SV's laser look straight ahead, or up to `half` rad beside that."""
    bearings = scan.angle_min + scan.angle_increment * np.arange(len(scan.ranges)) + MOUNT_YAW
    return np.abs((bearings + pi) % (2 * pi) - pi) <= half


def mostly_none(scan: LaserScan) -> LaserScan:
    """One beam of twenty returns, another each time."""
    kept = np.arange(len(scan.ranges)) % 20 == scan.stamp // 1000 % 20
    return replace(scan, ranges=np.where(kept, scan.ranges, np.nan).astype(np.float32))


SPOILED = {
    "infinite": lambda scan: replace(scan, ranges=np.full_like(scan.ranges, np.inf)),
    "own body": lambda scan: replace(scan, ranges=np.full_like(scan.ranges, 0.06)),
    "mostly no echo": mostly_none,
    "dark ahead": lambda scan: replace(scan, ranges=np.where(ahead(scan, pi / 6), np.float32(np.nan), scan.ranges)),
    "half the beams": lambda scan: replace(
        scan, ranges=scan.ranges[::2].copy(), angle_increment=2 * scan.angle_increment
    ),
    "other increment": lambda scan: replace(scan, angle_increment=0.8 * scan.angle_increment),
    "no echo": lambda scan: replace(scan, ranges=np.full_like(scan.ranges, np.nan)),
    "zeros": lambda scan: replace(scan, ranges=np.zeros_like(scan.ranges)),
    "beyond its range": lambda scan: replace(scan, ranges=np.full_like(scan.ranges, 200.0)),
    "too short": lambda scan: replace(scan, ranges=scan.ranges[: len(scan.ranges) // 3]),
    "two beams": lambda scan: replace(scan, ranges=scan.ranges[:2]),
    "holes": lambda scan: replace(scan, ranges=np.where(np.arange(len(scan.ranges)) % 2, np.nan, scan.ranges)),
    "from the past": lambda scan: replace(scan, stamp=scan.stamp - 10_000_000_000),
    "from the future": lambda scan: replace(scan, stamp=scan.stamp + 10_000_000_000),
}


class SpoiledLaser(SimService):
    """Every `every`-th scan is spoiled in one of the named ways, in turn; 0: none is."""

    every = 0
    ways: ClassVar[list[str]] = list(SPOILED)
    n_scans = 0
    first_bad = 0  # ns, when the first spoiled scan was published
    held: LaserScan | None = None

    def _due_scans(self) -> list[LaserScan]:
        return [self._spoiled(scan) for scan in super()._due_scans()]

    def _spoiled(self, scan: LaserScan) -> LaserScan:
        self.n_scans += 1
        if not self.every or self.n_scans % self.every:
            self.held = scan
            return scan
        self.first_bad = self.first_bad or self.now
        way = self.ways[self.n_scans // self.every % len(self.ways)]
        if way == "frozen":
            return replace(scan, ranges=self.held.ranges)
        return SPOILED[way](scan)


class DarkFromTheStart(SpoiledLaser):
    every = 1
    ways: ClassVar[list[str]] = ["dark ahead"]


class NothingFromTheStart(SpoiledLaser):
    every = 1
    ways: ClassVar[list[str]] = ["no echo"]


BlindFromTheStart = {"no echo": NothingFromTheStart, "dark ahead": DarkFromTheStart}


def spoiled(folder, every: int, ways: list[str], goal: float = 4.5) -> LockstepStack:
    """The stack at full speed, its laser gone wrong from now on. goal: m ahead of the start."""
    stack = LockstepStack(folder, sim=SpoiledLaser, settings=QUICK)
    stack.go(goal)
    stack.drives()
    sim = stack.lockstep.service("sim")
    sim.every, sim.ways = every, ways
    return stack


def test_scans_spoiled_in_every_way_do_not_keep_the_robot_from_its_goal(tmp_path):
    stack = spoiled(tmp_path, 3, list(SPOILED))
    stack.until(stack.ended, 60.0)
    assert stack.reached()
    assert stack.truth.n_contacts == 0
    assert (stack.truth.start @ stack.newest["pose"].map_from_base).distance(stack.truth.world_from_base) < 0.1


@pytest.mark.parametrize(
    ("way", "detail"),
    [("from the past", "scan: stamps are 10.0 s old"), ("from the future", "scan: stamps are 10.0 s ahead")],
)
def test_scans_of_another_time_alone_stop_the_robot_with_the_reason(tmp_path, way, detail):
    stack = spoiled(tmp_path, 1, [way])
    stack.until(lambda: not stack.commanded, 1.0)
    stack.lockstep.run(0.2)
    assert (stack.guard.reason, stack.guard.detail) == ("bad_stamps", detail)
    stack.until(lambda: abs(stack.truth.v) < 0.01, 1.0)
    stack.stands_for(1.0)
    stack.lockstep.service("sim").every = 0
    stack.until(stack.ended, 60.0)
    assert stack.reached()


LIMIT = {"scan_unlike": 250, "scan_frozen": 600, "scan_blind": 600}
"""ms from the first bad scan to zero: where one message shows the fault, and where several must."""
FAULTS = {
    "no echo": "scan_blind",
    "infinite": "scan_blind",
    "beyond its range": "scan_blind",
    "zeros": "scan_blind",
    "own body": "scan_blind",
    "mostly no echo": "scan_blind",
    "dark ahead": "scan_blind",
    "frozen": "scan_frozen",
    "two beams": "scan_unlike",
    "half the beams": "scan_unlike",
    "other increment": "scan_unlike",
}
BY_HAND = """
start: {x: 1.0, y: 2.0}
walls:
  - {points: [[0, 0], [3.5, 0], [3.5, 4], [0, 4]], closed: true}
"""
"""Two metres to drive into a wall."""


@pytest.mark.parametrize("way", FAULTS)
def test_a_laser_that_fails_stops_navigation_in_time_with_the_reason_and_back_it_goes_on(tmp_path, way):
    stack = spoiled(tmp_path, 1, [way], goal=3.0)
    stack.until(lambda: stack.lockstep.service("sim").first_bad, 0.2)
    assert stack.newest["nav/status"].distance_left > 1.2, "it does not stop because it arrives"
    bad_since = stack.lockstep.service("sim").first_bad
    stack.until(lambda: not stack.commanded, 2.0)
    assert stack.now - bad_since <= LIMIT[FAULTS[way]] * MS
    stack.until(lambda: stack.guard.reason == FAULTS[way], 0.5)
    assert stack.guard.state is GuardState.HOLD
    assert stack.guard.detail
    stack.until(lambda: abs(stack.truth.v) < 0.01, 1.0)
    stack.stands_for(1.5)
    assert stack.guard.reason == FAULTS[way]
    stack.lockstep.service("sim").every = 0
    stack.until(stack.ended, 60.0)
    assert stack.reached()
    assert stack.truth.n_contacts == 0


@pytest.mark.parametrize("way", FAULTS)
def test_a_hand_that_pushes_on_when_the_laser_fails_creeps_at_most_and_meets_no_wall(tmp_path, way):
    """No range sensor helps: only what the laser saw before keeps the robot from the wall, once it is blind."""
    said: set[str] = set()
    stack = LockstepStack(tmp_path, BY_HAND, sim=SpoiledLaser, settings=("robot.ranges=[]", *QUICK))
    by_hand(stack, 0.5)
    stack.drives(0.45)
    sim = stack.lockstep.service("sim")
    sim.every, sim.ways = 1, [way]
    stack.until(lambda: sim.first_bad, 0.2)
    stack.lockstep.watch("guard/status", lambda status: said.add(status.reason))
    stack.until(lambda: stack.newest["cmd/vel"].v <= 0.15 + 1e-6, 1.0)
    assert stack.now - sim.first_bad <= 850 * MS  # 0.3 s of no view, then it brakes from 0.5 to 0.15 m/s
    fast = stack.lockstep.run(14.0, lambda: stack.newest["cmd/vel"].v > 0.15 + 1e-6)
    assert not fast
    assert stack.truth.n_contacts == 0
    assert stack.truth.v < 0.01
    assert FAULTS[way] in said, "it creeps because of the fault"
    assert stack.guard.reason == ("obstacle" if FAULTS[way] == "scan_blind" else FAULTS[way])


@pytest.mark.parametrize("way", ["no echo", "dark ahead"])
def test_a_laser_that_never_saw_anything_ahead_lets_nobody_drive_fast_that_way(tmp_path, way):
    """Dark from the start: nothing proves that something is there, and nothing that it is not."""
    stack = LockstepStack(tmp_path, BY_HAND, sim=BlindFromTheStart[way], settings=("robot.ranges=[]", *QUICK))
    by_hand(stack, 0.5)
    fast = stack.lockstep.run(8.0, lambda: stack.newest["cmd/vel"].v > 0.15 + 1e-6)
    assert not fast
    assert stack.guard.reason == {"no echo": "scan_blind", "dark ahead": "scan_empty"}[way]


@pytest.mark.parametrize(
    ("way", "reason", "most"), [("no echo", "scan_blind", 0.0), ("dark ahead", "scan_empty", 0.15)]
)
def test_with_a_laser_that_never_saw_anything_ahead_a_goal_is_not_driven_to_fast(tmp_path, way, reason, most):
    """most: m/s."""
    stack = LockstepStack(tmp_path, sim=BlindFromTheStart[way], settings=("robot.ranges=[]", *QUICK))
    stack.go(4.5)
    fast = stack.lockstep.run(8.0, lambda: stack.newest["cmd/vel"].v > most + 1e-6)
    assert not fast
    assert stack.guard.reason == reason
    assert not stack.ended()


NOISELESS = ("sim.laser={sigma: 0.0, sigma_share: 0.0, resolution: 0.0, dropout: 0.0}",)
COARSE = ("sim.laser={sigma: 0.002, sigma_share: 0.0, resolution: 0.05, dropout: 0.0}",)


@pytest.mark.parametrize("settings", [NOISELESS, COARSE], ids=["noiseless", "steps of 5 cm"])
def test_a_laser_without_noise_that_really_repeats_is_no_fault(tmp_path, settings):
    stack = LockstepStack(tmp_path, settings=(*settings, *QUICK))
    said: set[str] = set()
    stack.lockstep.watch("guard/status", lambda status: said.add(status.reason))
    stack.lockstep.run(5.0)
    stack.go(4.5)
    stack.until(stack.ended, 60.0)
    assert stack.reached()
    stack.lockstep.run(5.0)
    stack.go(1.0)
    stack.until(stack.ended, 60.0)
    assert stack.reached()
    assert not said & {"scan_frozen", "scan_blind", "scan_unlike"}


def test_the_mapper_places_no_scan_of_a_laser_that_repeats_itself(tmp_path):
    stack = spoiled(tmp_path, 1, ["frozen"])
    stack.lockstep.run(1.0)
    before = stack.newest["pose"].stamp
    stack.lockstep.run(1.0)
    assert stack.newest["pose"].stamp == before
    assert stack.lockstep.service("mapper").scan_queue.n_dropped["repeated"] >= 9


def by_hand(stack: LockstepStack, v: float) -> None:
    """Drives straight on by hand from now on, 20 commands a second."""
    stack.lockstep.publish(topics.TELEOP(Velocity(stack.now, v, 0.0, "")))
    stack.lockstep.at(0.05, partial(by_hand, stack, v))
