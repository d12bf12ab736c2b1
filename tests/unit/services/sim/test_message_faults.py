# SPDX-License-Identifier: Apache-2.0
"""Faults of the simulated laser, board and clock: what they change of the messages, and that they end."""

from math import pi

import numpy as np
import pytest

from services.sim.fault_requests import ALL_FAULTS
from services.sim.hardware.faults import Fault
from services.sim.message_faults import MESSAGE_FAULT_DESCRIPTIONS, MessageFault
from shared.codec import CodecError, Envelope, decode, encode
from shared.messages import LaserScan
from shared.requests import Break
from shared.types import NS_PER_S
from tests.unit.services.sim.scenes import SENSING, X80SV, drive, simulator, told


def payload(message):
    return encode(message, Envelope("sim", "s", 0, 0))


def asked(sim, fault, seconds=0.0, mended=False):
    answering = sim.handle_fault_request(Break(sim.now, fault, seconds, mended))
    with pytest.raises(StopIteration) as end:
        next(answering)
    return end.value.value


def under(fault, seconds=0.5, v=0.0, robot=X80SV):
    """What the simulator sends before the fault, and under it: lists of publications."""
    sim = simulator("room", robot)
    before = list(drive(sim, 1.0, v, 0.0))
    assert asked(sim, fault).accepted
    return before, list(drive(sim, seconds, v, 0.0))


def scans(fault):
    before, during = under(fault)
    return told(before, "scan")[-1], told(during, "scan")


@pytest.mark.parametrize(
    ("fault", "words"),
    [
        ("scan_2_nan", "scan_2_nan has no effect: robot.lasers has no second laser"),
        ("imu_old", "there is no robot.imu"),
        ("bumper", "robot.bumpers is empty"),
        ("cliff", "robot.cliffs is empty"),
        ("estop_input", "robot.estop_input is false"),
    ],
)
def test_a_fault_of_a_part_that_the_robot_lacks_is_refused_with_a_hint(fault, words):
    reply = asked(simulator("room"), fault)
    assert not reply.accepted
    assert words in reply.detail
    assert "zenav up --" in reply.detail
    assert asked(simulator("room", SENSING), fault).accepted


def test_every_fault_has_its_words_and_is_listed():
    assert set(MESSAGE_FAULT_DESCRIPTIONS) == set(MessageFault)
    assert set(ALL_FAULTS) == {*Fault, *MessageFault}


@pytest.mark.parametrize("fault", MessageFault)
def test_a_fault_begins_is_told_and_ends_after_its_time(fault):
    sim = simulator("room", SENSING)
    list(drive(sim, 1.0, 0.0, 0.0))
    reply = asked(sim, fault, seconds=0.4)
    assert (reply.accepted, reply.detail) == (True, MESSAGE_FAULT_DESCRIPTIONS[fault])
    again, whole = list(drive(sim, 2.0, 0.0, 0.0)), simulator("room", SENSING)
    list(drive(whole, 1.0, 0.0, 0.0))
    sound = list(drive(whole, 2.0, 0.0, 0.0))
    for key in ("scan", "scan_2", "hardware/board", "imu", "hardware/contacts"):
        assert payload(told(again, key)[-1]) == payload(told(sound, key)[-1])
    assert [payload(p.message) for p in again[:90]] != [payload(p.message) for p in sound[:90]]


def test_a_fault_is_ended_by_request_and_an_unknown_one_is_refused():
    sim = simulator("room")
    list(drive(sim, 0.2, 0.0, 0.0))
    asked(sim, "scan_nan")
    asked(sim, "sonar_dead")
    assert asked(sim, "scan_nan", mended=True).detail == "broken now: sonar_dead"
    assert asked(sim, "", mended=True).detail == "nothing is broken"
    assert "scan_nan" in asked(sim, "scan_nann").detail
    assert "--hardware emulated" in asked(sim, "unplugged").detail


def test_no_beam_or_few_return():
    assert all(np.isnan(scan.ranges).all() for scan in scans("scan_nan")[1])
    for scan in scans("scan_mostly_nan")[1]:
        assert 0.01 < np.mean(~np.isnan(scan.ranges)) < 0.1


