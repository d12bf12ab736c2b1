# SPDX-License-Identifier: Apache-2.0
"""Robots on narrow paths never hold excluding places, whatever the delays, and all of them arrive."""

from dataclasses import replace
from itertools import combinations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from services.traffic.conflicts import Clearances, TrafficRobot, exclusions, order_of
from services.traffic.give_way import circle, yielder
from services.traffic.reservation import STALL_NS, Reservation
from shared.types import NS_PER_S

RADIUS = 0.1
CLEARANCES = Clearances(beside=0.05, passing=0.2)  # points of SPACING_M apart do not exclude each other
TICK_NS = NS_PER_S // 5
CELL = 0.3  # m; a path has a point in each cell
NARROW, WIDE = 0.0, 10.0


class Car:
    """A robot that drives a point a tick, as far as it holds its path."""

    def __init__(self, name, cells, since=0, width=NARROW):
        self.name, self.since, self.width = name, since, width
        self.reservation = Reservation(name, RADIUS, CLEARANCES, reach=3 * CELL)
        self.heard = {}  # by name: the newest message
        self.is_blocked = False  # by something that traffic does not know
        self.x, self.y = CELL * np.array(cells[0], float)
        self.go(cells, 0)

    def go(self, cells, now):
        path = CELL * np.array(cells, float)
        self.reservation.set_path(path, np.full(len(path), self.width), self.x, self.y, now)

    @property
    def order(self):
        return order_of(self.name, 0, self.since, False)

    def decide(self, now):
        self.reservation.move(self.x, self.y)
        self.reservation.update(self.x, self.y, self.order, sorted(self.heard.values(), key=lambda c: c.name), now)

    def drive(self):
        if self.reservation.held > 1 and not self.is_blocked:
            self.x, self.y = self.reservation.ahead[1].tolist()
            self.reservation.move(self.x, self.y)

    def message(self):
        told = self.reservation.told(self.x, self.y, self.order)
        return replace(told, heard={name: other.claim for name, other in self.heard.items()})

    @property
    def arrived(self):
        return len(self.reservation.path) - self.reservation.at <= 1

    @property
    def taken(self):
        return {
            tuple(np.round(point / CELL).astype(int).tolist())
            for point in self.reservation.ahead[: self.reservation.held]
        }


def run(cars, ticks, delay=lambda: 1, when_arrived=lambda car, now: None):
    """Steps the cars, which know of each other. Returns the tick at which all had arrived, or None.

    delay: ticks of a message, or None where it is lost.
    """
    on_the_way, newest = [], {}
    for car in cars:
        car.heard = {other.name: other.message() for other in cars if other is not car}
    for tick in range(ticks):
        now = (tick + 1) * TICK_NS
        for _, sent, listener, message in [entry for entry in on_the_way if entry[0] <= tick]:
            if sent > newest.get((listener.name, message.name), -1):  # as the runner admits them
                newest[listener.name, message.name] = sent
                listener.heard[message.name] = message
        on_the_way = [entry for entry in on_the_way if entry[0] > tick]
        for car in cars:
            car.decide(now)
            car.drive()
            when_arrived(car, now)
        for a, b in combinations(cars, 2):
            assert not a.taken & b.taken, f"tick {tick}: {a.name} and {b.name} hold the same place"
        for car in cars:
            for listener in cars:
                wait = delay()
                if listener is not car and wait is not None:
                    on_the_way.append((tick + wait, tick, listener, car.message()))
        if all(car.arrived for car in cars):
            return tick
    return None


def line(x0, x1, y=0):
    step = 1 if x1 >= x0 else -1
    return [(x, y) for x in range(x0, x1 + step, step)]


def test_two_robots_in_a_corridor_drive_one_after_the_other():
    """The corridor is y = 0, x = 0 .. 9. Each robot comes from a place beside it and leaves to another one."""
    red = Car("red", [(0, 1), *line(0, 9), (9, -1)], since=2)
    blue = Car("blue", [(9, 1), *line(9, 0), (0, -1)], since=1)
    assert run([red, blue], 80) is not None


def test_the_older_task_goes_first_through_a_door():
    entered = []
    red = Car("red", [(-4, 2), *line(-4, 4), (4, 2)], since=5)
    blue = Car("blue", [(4, -2), *line(4, -4), (-4, -2)], since=3)

    def note(car, now):
        if (0, 0) in car.taken and car.name not in entered:
            entered.append(car.name)

    assert run([red, blue], 100, when_arrived=note) is not None
    assert entered == ["blue", "red"]


