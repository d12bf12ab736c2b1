# SPDX-License-Identifier: Apache-2.0
"""The other robots that are heard, by name: on a lease that each of their messages renews (Gray, Cheriton 1989).

The clocks of two computers differ, so the arrival by the own clock decides. A message that took much longer than the
fastest one lately is old, as in the burst after a cut of the network. It renews nothing.
"""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from services.traffic.conflicts import TrafficRobot, order_of
from shared.messages import RobotIntent
from shared.minimum_delay import MinimumDelay
from shared.types import NS_PER_S, Float64s

LEASE_NS = 2 * NS_PER_S
"""ns after the last message at which a robot counts as silent, and what it held is free."""
MAX_LATE_NS = NS_PER_S
"""ns over the shortest way of a message at which it is old."""
CLOCK_STEP_NS = 3 * NS_PER_S
"""ns for which all messages must be late until the sender's clock counts as set back."""
MEMORY_NS = 60 * NS_PER_S
"""ns for which the place of a silent robot is remembered."""
IDLE_NS = 3 * NS_PER_S
"""ns that a robot without a path must stand until the others plan around it."""
STANDING_MPS = 0.03


@dataclass(slots=True)
class Neighbour:
    """One other robot. heard: ns of its last message. idle_since: ns; None while it drives or has a path."""

    intent: RobotIntent
    robot: TrafficRobot
    heard: int
    least: MinimumDelay
    late_since: int | None = None
    idle_since: int | None = None

    @property
    def delay(self) -> int:
        """ns, the shortest way of a message lately and the difference of the clocks."""
        return self.least.value


class Neighbours:
    """Every other robot that was heard lately."""

    def __init__(self) -> None:
        self._by_name: dict[str, Neighbour] = {}
        self._lost: dict[str, tuple[RobotIntent, int]] = {}  # with ns of its arrival

    def hear(self, intent: RobotIntent, now: int) -> None:
        """Takes a message that arrived at `now`, ns. That of a lost robot renews no lease."""
        if intent.lost:
            self._lost[intent.robot] = intent, now
            return
        self._lost.pop(intent.robot, None)
        known, delay = self._by_name.get(intent.robot), now - intent.stamp
        if known is None:
            known = self._by_name[intent.robot] = Neighbour(intent, told_by(intent), now, MinimumDelay(delay, now))
        elif delay > known.delay + MAX_LATE_NS:
            known.late_since = now if known.late_since is None else known.late_since
            if now - known.late_since < CLOCK_STEP_NS:
                return
            known.least = MinimumDelay(delay, now)
        known.intent, known.robot, known.heard, known.late_since = intent, told_by(intent), now, None
        known.least.add(delay, now)
        is_idle = not len(intent.xs) and abs(intent.v) < STANDING_MPS
        known.idle_since = (known.idle_since or now) if is_idle else None

    def forget(self, now: int) -> None:
        """Drops robots that were silent for long."""
        self._lost = {name: said for name, said in self._lost.items() if 0 <= now - said[1] < LEASE_NS}
        self._by_name = {name: n for name, n in self._by_name.items() if 0 <= now - n.heard < MEMORY_NS}

    def _on(self, map_name: str) -> Iterator[Neighbour]:
        """Those on a map of this name, sorted by name; a map without a name has no others."""
        return (n for _, n in sorted(self._by_name.items()) if map_name and n.intent.map == map_name)

    def alive(self, map_name: str, now: int) -> list[Neighbour]:
        """Those whose lease runs."""
        return [n for n in self._on(map_name) if now - n.heard < LEASE_NS]

    def lost(self, map_name: str, now: int) -> list[RobotIntent]:
        """The last messages of robots whose pose is lost, while these come, sorted by name."""
        said = [intent for intent, heard in self._lost.values() if 0 <= now - heard < LEASE_NS]
        return sorted((i for i in said if map_name and i.map == map_name), key=lambda i: i.robot)

    def silent(self, map_name: str, now: int) -> list[Neighbour]:
        """Those that were heard lately, and are not now."""
        return [n for n in self._on(map_name) if now - n.heard >= LEASE_NS]

    def standing(self, map_name: str, now: int) -> list[Neighbour]:
        """Those that do not move by themselves: silent ones, and idle ones."""
        idle = [n for n in self.alive(map_name, now) if n.idle_since is not None and now - n.idle_since >= IDLE_NS]
        return [*self.silent(map_name, now), *idle]


def told_by(intent: RobotIntent) -> TrafficRobot:
    """The robot of a message."""
    return TrafficRobot(
        name=intent.robot,
        x=intent.map_from_base.x,
        y=intent.map_from_base.y,
        radius=intent.radius,
        order=order_of(intent.robot, intent.priority, intent.since, intent.gives_way),
        path=path_of(intent),
        widths=intent.widths.astype(float),
        held=intent.held,
        wanted=intent.wanted,
        claim=intent.claim,
        heard=dict(intent.heard),
        waits_for=intent.waits_for,
        stuck=intent.stuck,
    )


def path_of(intent: RobotIntent) -> Float64s:
    """(n, 2) m in `map`."""
    path: Float64s = np.column_stack((intent.xs, intent.ys)).astype(float)
    return path
