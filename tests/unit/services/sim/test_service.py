# SPDX-License-Identifier: Apache-2.0
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from numpy.testing import assert_allclose

from services.sim.contact import touches_people, touches_world, transform_polygon
from shared.codec import Envelope, encode
from shared.messages import LaserScan, MotorCommand
from shared.service import Log, outputs
from shared.topics import topic_of
from tests.strategies import faults, publications
from tests.unit.services.sim.scenes import JACKAL, START, TICK, X80SV, drive, laser, simulator, told, written

WALL = "start: {x: 0, y: 0}\nboxes: [{x: 1.25, y: 0, size: [0.1, 4]}]\n"


def payloads(publications):
    return [encode(p.message, Envelope("sim", "s", 0, 0)) for p in publications]


def test_topics_come_at_their_rates():
    sent = list(drive(simulator("room"), 10.0, 0.0, 0.3))
    for key, rate in (("hardware/board", 50), ("sim/truth", 50), ("sim/clock", 50), ("scan", 10)):
        messages = told(sent, key)
        assert abs(len(messages) - 10 * rate) <= 1
        assert all(after.stamp > before.stamp for before, after in pairwise(messages))


def test_two_ticks_within_one_step_of_the_physics_measure_once():
    sim = simulator("room")
    list(drive(sim, 0.1, 0.0, 0.3))
    at = sim.now
    for late in (17_000_000, 23_000_000, 40_000_000):  # ns: a late tick, and the next one at once
        sim.now = at + late
        first, second = list(outputs(sim.tick())), list(outputs(sim.tick()))
        assert {p.topic.key for p in first} >= {"hardware/board", "sim/truth"}
        assert second == []


def test_the_same_seed_and_events_give_the_same_bytes_and_another_seed_others():
    def sent(seed):
        return payloads(drive(simulator("office", seed=seed), 4.0, 0.4, 0.3))

    assert sent(3) == sent(3)
    assert sent(3) != sent(4)


def test_warming_up_changes_nothing():
    warm = simulator("office")
    warm.warm_up()
    assert payloads(drive(warm, 1.0, 0.3, 0.3)) == payloads(drive(simulator("office"), 1.0, 0.3, 0.3))


def test_when_ticks_come_does_not_change_the_way_that_is_driven():
    regular, late = simulator("office"), simulator("office")
    list(drive(regular, 2.0, 0.3, 0.4))
    motors = regular.targets.copy()
    list(drive(late, 0.02, 0.3, 0.4))
    assert np.array_equal(late.targets, motors)
    rng = np.random.default_rng(0)
    while late.now < START + 2_000_000_000:
        late.now = min(late.now + int(rng.integers(1_000_000, 400_000_000)), START + 2_000_000_000)
        list(late.tick())
    assert np.array_equal(late.state_now[:9], regular.state_now[:9])


def test_after_a_long_gap_the_world_has_stood_still_and_goes_on():
    service = simulator("empty")
    before = told(drive(service, 2.0, 0.5, 0.0), "sim/truth")[-1]
    service.now += 60_000_000_000
    after = told(list(service.tick()), "sim/truth")[-1]
    assert after.world_from_base == before.world_from_base
    assert after.stamp == service.now
    sent = list(drive(service, 1.0, 0.5, 0.0))
    assert told(sent, "sim/truth")[-1].distance > before.distance + 0.4
    assert all(scan.stamp > before.stamp + 50_000_000_000 for scan in told(sent, "scan"))