def test_a_robot_follows_another_through_a_corridor_without_waiting_for_its_end():
    red, blue = Car("red", line(3, 40), since=1), Car("blue", line(0, 36), since=2)
    apart = []
    assert run([red, blue], 200, when_arrived=lambda car, now: apart.append(red.x - blue.x)) is not None
    assert max(apart) < 12 * CELL


def test_where_it_is_wide_robots_pass_each_other():
    """The second one waits until the first has driven around it: here it does so through it."""
    red = Car("red", line(0, 20), since=1, width=WIDE)
    blue = Car("blue", line(20, 0), since=2, width=WIDE)
    blue.decide(0)
    red.heard, blue.heard = {"blue": blue.message()}, {"red": red.message()}
    pair = exclusions(red.message(), blue.message(), CLEARANCES)
    assert pair.near.any()
    assert not pair.narrow.any()
    assert not pair.on_path.any(), "each place is a waiting place"


@pytest.mark.parametrize("wait", [1, 2, 5])
def test_of_two_that_face_each_other_one_waits_until_the_other_has_driven_around_it(wait):
    """Two that swerve at once may choose the same side. wait: ticks of a message."""
    red = Car("red", line(0, 9), since=2, width=WIDE)
    blue = Car("blue", line(2, -7), since=1, width=WIDE)
    messages = [(red.message(), blue.message())]
    went = []
    for tick in range(60):
        messages.append((red.message(), blue.message()))
        heard = messages[max(0, len(messages) - 1 - wait)]
        red.heard, blue.heard = {"blue": heard[1]}, {"red": heard[0]}
        for car in (red, blue):
            car.decide((tick + 1) * TICK_NS)
        is_before = blue.x - red.x > 1.5 * CELL  # not yet beside each other
        going = [car.name for car in (red, blue) if is_before and car.reservation.held > 1]
        assert len(going) < 2, f"tick {tick}: both swerve"
        went += [name for name in going if name not in went]
        for car in (red, blue):
            car.drive()
    assert went == ["blue"], "the one with the older task"
    assert red.arrived
    assert blue.arrived


def test_a_robot_that_finds_no_way_around_another_one_gives_back_what_it_holds_past_it():
    """The first in the order holds a piece past a robot that stands on it. That one waits for it, and both stood."""
    red, blue = Car("red", line(0, 9), since=1, width=WIDE), Car("blue", line(2, 11), since=2, width=WIDE)
    moved_at = None
    for tick in range(100):
        red.heard, blue.heard = {"blue": blue.message()}, {"red": red.message()}
        for car in (red, blue):
            car.decide((tick + 1) * TICK_NS)
        if tick == 2:
            assert (3, 0) in red.taken, "it holds what is behind blue"
        assert not (red.taken & blue.taken) or blue.reservation.held == 1
        blue.drive()
        if blue.x > 2 * CELL and moved_at is None:
            moved_at = tick * TICK_NS
        if blue.x - red.x > 2 * CELL:  # before that blue is in its way
            red.drive()
    assert moved_at is not None
    assert STALL_NS <= moved_at < STALL_NS + NS_PER_S
    assert red.arrived
    assert blue.arrived


def test_a_robot_that_stands_without_another_one_before_it_keeps_its_piece():
    red, blue = Car("red", line(0, 9)), Car("blue", line(0, 9, y=20))
    for tick in range(100):
        red.heard, blue.heard = {"blue": blue.message()}, {"red": red.message()}
        for car in (red, blue):
            car.decide((tick + 1) * TICK_NS)
    assert red.reservation.held > 1


def test_no_robot_drives_a_new_path_before_the_others_have_heard_of_it():
    red, blue = Car("red", line(0, 9)), Car("blue", line(20, 12))
    red.heard = {"blue": blue.message()}
    red.decide(TICK_NS)
    assert red.reservation.held == 1
    red.heard = {"blue": replace(blue.message(), heard={"red": red.reservation.number})}
    red.decide(2 * TICK_NS)
    assert red.reservation.held > 1


def test_a_robot_that_does_not_answer_does_not_stop_the_others_for_ever():
    red, blue = Car("red", line(0, 9)), Car("blue", line(20, 12))
    red.heard = {"blue": blue.message()}
    for tick in range(1, 20):
        red.decide(tick * TICK_NS)
    assert red.reservation.held > 1
    assert red.reservation.deaf == ("blue",)


