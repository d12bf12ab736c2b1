# SPDX-License-Identifier: Apache-2.0
"""The link's core: which orders of a site reach the robot, and how much the site sees."""

import msgpack
from hypothesis import given
from hypothesis import strategies as st

from services.uplink.outgoing import Level
from services.uplink.service import AFTER_DRIVING_NS, PORT, UplinkConfig, UplinkService
from shared import requests, topics
from shared.codec import Envelope, decode, encode
from shared.config import load_robot
from shared.geometry import Pose2
from shared.messages import EmergencyStop, GuardState, GuardStatus, NavState, NavStatus, PortState, SerialData
from shared.recording_requests import ListRecordings
from shared.requests import Cancel, Navigate, Reply, Watch
from shared.service import Log
from shared.topics import Publication
from shared.types import NS_PER_S

NOW = 10**18
ages = st.floats(-3600, 3600).map(lambda seconds: round(seconds * NS_PER_S))


class Link:
    """A service with a link, at `now`."""

    def __init__(self) -> None:
        self.service = UplinkService(UplinkConfig(), load_robot("x80sv").robot)
        self.service.now = NOW
        self.out(self.service.port_state(PortState(NOW, PORT, True, "")))

    def out(self, given):
        done = list(given)
        self.lines = [row.text for row in done if isinstance(row, Log)]
        orders = [row.message for row in done if isinstance(row, Publication) and row.topic is topics.TX]
        self.orders = [msgpack.unpackb(order.data) for order in orders]
        self.stops = [row.message for row in done if isinstance(row, Publication) and row.topic is topics.ESTOP]
        return self

    def event(self, **event):
        return self.out(self.service.receive(SerialData(self.service.now, PORT, msgpack.packb(event))))

    def ask(self, row, request, sent=NOW):
        payload = encode(request, Envelope("operator", "s1", 0, sent))
        return self.event(event="ask", id=7, key=row.key, data=payload)

    def estop(self, pressed, sent=NOW, session="s1", stamp=None):
        stop = EmergencyStop(sent if stamp is None else stamp, pressed, "anna")
        payload = encode(stop, Envelope("operator", session, 0, sent))
        return self.event(event="estop", data=payload)

    def guard(self, state, source=""):
        return self.out(self.service.guard_status(GuardStatus(self.service.now, state, source, "", "", 1.0)))

    def nav(self, state):
        status = NavStatus(
            stamp=self.service.now, task_id=1, state=state, recovery="", reason="", detail="", goal=Pose2(),
            distance_left=0.0, time_left=0.0, waypoint=0, n_waypoints=0, n_recoveries=0,
        )  # fmt: skip
        return self.out(self.service.nav_status(status))

    def refusal(self):
        (order,) = self.orders
        return decode(Reply, order["data"])[0]


GOAL = Navigate(NOW, (Pose2(1, 2, 0),), 0.0, 1, True)


def test_a_young_goal_is_passed_on_and_in_the_log():
    link = Link().ask(requests.NAVIGATE, GOAL)
    assert link.orders == [{"ask": 7, "key": "request/navigate"}]
    assert any("the site asks request/navigate" in line for line in link.lines)


@given(ages)
def test_a_goal_is_passed_on_exactly_if_it_is_young_and_not_from_the_future(age):
    link = Link().ask(requests.NAVIGATE, GOAL, NOW - age)
    if -NS_PER_S <= age <= 5 * NS_PER_S:
        assert link.orders == [{"ask": 7, "key": "request/navigate"}]
    else:
        assert link.refusal().reason == "expired"
        assert link.service.rejections.counts


def test_what_does_not_cross_is_not_asked_and_what_cannot_be_read_is_refused():
    assert Link().ask(requests.OVERRIDE, requests.Override(NOW, 1.0)).orders == []
    link = Link().event(event="ask", id=7, key="request/cancel", data=b"\xc1")
    assert link.refusal().reason == "bad_request"


@given(ages)
def test_stop_is_taken_whatever_its_age(age):
    (stop,) = Link().estop(True, NOW - age).stops
    assert stop.pressed
    assert stop.stamp == NOW
    assert stop.by == "site: anna"


def test_stop_is_repeated_until_the_guard_confirms_and_not_afterwards():
    link = Link().estop(True)
    link.service.now += NS_PER_S // 5
    assert [stop.pressed for stop in link.out(link.service.tick()).stops] == [True]
    link.guard(GuardState.STOPPED)
    link.service.now += NS_PER_S // 5
    assert link.out(link.service.tick()).stops == []


