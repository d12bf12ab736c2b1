# SPDX-License-Identifier: Apache-2.0
"""A page of a site: it shows one robot at a time, stops each and all, and drives none by hand."""

import asyncio
import threading

import msgpack
import pytest

from services.dashboard import fleet_feed, page_hubs
from services.dashboard.config import DashboardConfig
from services.dashboard.fleet_feed import FleetFeed
from services.dashboard.frames import SITE_KEYS
from services.dashboard.page_hubs import PageHubs
from services.dashboard.service import DashboardService
from services.dashboard.web_guard import PageUser
from shared.codec import decode
from shared.crossing import OUTWARD_KEYS
from shared.requests import Watch
from shared.robot_view import RobotView
from shared.roles import Role
from tests.unit.services.dashboard.pages import LOOPBACK, ROBOT, Pages


@pytest.fixture
def pages() -> Pages:
    pages = Pages()
    pages.core = DashboardService(DashboardConfig(fleet=True), ROBOT)
    pages.core.now = 10**18
    for client, robot in ((1, "red"), (2, "blue"), (3, "red")):
        pages.event(client=client, event="open", host=LOOPBACK, robot=robot, simulated=False, version="1.0")
    return pages


def hellos(pages):
    return {client: fields for client, fields in pages.frames if fields["t"] == "hello"}


def test_each_page_gets_its_robot_and_what_crosses(pages):
    assert {client: row["robot"]["name"] for client, row in hellos(pages).items()} == {1: "red", 2: "blue", 3: "red"}
    assert all(row["site"] is True for row in hellos(pages).values())
    assert set(hellos(pages)[1]["keys"]) == set(SITE_KEYS) <= set(OUTWARD_KEYS)


def test_a_page_of_one_robot_says_nothing_of_a_site():
    pages = Pages()
    pages.open(1)
    (hello,) = hellos(pages).values()
    assert "site" not in hello
    assert hello["robot"]["name"] == ROBOT.name


def test_stop_and_its_release_are_orders_for_the_robot_of_the_page_and_no_message(pages):
    pages.orders.clear()
    pages.frame(2, "stop")
    pages.frame(2, "release")
    assert [(order["stop"], order["pressed"]) for order in pages.orders if "stop" in order] == [
        (["blue"], True), (["blue"], False),
    ]  # fmt: skip
    assert pages.messages == []
    assert sum("STOP of blue" in line for line in pages.logs) == 2


def test_any_page_stops_all_and_a_repeated_stop_is_one_line(pages):
    viewer = Pages()
    viewer.core = pages.core
    viewer.event(client=9, event="open", host="192.168.1.7", name="vera", role="viewer", robot="red")
    for _ in range(5):
        viewer.frame(9, "stop_all")
    assert [order["stop"] for order in viewer.orders if "stop" in order] == [None] * 5
    assert sum("STOP of all robots" in line for line in viewer.logs) == 1


def test_a_page_of_a_site_does_not_drive_by_hand_and_asks_only_what_crosses(pages):
    pages.teleop(1, 0.5)
    pages.run(100)
    assert pages.messages == []
    pages.orders.clear()
    pages.frame(1, "ask", id=5, request="request/cancel", args={})
    pages.frame(1, "ask", id=6, request="request/override", args={"seconds": 1.0})
    assert [order["ask"] for order in pages.orders if order.get("id") == 5] == ["request/cancel"]
    assert not [order for order in pages.orders if order.get("id") == 6 and "ask" in order]


def test_each_robot_that_is_shown_is_watched_again_and_again_and_no_other(pages):
    pages.orders.clear()
    for _ in range(100):
        pages.run(50)
    asked = [order for order in pages.orders if order.get("ask") == "request/watch_link"]
    assert {order["client"] for order in asked} == {2, 3}, "one page of each robot"
    assert 4 <= len(asked) <= 6
    assert decode(Watch, asked[0]["payload"])[0].seconds == 10.0
    for client in (1, 2, 3):
        pages.close(client)
    pages.orders.clear()
    for _ in range(100):
        pages.run(50)
    assert not [order for order in pages.orders if "ask" in order]


class FakeHub:
    def __init__(self, robot, numbers):
        self.robot, self.numbers, self.pages, self.taken, self.is_closed = robot, numbers, [], [], False

    async def opened(self, user):
        page = FakePage(next(self.numbers))
        self.pages.append(page)
        return page

    def closed(self, page):
        self.pages.remove(page)

    def take(self, order):
        self.taken.append(order)

    @property
    def is_in_use(self):
        return bool(self.pages)

    async def close(self):
        self.is_closed = True


class FakePage:
    def __init__(self, client):
        self.client, self.frames = client, []

    def take(self, t, frame):
        self.frames.append(msgpack.unpackb(frame))

    def reply(self, fields):
        self.frames.append(fields)


class FakeFeed:
    def __init__(self, deliver):
        self.deliver, self.is_open = deliver, True

    def close(self):
        self.is_open = False

    def stop(self, robots, press, by):
        return (robots or ["red", "blue"]), {} if robots else {"green": "the guard does not answer"}