def test_a_new_plan_along_the_held_way_keeps_what_is_held_and_no_more():
    red = Car("red", line(0, 9))
    red.decide(TICK_NS)
    held = red.taken
    red.go([*line(0, 2), (2, 1), (2, 2), (2, 3)], TICK_NS)
    assert red.taken <= held | {(0, 0)}
    assert len(red.taken) > 1


@st.composite
def crossings(draw):
    """Streets of a town of one-lane streets: each robot has parking places of its own at both ends of its path."""
    n = draw(st.integers(2, 5))
    size = 4
    cars = []
    for i in range(n):
        column, row = draw(st.integers(0, size - 1)), draw(st.integers(0, size - 1))
        end_column, end_row = draw(st.integers(0, size - 1)), draw(st.integers(0, size - 1))
        start, goal = (1000 + 10 * i, 0), (1000 + 10 * i, 5)
        street = [(3 * column, y) for y in _steps(3 * row, 3 * end_row)]
        street += [(x, 3 * end_row) for x in _steps(3 * column, 3 * end_column)][1:]
        cars.append((f"r{i}", [start, *street, goal], draw(st.integers(0, 3))))
    return cars


def _steps(a, b):
    return range(a, b + 1) if b >= a else range(a, b - 1, -1)


@settings(max_examples=40, deadline=None)
@given(crossings(), st.randoms(use_true_random=False))
def test_robots_between_free_places_all_arrive_and_never_hold_one_place(town, random):
    """Freedom from deadlock, with messages that are late by up to three ticks, in any order, or lost."""
    cars = [Car(*args) for args in town]
    choices = [1, 1, 1, 2, 3, None]
    assert run(cars, 900, delay=lambda: random.choice(choices)) is not None


@settings(max_examples=20, deadline=None)
@given(crossings(), st.randoms(use_true_random=False))
def test_robots_that_stall_now_and_then_never_hold_one_place_and_arrive(town, random):
    cars = [Car(*args) for args in town]

    def block(car, now):
        if now % (8 * NS_PER_S) == 0:
            car.is_blocked = now < 60 * NS_PER_S and random.random() < 0.5

    assert run(cars, 1500, delay=lambda: random.choice([1, 1, 2, 3, None]), when_arrived=block) is not None


def test_robots_that_wait_for_each_other_are_a_circle_and_its_last_one_makes_way():
    waits = {"a": ("b",), "b": ("c",), "c": ("a",), "d": ("a",)}
    assert circle("a", waits) == {"a", "b", "c"}
    assert circle("d", waits) == set()
    robots = [
        TrafficRobot(name, 0.0, 0.0, RADIUS, order_of(name, 0, since, False)) for name, since in zip("abc", (3, 9, 5))
    ]
    assert yielder(robots, circle("a", waits)) == "b"
    assert yielder([robots[0], replace(robots[1], stuck=True), robots[2]], circle("a", waits)) == "c"
    assert yielder([replace(robot, stuck=True) for robot in robots], circle("a", waits)) == ""


@pytest.mark.parametrize(("priority", "first"), [(0, "a"), (5, "b")])
def test_a_priority_counts_before_the_age_of_the_task(priority, first):
    orders = {"a": order_of("a", 0, 1, False), "b": order_of("b", priority, 2, False)}
    assert min(orders, key=orders.__getitem__) == first
    assert order_of("c", 0, 9, True) < orders[first], "a robot that makes way goes before all"


def test_a_robot_that_is_started_again_waits_for_the_answers_to_its_new_claims():
    """Blue's narrow path crosses that of red, and blue has answered red's claims from before the restart."""
    order, now = order_of("red", 0, 0, False), 10**12
    path = CELL * np.array([(x, 0) for x in range(12)], float)
    across = CELL * np.array([(2, 5 - y) for y in range(11)], float)
    blue = TrafficRobot("blue", *across[0], RADIUS, order_of("blue", 0, 1, False), across, np.zeros(11), held=1)

    def begin(reservation):
        reservation.set_path(path, np.zeros(12), 0.0, 0.0, now)
        reservation.update(0.0, 0.0, order, [blue], now)

    before, after = (Reservation("red", RADIUS, CLEARANCES, reach=3 * CELL) for _ in range(2))
    for _ in range(5):
        before.set_path(path + CELL, np.zeros(12), 0.0, 0.0, now)
        begin(before)
    now += NS_PER_S
    begin(after)
    after.update(0.0, 0.0, order, [replace(blue, heard={"red": before.number})], now)
    assert after.held == 1
    after.update(0.0, 0.0, order, [replace(blue, heard={"red": after.number})], now)
    assert after.held > 3
