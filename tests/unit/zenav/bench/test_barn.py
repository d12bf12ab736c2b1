# SPDX-License-Identifier: Apache-2.0
"""BARN's referee: the score, exact clearance, which worlds, and the errors of wrong arguments."""

import csv
import json
from math import pi
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.testing import assert_allclose

from services.sim.world_loader import read_cylinder_file
from shared import requests, topics
from shared.config import Section, UserError, load_robot
from shared.messages import MotorCommand
from shared.requests import Reply
from shared.runners.lockstep import Lockstep
from shared.service import Answer, Out, Service, answer, every
from zenav.__main__ import _status
from zenav.bench.barn import NOISE, summary, worlds_from, write_trajectory
from zenav.bench.barn_run import (
    FREE_TIME,
    BarnFile,
    BarnTrial,
    Referee,
    barn_robot_file,
    course_of,
    smallest_clearance,
)
from zenav.metrics.barn import BarnResult, barn_score
from zenav.stack.service_loader import build_service

JACKAL = load_robot("jackal").robot
FILE = {
    "cylinder_radius_m": 0.075,
    "start": [0.0, 0.0, pi / 2],
    "goal": [0.0, 10.0],
    "goal_radius_m": 1.0,
    "time_limit_s": 100.0,
    "worlds": {"7": {"cylinders": [[1.5, 0.0]], "optimal_length_m": 10.0}},
}


@given(st.floats(0.01, 300), st.floats(2, 30))
def test_the_score_is_half_at_most_and_falls_to_an_eighth_with_time(time, length):
    scored = barn_score("success", time, length)
    assert 0.125 <= scored <= 0.5
    assert scored >= barn_score("success", 1.5 * time, length)
    assert barn_score("success", length, length) == 0.5  # 1 m/s on the reference path
    assert_allclose(barn_score("success", 2 * length, length), 0.25)
    assert barn_score("collision", time, length) == barn_score("timeout", time, length) == 0.0


def test_the_clearance_on_a_way_is_found_between_its_poses_too():
    cylinders = np.array([[0.01, 0.5, 0.075], [5.0, 5.0, 0.075]])
    way = np.column_stack((np.linspace(-1, 1, 51), np.zeros(51), np.zeros(51)))
    assert_allclose(smallest_clearance(way, cylinders, JACKAL.corners), 0.5 - 0.075 - 0.208, atol=1e-9)
    spot = np.column_stack((np.zeros(40), np.zeros(40), np.linspace(3.0, 3.0 + 2 * pi, 40)))
    corner = np.hypot(0.229, 0.208)
    assert_allclose(smallest_clearance(spot, cylinders[:1] - (0.01, 0, 0), JACKAL.corners), 0.425 - corner, atol=1e-3)
    assert smallest_clearance(way, np.array([[0.3, 0.1, 0.075]]), JACKAL.corners) < 0


def test_worlds_are_chosen_by_number_and_those_that_the_file_lacks_are_left_out():
    known = ("1", "2", "4", "10")
    assert worlds_from("", known) == ["1", "2", "4", "10"]
    assert worlds_from("2-9,10", known) == ["2", "4", "10"]
    for wrong in ("3", "x", "5-7", "9-2"):
        with pytest.raises(UserError, match="worlds"):
            worlds_from(wrong, known)


def test_the_summary_is_the_mean_over_worlds_of_the_mean_over_runs():
    row = {"clearance": 0.1, "recoveries": 0, "stood": False}
    runs = [
        {"world": 1, "status": "success", "time": 8.0, "score": 0.5, **row},
        {"world": 1, "status": "timeout", "time": 100.0, "score": 0.0, **row},
        {"world": 2, "status": "success", "time": 10.0, "score": 0.4, **row},
        {"world": 3, "status": "collision", "time": 3.0, "score": 0.0, **row},
    ]
    told = summary(runs)
    assert (told["success"], told["collision"], told["timeout"]) == (0.5, 0.25, 0.25)
    assert told["mean_time"] == 9.0
    assert_allclose(told["score"], (0.25 + 0.4 + 0) / 3, atol=1e-5)


def test_a_trajectory_is_written_as_the_others_read_it(tmp_path):
    write_trajectory(tmp_path / "a.csv", [[0.0, 1.0, 2.0, 0.5, 0.1, -0.2]])
    with (tmp_path / "a.csv").open(encoding="utf-8") as file:
        (row,) = csv.DictReader(file)
    assert {name: float(value) for name, value in row.items()} == {
        "t": 0.0, "x": 1.0, "y": 2.0, "heading": 0.5, "v": 0.1, "w": -0.2,
    }  # fmt: skip


