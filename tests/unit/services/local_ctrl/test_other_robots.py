# SPDX-License-Identifier: Apache-2.0
"""Local control drives as far as traffic lets it, and no farther when traffic falls silent."""

from dataclasses import replace
from math import inf

import numpy as np
import pytest

from services.local_ctrl.local_plan import SPACING
from services.local_ctrl.other_robots import LocalTraffic, without_robots
from services.local_ctrl.rollout import limits_of
from services.traffic.outgoing import no_other_robot
from shared import reasons
from shared.config import load_robot
from shared.geometry import Pose2
from shared.messages import OtherRobots
from shared.types import NS_PER_S

NOW = 10**13
PATH = np.column_stack((SPACING * np.arange(100), np.zeros(100)))
LIMITS = limits_of(load_robot("x80sv").robot.drive, 10.0, 0.15)


def told(n, **changes):
    """The right of way along n points of PATH, 0.3 m apart."""
    xs, ys = (0.3 * np.arange(n)).astype(np.float32), np.zeros(n, np.float32)
    held = replace(no_other_robot(NOW), active=True, xs=xs, ys=ys, whole=False, waits_for=("blue",))
    return replace(held, **changes)


def traffic(message):
    made = LocalTraffic()
    made.right_of_way = message
    return made


@pytest.mark.parametrize("odom_from_map", [Pose2(), Pose2(1.0, -2.0, 0.7)])
def test_the_way_is_cleared_to_the_end_of_what_the_robot_holds(odom_from_map):
    assert traffic(told(6)).cleared(odom_from_map @ PATH, odom_from_map) == pytest.approx(1.5, abs=0.06)
    assert traffic(told(0)).cleared(odom_from_map @ PATH, odom_from_map) == 0.0
    assert traffic(told(6, whole=True)).cleared(odom_from_map @ PATH, odom_from_map) == inf


@pytest.mark.parametrize("beside", [0.45, 0.8])
def test_a_robot_that_stopped_beside_its_new_path_drives_back_to_it(beside):
    """It braked from its old one. The plan begins where it was when that was made."""
    held = told(6)
    held = replace(held, xs=np.append(np.float32(-beside), held.xs[1:]))
    along = np.arange(-beside, 4.0, SPACING)
    from_behind = np.column_stack((along, np.zeros(len(along))))
    assert traffic(held).cleared(from_behind, Pose2()) == pytest.approx(1.5 + beside, abs=0.06)
    from_behind[:, 1] = 0.3
    assert traffic(held).cleared(from_behind, Pose2()) == 0.0, "elsewhere"


def test_another_plan_is_not_cleared_where_it_leaves_what_the_robot_holds():
    aside = np.column_stack((np.minimum(PATH[:, 0], 0.6), np.maximum(PATH[:, 0] - 0.6, 0.0)))
    assert traffic(told(10)).cleared(aside, Pose2()) == pytest.approx(0.6, abs=0.1)


def test_the_speed_falls_towards_the_end_and_where_a_robot_fell_silent():
    speeds = [traffic(told(6)).limits(LIMITS, left).v_max for left in (0.05, 0.2, 0.5, inf)]
    assert speeds == sorted(speeds)
    assert speeds[0] < 0.1
    assert speeds[-1] == LIMITS.v_max
    careful = traffic(told(6, speed_share=0.5))
    assert careful.limits(LIMITS, inf).v_max == pytest.approx(LIMITS.v_max / 2)
    assert careful.reason() == reasons.ROBOT_SILENT.code


def test_silence_of_traffic_stops_a_robot_that_had_others_about_it_and_no_other():
    assert traffic(told(6)).fault(NOW + NS_PER_S // 2) is None
    assert traffic(told(6)).fault(NOW + 2 * NS_PER_S) is reasons.TRAFFIC_OLD
    assert traffic(told(6, active=False)).fault(NOW + 2 * NS_PER_S) is None
    assert LocalTraffic().fault(NOW) is None
    assert LocalTraffic().cleared(PATH, Pose2()) == inf
    assert LocalTraffic().limits(LIMITS, inf) is LIMITS


def test_moving_robots_are_predicted_in_odom_and_tracked_only_once():
    made = traffic(told(6))
    xs = np.array([[1.0, 1.5, 2.0], [5.0, 5.0, 5.0]], np.float32)
    made.others = OtherRobots(NOW, ("blue", "green"), np.full(2, 0.3, np.float32), 0.5, xs, 0 * xs)
    places = made.places(NOW, Pose2(0.0, 1.0, 0.0))
    assert places.shape[1:] == (1, 3), "green stands: the laser sees it"
    assert places[9, 0] == pytest.approx([1.5, 1.0, 0.3], abs=0.01)  # after 0.5 s
    tracked = np.array([[1.1, 1.1, 0.5, 0.0, 0.2, 0.0], [4.0, 1.0, 0.5, 0.0, 0.2, 0.0]])
    assert without_robots(tracked, places).tolist() == tracked[1:].tolist()
    assert made.places(NOW + 3 * NS_PER_S, Pose2()).shape[1] == 0, "too old"
