# SPDX-License-Identifier: Apache-2.0
from math import exp, pi

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from shared.config import load_robot
from shared.messages import MotorCommand, WheelState
from shared.types import NS_PER_S
from zenav.calibrate.log import CalibrationLog
from zenav.calibrate.motor_response import (
    GRID,
    WheelTurn,
    brakings,
    dead_band,
    directions,
    first_order,
    lags,
    reversed_motors,
    wheel_of_motion,
    wheel_turns,
)
from zenav.calibrate.motor_test import MotorPhase, PhaseKind
from zenav.calibrate.motors import KEYS, reached_braking, with_answers

DRIVE = load_robot("x80sv").robot.drive
PER_METRE = DRIVE.counts_per_turn / (2 * pi * 0.085)
START = 10 * NS_PER_S


def log_of(command, answer, seconds) -> CalibrationLog:
    """command(t), answer(t): (left, right) m/s asked and driven, t in s from START; counts are whole numbers."""
    log, ways = CalibrationLog(), np.zeros(2)
    for i in range(round(seconds / 0.02)):
        t = i * 0.02
        left, right = command(t)
        log.add(MotorCommand(START + round(t * 1e9), -left * PER_METRE, right * PER_METRE))
        for k in range(4):
            ways += np.array(answer(t + k * 0.005)) * 0.005
        angles = np.floor(ways * PER_METRE) / PER_METRE / 0.085
        log.add(WheelState(START + round((t + 0.02) * 1e9), 1, *angles, 0.0, 0.0))
    return log