def test_noise_is_a_skid_steered_robots(tmp_path):
    path = tmp_path / "w.json"
    path.write_text(json.dumps(FILE))
    course = course_of(path, read_cylinder_file(path, BarnFile), "7")
    true, ideal = (build_service("sim", file, file.robot).config.drive for file in (
        barn_robot_file(BarnTrial(course, 0, "jackal", settings)) for settings in (NOISE, ())
    ))  # fmt: skip
    assert true.distance_error >= 0.04 > ideal.distance_error  # what a calibration on another floor leaves
    assert true.turn_slip > 0.4 > ideal.turn_slip
    assert true.slip >= 0.03 > ideal.slip


@pytest.mark.parametrize(
    ("arguments", "told"),
    [
        (["nowhere"], "there is no nowhere"),
        (["w.json", "--worlds", "8"], "none of the worlds 8"),
        (["w.json", "--set", "local_ctrl.speed=1"], "local_ctrl.speed is not a setting"),
        (["w.json", "--trajectories", "w.json"], "cannot write to w.json"),
        (["bad.json"], "not a list of cylinders"),
    ],
)
def test_a_wrong_argument_is_told_before_anything_runs(tmp_path, monkeypatch, capsys, arguments, told):
    monkeypatch.chdir(tmp_path)
    Path("w.json").write_text(json.dumps(FILE))
    Path("bad.json").write_text(json.dumps(FILE | {"goal_radius_m": -1}))
    assert _status(["bench", "barn", *arguments]) == 2
    shown = capsys.readouterr().err
    assert told in shown
    assert "hint: " in shown
    assert not Path("out").exists()


class ConstantDriver(Service):
    """In the place of the base driver: straight on, from the start."""

    speed = 1.0  # m/s

    @every(hz=50)
    def drive(self) -> Out:
        drive = self.robot.drive
        counts = self.speed / drive.wheel_radius * drive.counts_per_turn / (2 * pi)
        yield topics.MOTORS(MotorCommand(self.now, -counts, counts))


class Slow(ConstantDriver):
    """Not 10 cm in half a minute."""

    speed = 0.002


class RefereedNavigator(Service):
    """In the navigator's place: takes every goal."""

    @answer(requests.NAVIGATE)
    def navigate(self, request: requests.Navigate) -> Answer[Reply]:
        yield from ()
        return Reply(self.now, True, "", "")


def refereed(tmp_path, driver: type[Service], *cylinders: list[float], delay: float = 0.0) -> BarnResult:
    path = tmp_path / "w.json"
    worlds = {"1": {"cylinders": [[2.0, 0.0], *cylinders], "optimal_length_m": 10.0}}
    path.write_text(json.dumps(FILE | {"worlds": worlds, "time_limit_s": 20.0}))
    course = course_of(path, BarnFile.model_validate(json.loads(path.read_text())), "1")
    file = barn_robot_file(
        BarnTrial(course, 0, "jackal", ("sim.drive.slip=0", "sim.drive.radius_error=0", "robot.laser.rate=1"))
    )
    services = {"sim": build_service("sim", file, file.robot)}
    services |= {"base_driver": driver(Section(), file.robot), "navigator": RefereedNavigator(Section(), file.robot)}
    return Referee(course, file.robot, Lockstep(services), delay).result()


def test_the_clock_starts_a_tenth_of_a_metre_off_and_ends_a_metre_before_the_goal(tmp_path):
    driven = refereed(tmp_path, ConstantDriver)
    assert driven.status == "success"
    # it drives from 1 s before the goal is sent: 8.9 m of its path count, to the next poll
    assert 8.0 <= driven.time <= 9.0
    assert driven.rows[0, 0] == 0.0
    assert_allclose(driven.rows[-1, 2], 9.0, atol=0.15)
    assert (np.diff(driven.rows[:, 0]) <= 0.0201).all()


def test_a_touch_ends_the_run_at_once(tmp_path):
    driven = refereed(tmp_path, ConstantDriver, [0.28, 5.0])
    assert driven.status == "collision"
    assert driven.score == driven.clearance == 0.0
    assert 4.5 < driven.rows[-1, 2] < 5.0
    free = refereed(tmp_path, ConstantDriver, [0.208 + 0.075 + 0.004, 5.0])
    assert free.status == "success"
    assert_allclose(free.clearance, 0.004, atol=5e-4)


def test_who_does_not_leave_the_start_has_run_out_of_time(tmp_path):
    driven = refereed(tmp_path, Slow)
    assert (driven.status, driven.time, driven.score) == ("timeout", 20.0, 0.0)
    assert_allclose(driven.rows[-1, 0], FREE_TIME, atol=0.2)


def test_what_is_told_to_the_motors_comes_later_by_the_delay(tmp_path):
    early, late = (refereed(tmp_path, ConstantDriver, [0.0, 2.0], delay=delay) for delay in (0.0, 0.5))
    assert_allclose(early.rows[0, 2] - late.rows[0, 2], 0.5, atol=0.03)  # m at 1 m/s, when the goal is sent