def test_orders_reach_the_hub_of_their_page_alone_and_the_fleet_reaches_all():
    async def run() -> None:
        feeds = []

        def make_feed(deliver):
            feeds.append(FakeFeed(deliver))
            return feeds[-1]

        hubs = PageHubs("red", FakeHub, make_feed)
        user = PageUser("", Role.ADMIN, LOOPBACK)
        (red, first), (blue, second) = [await hubs.opened(user, name) for name in ("", "blue")]
        odd, _ = await hubs.opened(user, "../x")
        assert (red.robot, blue.robot, odd) == ("red", "blue", red)
        assert (first.client, second.client) == (1, 2)
        hubs.take({"client": 2, "id": 1, "ask": "request/cancel", "payload": b""})
        assert (len(red.taken), len(blue.taken)) == (0, 1)
        hubs.take({"client": None, "t": "clients", "frame": b""})
        assert (len(red.taken), len(blue.taken)) == (1, 2)
        feeds[0].deliver([{"name": "red"}])
        await asyncio.sleep(0)
        assert first.frames[-1] == second.frames[-1] == {"t": "fleet", "robots": [{"name": "red"}]}
        hubs.take({"client": 2, "stop": None, "pressed": True, "by": "anna"})
        hubs.take({"client": 1, "stop": ["red"], "pressed": True, "by": "anna"})
        while second.frames[-1].get("t") != "note" or first.frames[-1].get("t") != "note":
            await asyncio.sleep(0.01)
        assert second.frames[-1]["text"] == "STOP is not confirmed: green"
        assert first.frames[-1]["text"] == "STOP is pressed on red"
        for hub, page in ((red, first), (blue, second)):
            hubs.closed(hub, page)
        assert feeds[0].is_open, "a third page is open"
        hubs.closed(odd, odd.pages[0])
        assert not feeds[0].is_open

    asyncio.run(run())


def test_each_robot_has_its_own_hub_however_many_were_shown_and_one_without_pages_ends(monkeypatch):
    monkeypatch.setattr(page_hubs, "LINGER_S", 0.0)

    async def run() -> None:
        hubs, user = PageHubs("red", FakeHub, None), PageUser("", Role.ADMIN, LOOPBACK)
        opened = [await hubs.opened(user, f"r{i}") for i in range(150)]
        assert [hub.robot for hub, _ in opened] == [f"r{i}" for i in range(150)]
        kept = await hubs.opened(user, "")
        for hub, page in [*opened[1:], kept]:
            hubs.closed(hub, page)
        while not opened[-1][0].is_closed:
            await asyncio.sleep(0.01)
        assert [hub.is_closed for hub in (opened[0][0], opened[1][0], hubs.first)] == [False, True, False]
        again, _ = await hubs.opened(user, "r1")
        assert again.robot == "r1"
        assert again is not opened[1][0]

    asyncio.run(run())


def test_no_stop_waits_for_others_that_no_guard_confirms():
    n = 40
    all_begun = threading.Barrier(n, timeout=20.0)

    class SlowFeed(FakeFeed):
        def stop(self, robots, press, by):
            all_begun.wait()
            return super().stop(robots, press, by)

    async def run() -> None:
        hubs = PageHubs("red", FakeHub, SlowFeed)
        _, page = await hubs.opened(PageUser("", Role.ADMIN, LOOPBACK), "")
        for i in range(n):
            hubs.take({"client": 1, "stop": [f"r{i}"], "pressed": True, "by": "anna"})
        while len(page.frames) < n:
            await asyncio.sleep(0.01)

    asyncio.run(asyncio.wait_for(run(), 60.0))


def test_of_many_robots_each_gets_stop_before_any_has_confirmed_it(monkeypatch):
    names = [f"r{i}" for i in range(100)]
    all_begun = threading.Barrier(len(names), timeout=20.0)
    monkeypatch.setattr(fleet_feed, "confirm_stop_of", lambda *arguments: all_begun.wait())
    monkeypatch.setattr(FleetFeed, "_run", lambda self: None)
    feed = FleetFeed("tcp/127.0.0.1:1", lambda rows: None)
    assert feed.stop(names, True, "anna") == (names, {})


class OneRobot:
    """A fake of FleetListener that hears one robot."""

    def __enter__(self):
        return self

    def __exit__(self, *_):
        pass

    def hear(self, seconds):
        return [RobotView("red", "0")]

    def ask_addresses(self):
        pass


def test_stop_of_all_waits_until_robots_are_heard(monkeypatch):
    may_listen = threading.Event()

    def listener(*arguments):
        assert may_listen.wait(20.0)
        return OneRobot()

    def stop():
        outcomes.append(feed.stop(None, True, "anna"))

    outcomes = []
    monkeypatch.setattr(fleet_feed, "FIRST_S", 20.0, raising=False)
    monkeypatch.setattr(fleet_feed, "FleetListener", listener)
    monkeypatch.setattr(fleet_feed, "confirm_stop_of", lambda *arguments: None)
    feed = FleetFeed("tcp/127.0.0.1:1", lambda rows: feed.close())
    stopping = threading.Thread(target=stop)
    stopping.start()
    may_listen.set()
    stopping.join()
    assert outcomes == [(["red"], {})]


def test_stop_of_all_that_reaches_no_robot_is_an_error():
    class DeafFeed(FakeFeed):
        def stop(self, robots, press, by):
            return [], {}

    async def run() -> None:
        hubs = PageHubs("red", FakeHub, DeafFeed)
        _, page = await hubs.opened(PageUser("", Role.ADMIN, LOOPBACK), "")
        hubs.take({"client": 1, "stop": None, "pressed": True, "by": "anna"})
        while not page.frames:
            await asyncio.sleep(0.01)
        answer = page.frames[0]["level"], page.frames[0]["text"], page.frames[0]["answers"]
        assert answer == ("error", "STOP is not confirmed: no robot is heard", "stop_all")

    asyncio.run(run())


def test_a_page_without_a_router_has_one_hub_and_no_fleet():
    async def run() -> None:
        hubs = PageHubs("", FakeHub, None)
        hub, page = await hubs.opened(PageUser("", Role.ADMIN, LOOPBACK), "blue")
        assert hub is hubs.first
        hubs.take({"client": 1, "stop": None, "pressed": True, "by": "anna"})
        await asyncio.sleep(0.05)
        assert page.frames == []

    asyncio.run(run())
