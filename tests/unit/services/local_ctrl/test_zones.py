# SPDX-License-Identifier: Apache-2.0
"""Local control keeps out of zones whatever the plan says, and is slow in speed zones from their edge on."""

from math import sqrt

import numpy as np
import pytest

from services.local_ctrl.controller import APPROACH_BRAKING_SHARE
from services.local_ctrl.zones import LocalZones
from shared import reasons
from shared.config import load_robot
from shared.geometry import Pose2
from shared.messages import Contacts, FollowState, RecoveryKind, Zones
from shared.polygon import contains, distances_to_outline
from shared.robot import Bumper
from shared.zones import ZoneConfig
from tests.unit.services.local_ctrl.test_controllers import config
from tests.unit.services.local_ctrl.tiny_world import ControlLoop, TinyWorld, drive_goal, off, recovery

X80 = load_robot("x80sv").robot
HALL = ((4.0, -1.0), (5.0, -1.0), (5.0, 5.0), (4.0, 5.0))


def loop_with(controller, *zones, x=1.0):
    loop = ControlLoop(X80, TinyWorld(10, 4), Pose2(x, 2.0, 0.0), config(controller))
    loop.send("new_zones", Zones(0, tuple(zones)))
    return loop


def outline(pose):
    return pose @ X80.corners


@pytest.mark.parametrize(
    ("name", "asks"), [("mppi", {"speed": 0.3}), ("dwa", {"speed": 0.3}), ("pursuit", {"percent": 50})]
)
def test_in_a_speed_zone_it_is_slow_from_the_edge_on_and_brakes_gently_before_it(name, asks):
    loop = loop_with(name, ZoneConfig(corners=HALL, **asks).zone("hall"), x=2.0)
    most = asks.get("speed", 0.4)
    goal = Pose2(6.8, 2.0, 0.0)
    run = loop.give(drive_goal(goal), np.array([[2.0, 2.0], [6.8, 2.0]])).drive(20)
    assert run.reached
    speeds = np.array(run.v)
    xs = np.array([pose.x for pose in run.poses])
    within = (xs > 4.0) & (xs < 5.0)
    assert speeds[within].max() < most + 0.03
    assert speeds[within].min() > most - 0.12
    assert speeds[(xs > 2.7) & (xs < 3.1)].max() > 0.65  # and not slow long before
    assert speeds[(xs > 5.4) & (xs < 6.2)].max() > 0.55
    before = (xs > 2.0) & (xs < 4.0)
    allowed = np.sqrt(most**2 + 2 * APPROACH_BRAKING_SHARE * X80.drive.max_braking * (4.0 - xs[before]))
    assert (speeds[before] < allowed + 0.05).all()
    told = [status.reason for status, x in zip(run.statuses, xs) if 4.0 < x < 4.9]
    assert set(told) == {reasons.SPEED_ZONE.code}
    assert {status.state for status, x in zip(run.statuses, xs) if 2.2 < x < 6.4} == {FollowState.FOLLOWING}


def test_of_zones_that_overlap_the_slowest_counts_and_a_recovery_is_slow_too():
    loop = loop_with(
        "pursuit",
        ZoneConfig(corners=HALL, speed=0.5).zone("hall"),
        ZoneConfig(corners=HALL, speed=0.05).zone("wet"),
        x=4.5,
    )
    loop.give(drive_goal(Pose2(8.5, 2.0, 0.0)), np.array([[4.5, 2.0], [8.5, 2.0]])).drive(3)
    assert 0.03 < max(loop.run.v) < 0.06
    loop.give(recovery(RecoveryKind.BACK_UP, 0.3, order_id=2)).drive(3)
    assert -0.06 < min(loop.run.v) < -0.03


@pytest.mark.parametrize("name", ["mppi", "pursuit"])
def test_no_part_of_the_robot_enters_a_keep_out_zone_that_lies_on_the_plan(name):
    loop = loop_with(name, ZoneConfig(corners=HALL).zone("hall"), x=2.0)
    run = loop.give(drive_goal(Pose2(8.5, 2.0, 0.0)), np.array([[2.0, 2.0], [8.5, 2.0]])).drive(5)
    corners = np.concatenate([outline(pose) for pose in run.poses])
    assert not contains(np.array(HALL), corners).any()
    assert loop.truth.x > 3.0
    assert (run.statuses[-1].state, run.statuses[-1].reason) == (FollowState.BLOCKED, reasons.BLOCKED.code)


@pytest.mark.parametrize("name", ["dwa", "pursuit"])
def test_from_a_keep_out_zone_it_drives_out(name):
    loop = loop_with(name, ZoneConfig(corners=HALL).zone("hall"), x=4.5)
    goal = Pose2(6.5, 2.0, 0.0)
    run = loop.give(drive_goal(goal), np.array([[4.5, 2.0], [6.5, 2.0]])).drive(15)
    assert run.reached
    assert off(loop.truth, goal)[0] < 0.15
    assert distances_to_outline(np.array(HALL), np.array([[loop.truth.x, loop.truth.y]]))[0] > 1.0


def test_a_zone_of_one_place_bounds_the_speed_by_the_way_that_is_left_to_it():
    loop = loop_with("mppi", ZoneConfig(corners=HALL, speed=0.3).zone("hall"))
    loop.drive(0.2)
    service = loop.service
    path = np.column_stack((np.linspace(0, 5, 101), np.zeros(101)))
    for x in (1.0, 3.0, 3.8, 4.5, 7.0):
        here = service.inputs.odom_from_map @ Pose2(x, 2.0, 0.0)
        motion = service.estimate.motion._replace(pose=here)
        assert motion.v == 0.0
        limits = service.zones.limits_in_zones(service.limits, here @ path, motion, service.inputs.odom_from_map)
        way = max(4.0 - x, 0.0)
        wanted = sqrt(0.3**2 + 2 * APPROACH_BRAKING_SHARE * service.limits.braking * way) if x < 5 else np.inf
        assert limits.v_max == pytest.approx(min(wanted, service.limits.v_max), abs=0.06)
        assert limits.v_min >= -limits.v_max


def test_the_place_of_a_contact_counts_on_its_own_map_alone():
    robot = X80.model_copy(update={"bumpers": (Bumper(name="front", bearing=0.0, width=1.0),)})
    zones, here, window = LocalZones(robot), Pose2(1.0, 1.0, 0.0), (-2.0, -2.0, 0.05, 120)

    def is_forbidden_on(map_id):
        return zones.forbidden_cells(Pose2(), here, window, map_id) is not None

    zones.add_contacts(Contacts(0, ("front",), (), False), here, 0, map_id=1)
    zones.add_contacts(Contacts(1, (), (), False), here, 1, map_id=1)
    assert is_forbidden_on(1)
    assert not is_forbidden_on(2)
    zones.add_contacts(Contacts(2, (), (), False), here, 2, map_id=2)
    assert not is_forbidden_on(2)
    zones.add_contacts(Contacts(3, ("front",), (), False), here, 3, map_id=2)
    assert is_forbidden_on(2)
