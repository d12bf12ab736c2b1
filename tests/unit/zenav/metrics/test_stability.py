# SPDX-License-Identifier: Apache-2.0
"""Figures of steadiness, on rides whose figures are known."""

import json
from math import pi, sqrt
from pathlib import Path as File

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from shared import messages as m
from shared.geometry import Pose2
from shared.messages import NavState, NavStatus, Odometry, Path
from zenav.__main__ import _status
from zenav.metrics.stability import FIGURES, Ride, n_side_changes, stability_figures

TIMES = np.arange(0.0, 60.0, 0.02)
WHOLE = [(0.0, 60.0)]


def ride(v, w=0.0):
    return np.column_stack((TIMES, np.broadcast_to(v, TIMES.shape), np.broadcast_to(w, TIMES.shape)))


def test_a_steady_ride_has_nothing_to_complain_of():
    assert set(stability_figures(ride(0.5), WHOLE, []).values()) == {0.0}


@given(st.floats(0.05, 0.5), st.floats(0.5, 2.0))
def test_the_jerk_of_a_speed_that_swings_is_the_textbook_s(amplitude, hertz):
    omega = 2 * pi * hertz
    found = stability_figures(ride(1.0 + amplitude * np.sin(omega * TIMES)), WHOLE, [])
    # a difference over 0.2 s is the derivative times sinc
    expected = amplitude * omega**2 / sqrt(2) * np.sinc(hertz * 0.2) ** 2
    assert found["jerk_rms"] == pytest.approx(expected, rel=0.03, abs=2e-4)
    assert found["jerk_p99"] == pytest.approx(expected * sqrt(2), rel=0.03, abs=2e-4)


@given(st.floats(0.1, 1.0), st.floats(0.5, 2.0))
def test_turning_acceleration_is_that_of_the_turn_rate(amplitude, hertz):
    omega = 2 * pi * hertz
    found = stability_figures(ride(0.5, amplitude * np.sin(omega * TIMES)), WHOLE, [])
    assert found["turn_acceleration_rms"] == pytest.approx(amplitude * omega / sqrt(2) * np.sinc(hertz * 0.2), rel=0.03)
    assert found["jerk_rms"] == 0.0


def test_constant_acceleration_is_no_jerk():
    assert stability_figures(ride(0.2 + 0.01 * TIMES), WHOLE, [])["jerk_rms"] == pytest.approx(0.0, abs=1e-6)


def test_stop_and_go_is_counted_and_standing_before_and_after_is_not():
    v = np.where(TIMES % 10 < 7, 0.5, 0.0)  # 3 s of standing after each 7 s of driving
    v[TIMES < 0.1] = 0.0
    found = stability_figures(ride(v), WHOLE, [])
    driven = 57.0 - 0.1
    assert found["stops_per_min"] == pytest.approx(5 * 60 / driven, rel=0.01)
    assert found["standing_share"] == pytest.approx(15.0 / driven, rel=0.01)


def test_turning_on_the_spot_is_no_standing():
    found = stability_figures(ride(np.where(TIMES % 10 < 7, 0.5, 0.0), np.where(TIMES % 10 < 7, 0.0, 1.0)), WHOLE, [])
    assert (found["stops_per_min"], found["standing_share"]) == (0.0, 0.0)


def test_what_happens_while_nothing_is_under_way_does_not_count():
    v = np.where((TIMES > 20) & (TIMES < 40), 0.5 * (TIMES % 1 < 0.5), 0.5)
    found = stability_figures(ride(v), [(0.0, 19.9), (40.1, 60.0)], [])
    assert set(found.values()) == {0.0}


def test_where_nothing_was_driven_nothing_is_told():
    for motion, spans in ((ride(0.0), WHOLE), (ride(0.5), []), (np.zeros((0, 3)), WHOLE)):
        assert set(stability_figures(motion, spans, []).values()) == {None}


def way(side, start=0.0, end=6.0):
    """To (end, 0), in the middle `side` m to the left."""
    x = np.linspace(start, end, 121)
    return np.column_stack((x, side * np.sin(pi * x / 6)))


def test_only_plans_to_the_same_place_by_another_way_are_changes():
    assert n_side_changes([way(0.6), way(0.6), way(0.6)]) == 0
    assert n_side_changes([way(0.6), way(-0.6), way(0.6), way(0.4)]) == 2
    assert n_side_changes([way(0.6), way(-0.6, end=3.0)]) == 0, "another place"
    assert n_side_changes([way(0.6), way(0.6, start=2.0)]) == 0, "the rest of the same way"
    assert n_side_changes([]) == n_side_changes([way(0.6)]) == 0


def test_a_recording_of_a_drive_tells_its_figures(capsys):
    path = File(__file__).parents[3] / "replay" / "recordings" / "driving.mcap"
    assert _status(["recording", "stability", str(path), "--json"]) == 0
    figures = json.loads(capsys.readouterr().out)
    assert figures.keys() == FIGURES.keys()
    assert 0.0 < figures["jerk_rms"] < figures["jerk_p99"]
    assert 0.0 <= figures["standing_share"] < 0.5


def status(stamp, state, task=1):
    return NavStatus(stamp, task, state, "", "", "", Pose2(), 0.0, 0.0, 0, 0, 0)


def test_a_ride_s_messages_tell_when_a_task_was_under_way_and_what_was_planned_in_it():
    found, second = Ride(), 1_000_000_000
    for i in range(3000):
        stamp = i * second // 50
        found.add(Odometry(stamp, Pose2(), 0.5, 0.0, np.zeros(9)))
    for i in range(60):
        state = NavState.NAVIGATING if 10 <= i < 40 else NavState.IDLE
        found.add(status(i * second, state))
        points = way(0.6 if i % 2 else -0.6)
        plan = Path(i * second, 1, 1, "", points[:, 0], points[:, 1], np.zeros(121), 6.0, 6.0)
        found.add(plan)
    figures = found.figures()
    assert figures["side_changes_per_min"] == pytest.approx(60.0, rel=0.05)
    assert figures["jerk_rms"] == 0.0
    truth = m.Truth(0, Pose2(), Pose2(), 0.0, 0.0, False, 0, 0.0, np.zeros(0, np.float32), np.zeros(0, np.float32))
    found.add(truth)
    assert found.figures()["jerk_rms"] is None, "the truth goes before odometry, and stands"
