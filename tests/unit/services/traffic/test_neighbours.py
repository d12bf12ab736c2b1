# SPDX-License-Identifier: Apache-2.0
"""A robot counts as there while its messages come in time, by the listener's own clock."""

import numpy as np
import pytest

from services.traffic.neighbours import IDLE_NS, LEASE_NS, MEMORY_NS, Neighbours
from services.traffic.outgoing import other_robots
from services.traffic.prediction import PERIOD_S, predicted_places
from shared.codec import Envelope, decode, encode
from shared.geometry import Pose2
from shared.messages import OtherRobots
from shared.types import NS_PER_S
from tests.unit.services.traffic.intents import intent

AHEAD = 3600 * NS_PER_S  # by which the sender's clock is ahead


def heard(n, now=0, offset=0, **changes):
    """Neighbours that heard a robot n times, 5 times a second, until `now`."""
    neighbours = Neighbours()
    for i in range(n):
        at = now - (n - 1 - i) * NS_PER_S // 5
        neighbours.hear(intent(at + offset, **changes), at)
    return neighbours


def names(found):
    return [neighbour.robot.name for neighbour in found]


@pytest.mark.parametrize("offset", [0, AHEAD, -AHEAD // 2])
def test_a_lease_ends_by_the_own_clock_whatever_the_senders_says(offset):
    now = 10**13
    neighbours = heard(5, now, offset)
    assert names(neighbours.alive("office", now + LEASE_NS - 1)) == ["blue"]
    assert names(neighbours.alive("office", now + LEASE_NS)) == []
    assert names(neighbours.silent("office", now + LEASE_NS)) == ["blue"]
    neighbours.forget(now + MEMORY_NS)
    assert names(neighbours.silent("office", now + MEMORY_NS)) == []


def test_robots_on_another_map_or_on_one_without_a_name_are_not_there():
    now = 10**13
    assert names(heard(1, now).alive("lab", now)) == []
    assert names(heard(1, now, map="").alive("", now)) == []


def test_a_burst_of_old_messages_renews_nothing():
    now = 10**13
    neighbours, late = heard(5, now), now + 6 * NS_PER_S
    for i in range(1, 20):
        neighbours.hear(intent(now + i * NS_PER_S // 5), late)
    assert names(neighbours.alive("office", late)) == [], "the newest is 2 s old"
    neighbours.hear(intent(late), late)
    assert names(neighbours.alive("office", late)) == ["blue"]


def test_a_sender_whose_clock_is_set_back_counts_again_after_a_while():
    now = 10**13
    neighbours = heard(5, now)
    for i in range(1, 30):
        at = now + i * NS_PER_S // 5
        neighbours.hear(intent(at - AHEAD), at)
    assert names(neighbours.alive("office", at)) == ["blue"]


@pytest.mark.parametrize("pace", [0.998, 1.002])
def test_a_robot_whose_clock_drifts_is_there_all_the_time(pace):
    """By 2 ms a second, which is 40 times as fast as a bad clock."""
    neighbours, start = Neighbours(), 10**13
    for k in range(5 * 1800):
        now = start + k * NS_PER_S // 5
        neighbours.hear(intent(start + round((now - start) * pace)), now)
        assert names(neighbours.alive("office", now)) == ["blue"]


@pytest.mark.parametrize("cut_s", [10, 50])
def test_after_a_cut_of_any_length_a_burst_of_old_messages_renews_nothing(cut_s):
    now = 10**13
    neighbours, late = heard(5, now), now + cut_s * NS_PER_S
    for i in range(1, 5 * cut_s - 10):
        neighbours.hear(intent(now + i * NS_PER_S // 5), late)
    assert names(neighbours.alive("office", late)) == []


def test_a_robot_without_a_path_is_planned_around_once_it_stands_for_a_while():
    now = 10**13
    assert names(heard(3, now).standing("office", now)) == []
    n = IDLE_NS * 5 // NS_PER_S + 2
    assert names(heard(n, now).standing("office", now)) == ["blue"]
    assert names(heard(n, now, v=0.5).standing("office", now)) == []
    assert names(heard(n, now, path=((0, 0), (1, 0))).standing("office", now)) == []


def test_a_robot_is_predicted_on_its_path_and_no_farther_than_it_holds():
    now = 10**13
    path = [(0.3 * i, 0.0) for i in range(20)]
    neighbours = heard(1, now, at=Pose2(0.0, 0.1, 0.0), path=path, held=6, v=0.5)
    places = predicted_places(neighbours.alive("office", now)[0], now)
    assert places[0] == pytest.approx([0.0, 0.1])
    assert places[round(1.0 / PERIOD_S)] == pytest.approx([0.5, 0.05], abs=1e-6)
    assert places[-1] == pytest.approx([1.5, 0.0], abs=1e-6), "it holds 1.5 m"
    assert (np.diff(places[:, 0]) >= 0).all()


def test_the_places_of_no_robots_are_a_message_too():
    message = other_robots([], [], 10**13)
    assert decode(OtherRobots, encode(message, Envelope("traffic", "s", 0, 1)))[0].xs.shape[0] == 0