def test_no_echo_as_inf_is_sent_as_such():
    before, during = scans("scan_inf")
    assert all(np.isinf(scan.ranges).all() and len(scan.ranges) == len(before.ranges) for scan in during)


def test_a_sector_ahead_is_dark_and_the_rest_is_not():
    for scan in scans("scan_dark_ahead")[1]:
        angles = scan.angle_min + scan.angle_increment * np.arange(len(scan.ranges)) + X80SV.laser.mount.yaw
        off = np.abs((angles + pi) % (2 * pi) - pi)
        assert np.isnan(scan.ranges[off < 0.5]).all()
        assert np.mean(np.isnan(scan.ranges[off > 0.6])) < 0.1


def test_a_covered_laser_sees_only_what_lies_within_the_robot():
    mount = X80SV.laser.mount
    for scan in scans("scan_body")[1]:
        angles = scan.angle_min + scan.angle_increment * np.arange(len(scan.ranges)) + mount.yaw
        points = np.column_stack((mount.x + scan.ranges * np.cos(angles), mount.y + scan.ranges * np.sin(angles)))
        assert np.hypot(*points.T).max() <= X80SV.circumscribed_radius
        decode(LaserScan, payload(scan))


def test_a_frozen_laser_repeats_its_last_ranges_with_fresh_stamps():
    before, during = under("scan_frozen", v=0.3)
    last, repeated = told(before, "scan")[-1], told(during, "scan")
    assert len(repeated) >= 4
    assert all(np.array_equal(scan.ranges, last.ranges, equal_nan=True) for scan in repeated)
    assert len({scan.stamp for scan in repeated}) == len(repeated)


def test_every_second_beam_looks_the_same_way_as_before():
    before, during = scans("scan_beams")
    assert all(len(scan.ranges) == -(-len(before.ranges) // 2) for scan in during)
    assert during[0].angle_increment == 2 * before.angle_increment
    assert np.nanmedian(np.abs(during[0].ranges - before.ranges[::2])) < 0.05


def test_a_silent_laser_sends_nothing_and_the_board_goes_on():
    _, during = under("scan_silent")
    assert told(during, "scan") == []
    assert len(told(during, "hardware/board")) == 25


OFFSETS = {"late": -0.5, "old": -10.0, "ahead": 1.0, "future": 3600.0}


@pytest.mark.parametrize(("source", "key"), [("scan", "scan"), ("board", "hardware/board")])
@pytest.mark.parametrize("name", OFFSETS)
def test_stamps_are_off_by_so_much(source, key, name):
    before, during = under(f"{source}_{name}")
    first = told(during, key)[0].stamp - told(before, key)[-1].stamp
    assert first / NS_PER_S - OFFSETS[name] == pytest.approx(0.1 if source == "scan" else 0.02, abs=0.03)


@pytest.mark.parametrize(("source", "key"), [("scan", "scan"), ("board", "hardware/board")])
def test_stamps_may_be_seconds_or_count_from_the_start(source, key):
    before, during = under(f"{source}_seconds")
    assert told(during, key)[-1].stamp == pytest.approx(told(before, key)[-1].stamp / NS_PER_S, abs=1)
    _, during = under(f"{source}_1970")
    assert 0 < told(during, key)[-1].stamp < 3 * NS_PER_S


def test_the_board_counts_at_random_or_its_sensors_fail():
    _, during = under("encoder_jumps")
    counts = [report.left_counts for report in told(during, "hardware/board")]
    assert np.median(np.abs(np.diff(counts))) > X80SV.drive.encoder_wrap / 10
    before, during = under("sonar_dead")
    assert all((report.ultrasonic == 0).all() for report in told(during, "hardware/board"))
    _, during = under("ranges_missing")
    n = len(told(before, "hardware/board")[0].ultrasonic)
    assert {len(report.ultrasonic) for report in told(during, "hardware/board")} == {n - 1}


def test_what_a_fault_sends_is_valid_but_for_inf():
    for fault in MessageFault:
        for publication in under(fault, robot=SENSING)[1]:
            try:
                decode(publication.topic.type, payload(publication.message))
            except CodecError:
                assert fault is MessageFault.SCAN_INF
