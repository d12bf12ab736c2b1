# SPDX-License-Identifier: Apache-2.0
"""Four worlds of the BARN challenge, from roomy to narrow: the stack gets through each, in time, without a touch.

And the pose of a noisy robot with a fast laser, where thin cylinders are all there is to see.
"""

import json
import os
from pathlib import Path

import numpy as np
import pytest

from services.sim.world_loader import read_cylinder_file
from shared import topics
from shared.messages import PoseEstimate
from shared.runners.lockstep import START, Lockstep
from zenav.bench.barn_run import BarnFile, BarnTrial, Referee, barn_robot_file, course_of, run_barn
from zenav.scenario.lockstep_run import RECORDER
from zenav.stack.hardware import Hardware, services_for
from zenav.stack.service_loader import build_service

DATA = os.environ.get("ZENAV_DATA")  # noqa: TID251
WORLDS = Path(DATA or "") / "barn" / "barn_worlds.json.gz"
ROOM = 0.02  # m that must be left to the nearest cylinder
CHEAP = ("robot.laser.rate=20", "local_ctrl.mppi.rollouts=600")  # of 50 and 1200: half the time
NOISY = ("sim.laser.sigma=0.02", "sim.laser.dropout=0.01", "sim.drive.size_error=0.05")
DELAY = 0.05  # s, of the motors' commands
RUNAWAY = 0.6  # m from the truth, at most; a drive among posts is chaotic, and seeds 1 to 3 gave up to 0.50


def trial(world: str, seed: int, folder: Path, settings: tuple[str, ...], delay: float = 0.0) -> BarnTrial:
    file = read_cylinder_file(WORLDS, BarnFile)
    path = folder / "one.json"  # a file of one world: reading all 250 takes a tenth of a run
    path.write_text(json.dumps(file.model_dump(include={*type(file).model_fields} - {"worlds"}) | {
        "worlds": {world: file.worlds[world].model_dump()}
    }))  # fmt: skip
    return BarnTrial(course_of(path, file, world), seed, "jackal", settings, delay)


@pytest.mark.skipif(not WORLDS.is_file(), reason="ZENAV_DATA names no folder with barn/barn_worlds.json.gz")
@pytest.mark.parametrize("world", ["1", "242", "275", "299"])
def test_the_stack_gets_through_a_cluttered_world(world, tmp_path):
    done = run_barn(trial(world, 0, tmp_path, CHEAP))
    assert done.status == "success", done.why
    assert done.score == 0.5
    assert done.clearance > ROOM
    assert done.rows[-1, 0] < done.course.optimal_length  # s: faster than 1 m/s on the reference path
    assert np.hypot(*(done.rows[-1, 1:3] - done.course.goal)) <= done.course.goal_radius


@pytest.mark.skipif(not WORLDS.is_file(), reason="ZENAV_DATA names no folder with barn/barn_worlds.json.gz")
def test_noise_at_50_hz_does_not_take_the_pose_away_among_thin_cylinders(tmp_path):
    """World 242 with seed 1, which was 0.79 m off when motions were compared over one step of 50 Hz.

    Today's drive is also good with that comparison. So this test shows that the regime works. The fault itself is seen
    by tests/unit/services/mapper/front_end/test_odometry_error.py, which fails with a shorter comparison.
    """
    assert largest_error(1, tmp_path) < RUNAWAY


def largest_error(seed: int, folder: Path) -> float:
    """m between the pose and the truth, at most, in a run that succeeds."""
    noisy = trial("242", seed, folder, NOISY, DELAY)
    file = barn_robot_file(noisy)
    names = [name for name in services_for(Hardware.MESSAGES, file) if name != RECORDER]
    lockstep = Lockstep({name: build_service(name, file, file.robot) for name in names})
    estimates: list[PoseEstimate] = []
    lockstep.watch(topics.POSE.key, estimates.append)
    referee = Referee(noisy.course, file.robot, lockstep, noisy.delay)
    done = referee.result()
    assert done.status == "success", done.why
    times, xs, ys = np.array(referee.rows)[:, :3].T
    stamps = np.array([(estimate.stamp - START) / 1e9 for estimate in estimates])
    places = [noisy.course.start @ estimate.map_from_base for estimate in estimates]
    away = np.hypot(
        [p.x for p in places] - np.interp(stamps, times, xs), [p.y for p in places] - np.interp(stamps, times, ys)
    )
    return float(away.max())
