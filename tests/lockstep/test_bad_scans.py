# SPDX-License-Identifier: Apache-2.0
"""A laser that goes wrong now and then: the robot arrives all the same, and whole sweeps of nonsense stop it."""

from dataclasses import replace
from typing import ClassVar

import numpy as np
import pytest

from services.sim.service import SimService
from shared.messages import LaserScan
from tests.lockstep.stack import Stack

pytestmark = pytest.mark.timeout(600)  # with an empty cache the kernels are compiled here

SPOILED = {
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

    def _due_scans(self) -> list[LaserScan]:
        return [self._spoiled(scan) for scan in super()._due_scans()]

    def _spoiled(self, scan: LaserScan) -> LaserScan:
        self.n_scans += 1
        if not self.every or self.n_scans % self.every:
            return scan
        return SPOILED[self.ways[self.n_scans // self.every % len(self.ways)]](scan)


def spoiled(folder, every: int, ways: list[str]) -> Stack:
    """The stack at full speed, its laser gone wrong from now on."""
    stack = Stack(folder, sim=SpoiledLaser)
    stack.go(4.5)
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


@pytest.mark.parametrize("way", ["no echo", "zeros", "two beams"])
def test_a_laser_that_measures_nothing_any_more_drives_into_nothing(tmp_path, way):
    stack = spoiled(tmp_path, 1, [way])
    stack.lockstep.run(8.0)
    assert stack.truth.n_contacts == 0
    assert stack.guard.reason or stack.ended()
    stack.lockstep.service("sim").every = 0
    stack.lockstep.run(2.0)
    stack.go(3.0)
    stack.until(stack.ended, 60.0)
    assert stack.reached()
    assert stack.truth.n_contacts == 0