def test_a_clock_set_back_is_followed():
    service = simulator("room")
    list(drive(service, 2.0, 0.1, 0.5))
    service.now = START // 2
    sent = list(drive(service, 2.0, 0.1, 0.5))
    assert len(told(sent, "scan")) >= 9
    assert all(START // 2 <= p.message.stamp < START for p in sent)


def test_motor_commands_without_ticks_are_survived_and_no_scan_is_made_up():
    service = simulator("room")
    list(service.tick())
    for _ in range(500):
        service.now += TICK
        list(service.motors(MotorCommand(service.now, -100.0, 120.0)))
    scans = told(list(service.tick()), "scan")
    assert 1 <= len(scans) <= 0.8 * X80SV.laser.rate
    assert all(scan.stamp > service.now - 1_000_000_000 for scan in scans)


def test_a_wall_stops_the_robot_and_is_one_contact_until_it_has_left(tmp_path):
    service = simulator(written(tmp_path, WALL))
    before = told(drive(service, 5.0, 0.5, 0.0), "sim/truth")
    assert not before[10].contact
    assert before[-1].contact
    assert before[-1].n_contacts == 1
    assert 0.99 < before[-1].world_from_base.x < 1.01
    assert abs(before[-1].v) < 0.01
    standing = told(drive(service, 1.0, 0.0, 0.0), "sim/truth")[-1]
    assert standing.contact
    assert standing.n_contacts == 1
    away = told(drive(service, 2.0, -0.3, 0.0), "sim/truth")[-1]
    assert not away.contact
    assert away.n_contacts == 1
    again = told(drive(service, 4.0, 0.3, 0.0), "sim/truth")[-1]
    assert again.n_contacts == 2


@settings(deadline=None, max_examples=10)
@given(
    st.lists(st.tuples(st.floats(-2, 2), st.floats(-4, 4), st.floats(0.1, 2)), min_size=2, max_size=6),
    st.sampled_from(["room", "corridor", "office"]),
    st.sampled_from([X80SV, JACKAL]),
    st.booleans(),
)
def test_however_it_is_driven_nothing_is_ever_penetrated(commands, world, robot, reacts):
    service = simulator(world, robot, people_react=reacts)
    for v, w, seconds in commands:
        for _ in drive(service, seconds, v, w):
            state = service.state_now
            at = transform_polygon(robot.corners, *state[:3])
            assert not touches_world(at, service.cells)
            assert not touches_people(at, service.people.state[:, :3])


def test_a_crowd_that_does_not_react_counts_its_contacts(tmp_path):
    path = written(tmp_path, "start: {x: 0, y: 0}\npeople: [{route: [[-3, 0], [3, 0]], pause: 0}]\n")
    contacts = {}
    for reacts in (True, False):
        service = simulator(path, people_react=reacts)
        truth = told(drive(service, 20.0, 0.0, 0.0), "sim/truth")[-1]
        contacts[reacts] = truth.n_contacts
    assert contacts[True] == 0
    assert contacts[False] >= 1


def test_truth_tells_where_the_map_frame_lies_and_who_walks_where():
    service = simulator("office")
    for truth in told(drive(service, 3.0, 0.3, 0.0), "sim/truth"):
        assert truth.start == service.world.start
    assert_allclose(truth.people_x, service.people.state[:, 0], atol=1e-5)
    assert_allclose(truth.people_y, service.people.state[:, 1], atol=1e-5)


@pytest.mark.parametrize(
    "robot", [X80SV, JACKAL, laser(X80SV, rate=120.0, scan_time=0.001), laser(X80SV, scan_time=0.0)]
)
def test_every_message_is_valid(robot):
    for publication in drive(simulator("office", robot), 1.0, 0.3, 0.5):
        assert not list(faults(publication.message))
        assert topic_of(publication.topic.key) is publication.topic
    assert isinstance(told(drive(simulator("office", robot), 0.5, 0.0, 0.0), "scan")[0], LaserScan)


SERVICE = simulator("room")


@settings(deadline=None, suppress_health_check=list(HealthCheck))
@given(st.lists(st.tuples(publications(SERVICE), st.integers(-(10**9), 10**10)), max_size=12))
def test_any_valid_events_are_survived(events):
    service = simulator("room")
    for (method, message), later in events:
        service.now = max(0, service.now + later)
        arguments = () if message is None else (message,)
        for output in outputs(getattr(service, method)(*arguments)):
            assert isinstance(output, Log) or not list(faults(output.message))