@given(st.permutations([(True, 1), (False, 2), (True, 3)]))
def test_in_any_order_of_arrival_a_release_before_the_newest_stop_releases_nothing(orders):
    link, pressed = Link(), None
    stopped = 0
    for press, at in orders:
        for stop in link.estop(press, NOW - (4 - at) * NS_PER_S // 10).stops:
            pressed = stop.pressed
        stopped = max(stopped, at if press else 0)
        if stopped == 3:
            assert pressed is True


def test_a_stop_from_a_computer_whose_clock_is_ahead_is_released_by_another_one():
    link = Link().estop(True, NOW + 3600 * NS_PER_S)
    link.guard(GuardState.STOPPED)
    assert link.estop(False).stops == [], "sent before it, perhaps"
    link.service.now += 2 * NS_PER_S
    assert [stop.pressed for stop in link.estop(False, link.service.now).stops] == [False]


def test_a_late_release_of_a_computer_whose_clock_is_a_little_ahead_releases_nothing():
    link = Link().estop(True, NOW + NS_PER_S // 2)
    link.guard(GuardState.STOPPED)
    assert link.estop(False, NOW + NS_PER_S // 2 - 1).stops == []
    assert [stop.pressed for stop in link.estop(False, NOW + NS_PER_S // 2 + 1).stops] == [False]


def test_a_release_that_is_repeated_after_a_newer_stop_releases_nothing():
    link = Link().estop(True, NOW - NS_PER_S)
    link.guard(GuardState.STOPPED)
    assert link.estop(False, NOW, stamp=NOW - 2 * NS_PER_S).stops == []
    assert [stop.pressed for stop in link.estop(False, NOW).stops] == [False]


def test_an_old_release_releases_nothing():
    link = Link()
    link.guard(GuardState.STOPPED)
    assert link.estop(False, NOW - 6 * NS_PER_S).stops == []
    assert any("release of STOP, sent 6.0 s ago" in line for line in link.lines)
    assert [stop.pressed for stop in link.estop(False).stops] == [False]


def test_the_level_follows_the_task_the_hand_and_the_page_of_the_site():
    link = Link()
    link.nav(NavState.NAVIGATING)
    assert link.out(link.service.tick()).orders == [{"level": "driving"}]
    link.ask(requests.WATCH_LINK, Watch(NOW, 10.0))
    assert {"level": "watched"} in link.orders
    assert link.service.level is Level.WATCHED
    link.service.now += 11 * NS_PER_S
    assert link.out(link.service.tick()).orders == [{"level": "rest"}]
    link.guard(GuardState.ACTIVE, "teleop")
    link.out(link.service.tick())
    assert link.service.level is Level.DRIVING
    link.service.now += AFTER_DRIVING_NS
    link.nav(NavState.REACHED)
    link.out(link.service.tick())
    assert link.service.level is Level.REST


def test_a_robot_that_only_stands_is_at_rest():
    link = Link()
    for state in (GuardState.IDLE, GuardState.HOLD, GuardState.STOPPED):
        link.guard(state, "nav")
        assert link.out(link.service.tick()).orders == []


def test_a_lost_link_ends_the_watch_and_the_health_says_why():
    link = Link().ask(requests.WATCH_LINK, Watch(NOW, 10.0))
    link.out(link.service.port_state(PortState(NOW, PORT, False, "the link is lost")))
    link.out(link.service.tick())
    assert link.service.level is Level.REST
    assert link.service.state() == "the link is lost"


def test_a_robot_without_a_site_says_so_when_it_is_watched():
    service = UplinkService(UplinkConfig(), load_robot("x80sv").robot)
    reply = replied(service.watch(Watch(0, 5.0)))
    assert (reply.accepted, reply.reason) == (False, "no_link")


def replied(answering):
    """The reply of a handler of requests."""
    while True:
        try:
            next(answering)
        except StopIteration as end:
            return end.value


def test_lists_and_parts_of_recordings_do_not_fill_the_log():
    link = Link().ask(requests.LIST_RECORDINGS, ListRecordings(NOW))
    assert link.orders
    assert link.lines == []
    assert Link().ask(requests.CANCEL, Cancel(NOW)).lines
