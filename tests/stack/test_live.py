# SPDX-License-Identifier: Apache-2.0
"""The live runner over Zenoh: two services in threads, each with its own session, on loopback ports of their own."""

import socket
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager

import pytest
import zenoh

from shared import requests, topics
from shared.codec import Envelope, decode, encode
from shared.config import Section, UserError, load_robot
from shared.geometry import Pose2
from shared.messages import EmergencyStop, Goal, RangeReadings, WheelState
from shared.requests import Cancel, Reply
from shared.runners import transport
from shared.runners.clock import StackClock
from shared.runners.live_runner import LiveRunner
from shared.sample_messages import range_readings
from shared.service import Answer, Job, Out, Service, answer, every, on

ROBOT = load_robot("x80sv").robot


def free_stack() -> int:
    for domain in range(transport.MAX_DOMAIN, 100, -1):
        where = transport.StackAddress(domain)
        try:
            for name in topics.SERVICES:
                with socket.socket() as s:
                    s.bind(("127.0.0.1", where.port(name)))
        except OSError:
            continue
        return domain
    raise RuntimeError("no free ports")


class TickingBase(Service):
    @every(hz=50)
    def tick(self) -> Out:
        yield topics.WHEELS(WheelState(self.now, 0, 0.1, 0.2, 0.0, 0.0))


class CountingOdometry(Service):
    def __init__(self) -> None:
        super().__init__(Section(), ROBOT)
        self.seen: list[WheelState] = []
        self.enough = threading.Event()
        self.totals: list[int] = []

    @on(topics.WHEELS)
    def wheels(self, wheels: WheelState) -> Out:
        self.seen.append(wheels)
        if len(self.seen) == 5:
            yield Job(sum, ([1, 2, 3],), done="added", takes=0.1)

    def added(self, total: int) -> Out:
        self.totals.append(total)
        self.enough.set()
        return ()


class CancellingNavigator(Service):
    def __init__(self) -> None:
        super().__init__(Section(), ROBOT)
        self.cancelled = 0

    @answer(requests.CANCEL)
    def cancel(self, request: Cancel) -> Answer[Reply]:
        self.cancelled += 1
        yield topics.GOAL(Goal(self.now, self.cancelled, False, Pose2(1, 2, 0), 0.1, 0.1, False))
        return Reply(self.now, True, "", "stopped", 7)


class SlowNavigator(CancellingNavigator):
    """Each tick takes longer than its period, on a clock that stands otherwise."""

    def __init__(self, clock: "HandSetClock") -> None:
        super().__init__()
        self.clock = clock

    @every(hz=10)
    def tick(self) -> Out:
        self.clock.time += 150_000_000
        return ()


class HandSetClock(StackClock):
    def __init__(self) -> None:
        super().__init__()
        self.time = 1_700_000_000_000_000_000

    def now(self) -> int:
        return self.time


class GoalListener(Service):
    def __init__(self) -> None:
        super().__init__(Section(), ROBOT)
        self.goals: list[int] = []
        self.got = threading.Event()

    @on(topics.GOAL)
    def goal(self, goal: Goal) -> Out:
        self.goals.append(goal.id)
        self.got.set()
        return ()


class StoringPlanner(GoalListener):
    """Stores wheels and ranges until a goal comes."""

    def __init__(self) -> None:
        super().__init__()
        self.stamps: list[int] = []
        self.ranges: list[int] = []
        self.at_goal: list[list[int]] = []
        self.stored = threading.Semaphore(0)

    @on(topics.WHEELS, waits=True)
    def wheels(self, wheels: WheelState) -> Out:
        self.stamps.append(wheels.stamp)
        self.stored.release()
        return ()

    @on(topics.RANGES, waits=True)
    def take_ranges(self, readings: RangeReadings) -> Out:
        self.ranges.append(readings.stamp)
        return ()

    @on(topics.GOAL)
    def goal(self, goal: Goal) -> Out:
        self.at_goal.append(list(self.stamps))
        return super().goal(goal)


class StopListener(Service):
    def __init__(self) -> None:
        super().__init__(Section(), ROBOT)
        self.got = threading.Semaphore(0)

    @on(topics.ESTOP)
    def estop(self, stop: EmergencyStop) -> Out:
        self.got.release()
        return ()


@contextmanager
def running(
    service: Service,
    name: str,
    where: transport.StackAddress,
    robot: str = ROBOT.name,
    clock: StackClock | None = None,
) -> Iterator[LiveRunner]:
    with transport.opened(where, name) as session:
        live = LiveRunner(service, name, robot, session, clock or StackClock())
        thread = threading.Thread(target=live.run)
        thread.start()
        try:
            yield live
        finally:
            live.stop()
            thread.join(5)
            assert not thread.is_alive()


@pytest.fixture
def where() -> transport.StackAddress:
    return transport.StackAddress(free_stack())


def wait_for(condition: Callable[[], bool], event: threading.Event, seconds: float = 10.0) -> None:
    assert event.wait(seconds)
    assert condition()


def test_messages_and_jobs_arrive_whoever_starts_first(where):
    odometry = CountingOdometry()
    with running(odometry, "odometry", where), running(TickingBase(Section(), ROBOT), "base_driver", where):
        wait_for(lambda: odometry.totals == [6], odometry.enough)
    stamps = [wheels.stamp for wheels in odometry.seen]
    assert stamps == sorted(set(stamps))


