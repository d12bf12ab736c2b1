# SPDX-License-Identifier: Apache-2.0
"""The messages of traffic: this robot's intent for the others; right of way and the others' places for this robot."""

from collections.abc import Sequence

import numpy as np

from services.traffic.conflicts import Clearances, TrafficRobot, reach_of
from services.traffic.give_way import GivingWay
from services.traffic.neighbours import Neighbour
from services.traffic.passages import SPACING_M
from services.traffic.prediction import N_STEPS, PERIOD_S, predicted_places
from services.traffic.reservation import Reservation
from shared.geometry import Pose2
from shared.messages import OtherRobots, RightOfWay, RobotIntent

CAREFUL_SHARE = 0.5  # of the top speed, where a robot that is not heard may come
CAREFUL_M = 6.0  # of path ahead on which that counts


def right_of_way(
    me: TrafficRobot,
    reservation: Reservation,
    giving_way: GivingWay,
    standing: Sequence[Neighbour],
    unheard: Sequence[TrafficRobot],
    now: int,
) -> RightOfWay:
    """How far this robot may drive. standing: robots to plan around.  unheard: those that may come without a word."""
    held, refuge = np.concatenate((me.place, me.path[: me.held])), giving_way.refuge
    careful = any(meets(me, robot, reservation.clearances) for robot in unheard)
    return RightOfWay(
        stamp=now,
        active=True,
        xs=held[:, 0].astype(np.float32),
        ys=held[:, 1].astype(np.float32),
        whole=reservation.whole,
        waits_for=reservation.waits_for if refuge is None else tuple(sorted(giving_way.for_robots)),
        gives_way=refuge is not None,
        refuge=refuge or Pose2(),
        speed_share=CAREFUL_SHARE if careful else 1.0,
        closed_xs=np.array([n.robot.x for n in standing], np.float32),
        closed_ys=np.array([n.robot.y for n in standing], np.float32),
        closed_radii=np.array([n.robot.radius for n in standing], np.float32),
    )


def no_other_robot(now: int) -> RightOfWay:
    """The right of way of a robot that is alone."""
    none = np.zeros(0, np.float32)
    return RightOfWay(
        stamp=now,
        active=False,
        xs=none,
        ys=none,
        whole=True,
        waits_for=(),
        gives_way=False,
        refuge=Pose2(),
        speed_share=1.0,
        closed_xs=none,
        closed_ys=none,
        closed_radii=none,
    )


def other_robots(there: Sequence[Neighbour], lost: Sequence[RobotIntent], now: int) -> OtherRobots:
    """The others where they are, and where they will be. lost: robots that stand where they believe to be."""
    moving = [predicted_places(neighbour, now) for neighbour in there]
    standing = [np.tile((robot.map_from_base.x, robot.map_from_base.y), (N_STEPS, 1)) for robot in lost]
    places = np.array([*moving, *standing], np.float32).reshape(-1, N_STEPS, 2)
    return OtherRobots(
        stamp=now,
        names=(*(neighbour.robot.name for neighbour in there), *(robot.robot for robot in lost)),
        radii=np.array(
            [*(neighbour.robot.radius for neighbour in there), *(robot.radius for robot in lost)], np.float32
        ),
        period=PERIOD_S,
        xs=np.ascontiguousarray(places[:, :, 0]),
        ys=np.ascontiguousarray(places[:, :, 1]),
    )


def intent(
    me: TrafficRobot,
    giving_way: GivingWay,
    there: Sequence[Neighbour],
    map_name: str,
    map_from_base: Pose2,
    velocity: tuple[float, float],
    lost: bool,
    now: int,
) -> RobotIntent:
    """What the others hear of this robot. velocity: m/s, rad/s.  lost: its pose is, so it has no path."""
    _, priority, since, name = me.order
    path = me.path[:0] if lost else me.path
    return RobotIntent(
        stamp=now,
        robot=name,
        map=map_name,
        map_from_base=map_from_base,
        v=velocity[0],
        w=velocity[1],
        radius=me.radius,
        xs=path[:, 0].astype(np.float32),
        ys=path[:, 1].astype(np.float32),
        widths=me.widths[: len(path)].astype(np.float32),
        held=min(me.held, len(path)),
        wanted=min(me.wanted, len(path)),
        priority=-priority,
        since=since,
        claim=me.claim,
        heard=tuple((neighbour.robot.name, neighbour.robot.claim) for neighbour in there),
        waits_for=me.waits_for,
        gives_way=giving_way.refuge is not None,
        stuck=giving_way.stuck,
        lost=lost,
    )


def meets(me: TrafficRobot, other: TrafficRobot, clearances: Clearances) -> bool:
    """Whether a robot that is not heard may come onto the next CAREFUL_M of this robot's path."""
    points = np.concatenate((other.place, other.path))
    near = me.path[: round(CAREFUL_M / SPACING_M)]
    apart = np.hypot(near[:, None, 0] - points[:, 0], near[:, None, 1] - points[:, 1])
    return bool((apart < reach_of(me, other, clearances)).any())