@given(st.floats(0.9, 1.1), st.floats(0.0, 0.2), st.floats(0.03, 0.3))
@settings(max_examples=10)
def test_gain_dead_time_and_lag_are_found(gain, delay, lag):
    def command(t):
        speed = 0.2 if 0.5 <= t < 2.1 else 0.0
        return -speed, speed

    def answer(t):
        begin, end = 0.5 + delay, 2.1 + delay
        rise = 1 - exp(-max(t - begin, 0) / lag)
        fall = 1 - exp(-max(t - end, 0) / lag)
        speed = 0.2 * gain * (rise - fall)
        return -speed, speed

    phase = MotorPhase(PhaseKind.STEP, START + NS_PER_S // 2, START + 21 * NS_PER_S // 10, -0.2, 0.2)
    for found in lags(log_of(command, answer, 4.0), [phase], DRIVE):
        assert found.gain == pytest.approx(gain, abs=0.02)
        assert found.delay + found.lag == pytest.approx(delay + lag, abs=0.025)
        assert found.lag == pytest.approx(lag, abs=0.035)
        assert found.rise == pytest.approx(2.197 * found.lag, rel=1e-3)
        assert found.overshoot < 0.03
        if lag < 0.15 and delay < 0.1:
            assert found.steady_error == pytest.approx(gain - 1, abs=0.02)


def test_overshoot_is_seen():
    def command(t):
        speed = 0.2 if 0.5 <= t < 2.1 else 0.0
        return -speed, speed

    def answer(t):
        t -= 0.5
        speed = 0.2 * (1 - exp(-t / 0.1) * (np.cos(12 * t) + np.sin(12 * t) / 1.2)) if 0 <= t < 1.6 else 0.0
        return -speed, speed

    phase = MotorPhase(PhaseKind.STEP, START + NS_PER_S // 2, START + 21 * NS_PER_S // 10, -0.2, 0.2)
    true = max(answer(0.5 + t)[1] for t in np.arange(0, 1.6, 0.01)) / 0.2 - 1
    assert true > 0.05
    for found in lags(log_of(command, answer, 3.0), [phase], DRIVE):
        assert found.overshoot == pytest.approx(true, abs=0.04)


@given(st.floats(0.2, 2), st.floats(0, 0.3), st.floats(0.005, 1))
def test_a_lag_settles_at_its_gain_and_begins_at_rest(gain, delay, lag):
    asked = np.concatenate((np.zeros(10), np.ones(4000)))
    answer = first_order(asked, gain, delay, lag)
    assert np.all(answer[:10] == 0)
    assert np.all(np.diff(answer) >= -1e-12)
    assert answer[-1] == pytest.approx(gain, rel=1e-6)
    at = 10 + round((delay + lag) / GRID)
    assert answer[at] == pytest.approx(gain * (1 - exp(-1)), abs=gain * 1.5 * GRID / lag)


@given(st.floats(0.3, 1.0), st.floats(0.4, 3.0))
@example(0.96, 0.75)
@settings(max_examples=10)
def test_braking_is_the_distance_since_the_motors_zero(speed, deceleration):
    def command(t):
        return (speed, speed) if t < 1.0 else (0.0, 0.0)

    def answer(t):
        now = max(speed - deceleration * max(t - 1.0, 0), 0.0)
        return now, now

    phase = MotorPhase(PhaseKind.STOP, START + NS_PER_S - 50_000_000, START + 4 * NS_PER_S, speed, speed)
    (stop,) = brakings(log_of(command, answer, 5.0), [phase], DRIVE)
    assert stop.speed == pytest.approx(speed, abs=0.01)
    summed = speed * 0.005 / 2  # m that the log's steps of 5 ms go too far
    assert stop.distance == pytest.approx(speed**2 / (2 * deceleration) + summed, abs=1.5 / PER_METRE)
    assert stop.seconds == pytest.approx(speed / deceleration, abs=0.1)
    braking = reached_braking([stop])
    assert braking is not None
    assert braking <= stop.deceleration


def test_the_weakest_stop_counts_and_none_gives_nothing():
    assert reached_braking([]) is None


@pytest.mark.parametrize("band", [0.006, 0.02, 0.05])
def test_the_dead_band_is_the_first_command_that_turns_the_wheel(band):
    stairs = [0.004 * 1.3**i for i in range(12)]

    def command(t):
        speed = stairs[min(int(t / 0.5), 11)]
        return -speed, speed

    def answer(t):
        left, right = command(t)
        return (left if -left > 2 * band else 0.0), (right if right > band else 0.0)

    phase = MotorPhase(PhaseKind.STAIRS, START, START + 6 * NS_PER_S, -1, 1)
    found = dead_band(log_of(command, answer, 6.0), [phase], DRIVE)
    first = next(s for s in stairs if s > band)
    assert found[(1, 1)] == pytest.approx(first, rel=0.31)
    assert found[(0, -1)] == pytest.approx(2 * band, rel=0.4) or np.isnan(found[(0, -1)])


def test_a_wheel_that_never_turns_has_no_dead_band():
    phase = MotorPhase(PhaseKind.STAIRS, START, START + 2 * NS_PER_S, -1, 1)
    found = dead_band(log_of(lambda t: (-0.05, 0.05), lambda t: (0, 0), 2.0), [phase], DRIVE)
    assert all(np.isnan(speed) for speed in found.values())


def trials(counted, seen=lambda wheel, sign: (wheel, sign)) -> list[WheelTurn]:
    """Each wheel alone, both ways; counted(wheel, sign) gives the encoders' ways (m) for 0.08 m asked."""
    return [
        WheelTurn(wheel, 0.08 * sign, *counted(wheel, 0.08 * sign), seen(wheel, sign))
        for wheel in (0, 1) for sign in (1, -1)
    ]  # fmt: skip


def own(wheel, way):
    return (way, 0.0) if wheel == 0 else (0.0, way)


@pytest.mark.parametrize(
    ("found", "told"),
    [
        (trials(own), []),
        (trials(own, lambda wheel, sign: None), []),
        (trials(lambda w, way: own(1 - w, way)), ["the encoders are exchanged"]),
        (trials(lambda w, way: own(w, -way if w == 0 else way)), ["the left encoder counts against its motor"]),
        (
            trials(lambda w, way: own(w, way * (w == 0))),
            ["the right wheel does not turn forward", "the right wheel does not turn backward"],
        ),
        (trials(own, lambda w, s: (w, -s)), ["the robot drives backward"]),
        (trials(own, lambda w, s: (1 - w, s)), ["the motors are exchanged"]),
        (trials(own, lambda w, s: (1 - w, -s)), ["the motors are exchanged, and run backward"]),
        (trials(own, lambda w, s: (w, -s if w == 1 else s)), ["the right motor runs backward"]),
    ],
)
def test_wrong_wiring_is_named_with_its_hint(found, told):
    wrong = directions(found, DRIVE)
    assert len(wrong) == len(told)
    for (what, hint), expected in zip(wrong, told):
        assert what.startswith(expected)
        assert hint


def test_only_motors_and_encoders_reversed_together_are_a_matter_of_the_sign():
    assert reversed_motors(trials(own, lambda w, s: (w, -s)))
    assert not reversed_motors(trials(own))
    assert not reversed_motors(trials(lambda w, way: own(w, -way), lambda w, s: (w, -s)))
    assert not reversed_motors([])


@pytest.mark.parametrize("wheel", [0, 1])
@pytest.mark.parametrize("sign", [1, -1])
def test_a_wheel_alone_is_known_by_how_it_swings_the_robot(wheel, sign):
    way = 0.08 * sign
    forward, turn = way / 2, way / 0.283 * (1 if wheel else -1)
    assert wheel_of_motion(forward, turn, 0.08, 0.283) == (wheel, sign)
    assert wheel_of_motion(forward / 10, turn / 10, 0.08, 0.283) is None


def test_what_people_saw_counts():
    found = with_answers(trials(own, lambda w, s: None), ["", "lb", "rb", "-"])
    assert [t.seen for t in found] == [(0, 1), (0, -1), (1, -1), None]
    assert set(KEYS) == {"lf", "lb", "rf", "rb", "-"}


def test_turning_alone_is_read_from_the_encoders():
    log = log_of(lambda t: (0.1, 0.0), lambda t: (0.1, 0.0) if t < 0.8 else (0.0, 0.0), 2.0)
    (found,) = wheel_turns(log, [MotorPhase(PhaseKind.ALONE, START, START + 4 * NS_PER_S // 5, 0.1, 0.0)], DRIVE)
    assert (found.left, found.right) == pytest.approx((0.08, 0.0), abs=0.002)
    assert found.counted == found.commanded == (0, 1)