def test_random_bytes_and_intruders_are_counted_and_the_service_goes_on(where):
    odometry = CountingOdometry()
    with running(odometry, "odometry", where) as live, transport.opened(where) as tool:
        key = f"{ROBOT.name}/base/wheels"
        good = WheelState(1, 0, 0.0, 0.0, 0.0, 0.0)
        for junk in (b"", b"\xc1", b"\xff" * 4000, encode(good, Envelope("sim", "s", 0, 0)), b"\x81\xa5stamp\x01"):
            tool.put(key, junk)
        with running(TickingBase(Section(), ROBOT), "base_driver", where):
            wait_for(lambda: True, odometry.enough)
        assert live.stats.bad == 4
        assert live.stats.intruders == 1


def test_waiting_messages_are_handled_in_order_before_the_next_event_and_without_one(where):
    planner, base, navigator = StoringPlanner(), f"{ROBOT.name}/base", f"{ROBOT.name}/goal"
    n, goal = 40, Goal(1, 1, True, Pose2(1, 2, 0), 0.1, 0.1, False)
    with running(planner, "planner", where) as live, transport.opened(where, "base_driver") as robot:
        for stamp in range(n):
            wheels = WheelState(stamp, 0, 0.0, 0.0, 0.0, 0.0)
            robot.put(f"{base}/wheels", encode(wheels, Envelope("base_driver", "b", stamp, stamp)))
            readings = encode(range_readings(stamp, 2), Envelope("base_driver", "b", stamp, stamp))
            robot.put(f"{base}/ranges", readings)
            if stamp == n // 2:
                robot.put(f"{base}/wheels", b"\xc1")
                robot.put(f"{base}/wheels", bytes(transport.MAX_PAYLOAD + 1))
        robot.put(navigator, encode(goal, Envelope("navigator", "n", 0, n)))
        wait_for(lambda: planner.goals == [1], planner.got)
        assert planner.at_goal == [list(range(n))]
        assert planner.ranges[-1] == n - 1
        assert planner.ranges == sorted(set(planner.ranges))
        assert live.stats.bad == 1
        wheels = WheelState(n, 0, 0.0, 0.0, 0.0, 0.0)
        robot.put(f"{base}/wheels", encode(wheels, Envelope("base_driver", "b", n, n)))
        for _ in range(n + 1):
            assert planner.stored.acquire(timeout=10.0)


def test_a_late_joiner_has_the_goal_at_once_and_a_request_is_answered(where):
    planner = GoalListener()
    with running(CancellingNavigator(), "navigator", where), transport.opened(where) as tool:
        payload = encode(Cancel(1), Envelope("operator", "o", 0, 1))
        replies = [
            decode(Reply, r.ok.payload.to_bytes())[0]
            for r in tool.get(f"{ROBOT.name}/request/cancel", payload=payload, timeout=20.0)
            if r.ok is not None
        ]
        assert [(r.accepted, r.task_id) for r in replies] == [(True, 7)]
        (refused,) = tool.get(f"{ROBOT.name}/request/cancel", payload=b"\x00", timeout=20.0)
        assert decode(Reply, refused.ok.payload.to_bytes())[0].reason == "bad_request"
        with running(planner, "planner", where):
            wait_for(lambda: planner.goals == [1], planner.got)


def test_a_service_whose_tick_takes_longer_than_its_period_still_answers(where):
    clock = HandSetClock()
    navigator = SlowNavigator(clock)
    with running(navigator, "navigator", where, clock=clock), transport.opened(where) as tool:
        payload = encode(Cancel(1), Envelope("operator", "o", 0, 1))
        replies = list(tool.get(f"{ROBOT.name}/request/cancel", payload=payload, timeout=20.0))
    assert len(replies) == navigator.cancelled == 1


def test_a_stop_after_another_client_s_stop_is_asked_for_once_and_not_again_and_again(where):
    """A session whose first message is unknown makes the listener ask; the answer, another client's stop, is older."""
    guard, key, asked = StopListener(), f"{ROBOT.name}/estop", threading.Semaphore(0)
    n_queries, n_stops = 0, 20

    def stop(session: str, sequence: int, sent: int) -> bytes:
        return encode(EmergencyStop(sent, True, "test"), Envelope("operator", session, sequence, sent))

    def reply(query: zenoh.Query) -> None:
        nonlocal n_queries
        n_queries += 1
        with query:
            query.reply(key, stop("first", 0, 1_000))
        asked.release()

    with running(guard, "guard", where), transport.opened(where, "dashboard") as page:
        queryable = page.declare_queryable(key, reply, complete=True)
        assert asked.acquire(timeout=30.0)
        assert guard.got.acquire(timeout=30.0)  # the latched value
        before = n_queries
        for sequence in range(1, n_stops + 1):
            page.put(key, stop("second", sequence, 1_000 + sequence))
            assert guard.got.acquire(timeout=30.0)
            assert asked.acquire(timeout=30.0)
        queryable.undeclare()
    assert n_stops <= n_queries - before <= n_stops + 1  # the first value may have been asked for twice


def test_a_second_instance_is_refused_with_the_port(where):
    with running(GoalListener(), "planner", where), pytest.raises(UserError, match=str(where.port("planner"))):
        transport.opened(where, "planner")


def test_the_configuration_is_the_one_that_zenoh_keeps():
    config = transport.configuration(transport.StackAddress(3), "mapper")
    assert config.get_json("transport/shared_memory/enabled") == "false"
    assert config.get_json("scouting/multicast/enabled") == "false"
    assert "127.0.0.1" in config.get_json("listen/endpoints")
    assert config.get_json("transport/link/rx/max_message_size") == str(transport.MAX_MESSAGE)
    assert isinstance(config, zenoh.Config)
