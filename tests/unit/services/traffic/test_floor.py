# SPDX-License-Identifier: Apache-2.0
"""Keep-out zones are walls for the right of way, too: the planner drives through none of them."""

import numpy as np
import pytest

from services.traffic.config import TrafficConfig
from services.traffic.service import TrafficService
from shared import sample_messages as sample
from shared import topics
from shared.config import load_robot
from shared.geometry import Pose2
from shared.grid import OccupancyGrid, update_of_cells
from shared.messages import MapState, Path, Zone, ZoneKind, Zones
from shared.polygon import contains
from shared.zones import polygon_of
from tests.unit.services.traffic.intents import intent

S = 1_000_000_000
RED = Pose2(1.6, 1.6)
SOUTH, NORTH = (-3.2, 1.0), (2.2, 6.4)  # y of the floor on both sides of the way, m


def zone(name, low, high):
    """A keep-out zone across the whole floor between two y, m."""
    return Zone(0, name, ZoneKind.KEEP_OUT, np.array([-3.2, 6.4, 6.4, -3.2]), np.array([low, low, high, high]))


class Red:
    """Red on a free floor of 9.6 m, on its way along y = 1.6. Blue comes towards it, and waits for it."""

    def __init__(self, *zones):
        self.service = TrafficService(TrafficConfig(), load_robot("x80sv").robot.model_copy(update={"name": "red"}))
        self.newest = {}
        self.call("map_state", S, MapState(S, 0, "office", ()))
        self.call("map", S, update_of_cells(np.zeros((192, 192), np.int8), 0.05, -3.2, -3.2))
        self.call("zones", S, Zones(S, zones))
        self.call("goal", S, sample.goal(S, 1, Pose2(4.6, 1.6)))
        self.call("pose", S, sample.pose_estimate(S, RED))
        xs = np.linspace(1.6, 4.6, 31)
        self.call("new_plan", S, Path(S, 1, 1, "", xs, np.full(31, 1.6), np.zeros(31), 3.0, 3.0))

    def call(self, method, now, *arguments):
        self.service.now = now
        for effect in getattr(self.service, method)(*arguments):
            self.newest[effect.topic.key] = effect.message

    def run(self, seconds):
        """Returns the newest right of way and intent."""
        along = [(x, 1.6) for x in np.arange(2.8, -0.5, -0.3)]
        for now in range(S, S + seconds * S, S // 5):
            blue = intent(now, at=Pose2(2.8, 1.6), path=along, waits_for=("red",), since=0, heard=(("red", 10**9),))
            self.call("heard", now, blue)
            self.call("pose", now, sample.pose_estimate(now, RED))
            self.call("tick", now)
        return self.newest[topics.RIGHT_OF_WAY.key], self.newest[topics.INTENT.key]


@pytest.mark.parametrize("side", [SOUTH, NORTH])
def test_a_robot_makes_way_beside_keep_out_zones_and_into_none(side):
    closed = zone("stairs", *side)
    told, _ = Red(closed).run(4)
    assert told.gives_way
    assert not contains(polygon_of(closed), np.array([[told.refuge.x, told.refuge.y]]))[0]


def test_a_way_between_keep_out_zones_is_narrow():
    _, free = Red().run(1)
    _, between = Red(zone("stairs", *SOUTH), zone("lab", *NORTH)).run(1)
    assert free.widths.min() > 6.0
    assert between.widths.max() == pytest.approx(1.2, abs=0.11)


def test_a_zone_that_comes_or_goes_counts_at_once():
    red = Red()
    red.run(1)
    red.call("zones", 2 * S, Zones(2 * S, (zone("stairs", *SOUTH), zone("lab", *NORTH))))
    assert red.run(2)[1].widths.max() < 1.4
    red.call("zones", 3 * S, Zones(3 * S, ()))
    assert red.run(3)[1].widths.min() > 6.0


def test_a_way_is_as_wide_as_the_map_of_the_others_shows_where_the_own_one_is_unknown():
    red = Red()
    half = OccupancyGrid()
    half.apply(update_of_cells(np.zeros((192, 192), np.int8), 0.05, -3.2, -3.2))
    half.cells[:, 128:] = -1  # the own map ends at x = 3.2
    red.call("map", S, half.update_of(half.cells < 0, S))
    assert red.run(1)[1].widths[-1] == 0.0
    theirs = np.zeros((192, 192), np.int8)
    theirs[:70] = theirs[126:] = 100  # a corridor of 2.8 m
    red.call("others_map", 2 * S, update_of_cells(theirs, 0.05, -3.2, -3.2))
    widths = red.run(2)[1].widths
    assert widths[-1] == pytest.approx(2.8, abs=0.11)
    assert widths[0] > 6.0, "where the own map is sure it counts"
