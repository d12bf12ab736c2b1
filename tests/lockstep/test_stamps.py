# SPDX-License-Identifier: Apache-2.0
"""Scans or the board's reports with bad stamps: the robot stands, its reason names them, and nothing stays broken."""

from collections.abc import Callable
from dataclasses import replace

import pytest

from services.sim.service import SimService
from shared import topics
from shared.messages import BoardReport, GuardState, LaserScan
from tests.lockstep.stack import MS, QUICK, LockstepStack
from tests.lockstep.test_faults import by_hand

pytestmark = pytest.mark.timeout(600)  # with an empty cache the kernels are compiled here

S = 1000 * MS
LATCHED = {"wheel_stuck", "wheel_astray", "encoders_broken"}
LIMIT = {"board": 250, "scan": 320}
"""ms from the last good message's end; a scan may be 0.27 s old."""

BAD: dict[str, tuple[Callable[[int], int], str]] = {
    "seconds": (lambda stamp: stamp // S, "stamps are 32 years old; are they ns?"),
    "1970": (lambda stamp: 0, "stamps are 32 years old; are they ns?"),
    "0.3 s old": (lambda stamp: stamp - 300 * MS, "stamps are 0.3 s old"),
    "2 s old": (lambda stamp: stamp - 2 * S, "stamps are 2.0 s old"),
    "10 s old": (lambda stamp: stamp - 10 * S, "stamps are 10.0 s old"),
    "1 s ahead": (lambda stamp: stamp + S, "stamps are 1.0 s ahead"),
    "1 h ahead": (lambda stamp: stamp + 3600 * S, "stamps are 1 h ahead"),
}


class OtherClock(SimService):
    """From a moment on, one of its messages is stamped by another clock."""

    of = ""
    stamped: Callable[[int], int] | None = None

    def _due_scans(self) -> list[LaserScan]:
        scans = super()._due_scans()
        if self.of != "scan" or self.stamped is None:
            return scans
        return [replace(scan, stamp=self.stamped(scan.stamp)) for scan in scans]

    def _board(self) -> BoardReport:
        report = super()._board()
        if self.of != "board" or self.stamped is None:
            return report
        return replace(report, stamp=self.stamped(report.stamp))


def driven(stack: LockstepStack, how: str) -> None:
    """At speed, by hand or to a goal."""
    if how == "teleop":
        by_hand(stack)
        stack.drives(0.38)
    else:
        stack.go(5.0)
        stack.drives()


def faults(stack: LockstepStack) -> set[str]:
    """What the base says is wrong, from now on."""
    seen: set[str] = set()
    stack.lockstep.watch("base/status", lambda status: seen.add(status.fault))
    return seen


def drives_on(stack: LockstepStack, how: str) -> None:
    if how == "teleop":
        stack.drives(0.35)
    else:
        stack.until(stack.reached, 40.0)
    assert stack.truth.n_contacts == 0


@pytest.mark.parametrize(
    ("how", "case"), [*(("nav", case) for case in BAD), ("teleop", "10 s old"), ("teleop", "1 s ahead")]
)
@pytest.mark.parametrize("of", ["scan", "board"])
def test_bad_stamps_stop_the_robot_are_named_and_latch_nothing(tmp_path, of, case, how):
    stamped, words = BAD[case]
    stack = LockstepStack(tmp_path, sim=OtherClock, settings=QUICK)
    driven(stack, how)
    seen = faults(stack)
    sim = stack.lockstep.service("sim")
    sim.of, sim.stamped = of, stamped
    newest = stack.newest["scan"].stamp + 100 * MS if of == "scan" else stack.now
    stack.until(lambda: not stack.commanded, 1.0)
    assert stack.now - newest <= LIMIT[of] * MS
    stack.until(lambda: abs(stack.truth.v) < 0.01, 1.5)
    for _ in range(12):
        stack.stands_for(0.1)
        assert (stack.guard.state, stack.guard.reason) == (GuardState.HOLD, "bad_stamps")
        assert stack.guard.detail == f"{of}: {words}"
    assert not seen & LATCHED
    assert seen <= {"", "bad_stamps"}
    if how == "nav":
        assert stack.newest["nav/status"].reason == "bad_stamps"
    sim.stamped = None
    drives_on(stack, how)
    assert seen <= {"", "bad_stamps"}


@pytest.mark.parametrize("back", [0, 5], ids=["stands still", "goes back"])
@pytest.mark.parametrize("of", ["scan", "board"])
def test_a_sequence_that_does_not_rise_stops_the_robot_and_is_named(tmp_path, of, back):
    stack = LockstepStack(tmp_path, settings=QUICK)
    driven(stack, "nav")
    seen = faults(stack)
    topic = {"scan": topics.SCAN, "board": topics.BOARD}[of]
    sequences = stack.lockstep._hosts["sim"]._sequences  # a publisher that counts wrongly
    wrong = sequences[topic.key] - 1 - back
    stuck = [True]

    def hold(_: object) -> None:
        if stuck[0]:
            sequences[topic.key] = wrong

    hold(None)
    stack.lockstep.watch(topic.key, hold)
    assert stack.until(lambda: not stack.commanded, 1.0) <= (250 if of == "board" else 400) * MS
    stack.until(lambda: abs(stack.truth.v) < 0.01, 1.5)
    stack.stands_for(1.0)
    words = "the sequence goes back" if back else "the sequence stands still"
    assert (stack.guard.reason, stack.guard.detail) == ("bad_stamps", f"{of}: {words}")
    listener = stack.lockstep.service("guard" if of == "scan" else "base_driver")
    assert listener.rejections.counts[topic.key, "sequence"] >= 10
    stuck[0] = False
    sequences[topic.key] = 10**6
    drives_on(stack, "nav")
    assert seen <= {"", "bad_stamps"}


@pytest.mark.parametrize("of", ["scan", "board"])
def test_a_moment_of_bad_stamps_stops_nothing(tmp_path, of):
    stack = LockstepStack(tmp_path, sim=OtherClock, settings=QUICK)
    driven(stack, "nav")
    seen = faults(stack)
    sim = stack.lockstep.service("sim")
    sim.of, sim.stamped = of, lambda stamp: stamp + S
    stack.lockstep.run(0.09)
    sim.stamped = None
    assert not stack.lockstep.run(0.5, lambda: not stack.commanded)
    assert seen <= {""}
    drives_on(stack, "nav")
