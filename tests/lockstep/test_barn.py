# SPDX-License-Identifier: Apache-2.0
"""Six worlds of the BARN challenge, from roomy to narrow: the stack gets through each, in time, without a touch."""

import json
import os
from pathlib import Path

import numpy as np
import pytest

from services.sim.world_loader import read_cylinder_file
from zenav.bench.barn_run import BarnFile, Driven, Trial, course_of, run

DATA = os.environ.get("ZENAV_DATA")  # noqa: TID251
WORLDS = Path(DATA or "") / "barn" / "barn_worlds.json.gz"
ROOM = 0.02  # m that must be left to the nearest cylinder
CHEAP = ("robot.laser.rate=20", "local_ctrl.mppi.rollouts=600")  # of 50 and 1200: half the time, and no easier


def driven(world: str, seed: int, folder: Path) -> Driven:
    file = read_cylinder_file(WORLDS, BarnFile)
    path = folder / "one.json"  # a file of one world: reading all 250 takes a tenth of a run
    path.write_text(json.dumps(file.model_dump(include={*type(file).model_fields} - {"worlds"}) | {
        "worlds": {world: file.worlds[world].model_dump()}
    }))  # fmt: skip
    return run(Trial(course_of(path, file, world), seed, "jackal", CHEAP))


@pytest.mark.skipif(not WORLDS.is_file(), reason="ZENAV_DATA names no folder with barn/barn_worlds.json.gz")
@pytest.mark.parametrize("world", ["1", "163", "242", "275", "287", "299"])
def test_the_stack_gets_through_a_cluttered_world(world, tmp_path):
    done = driven(world, 0, tmp_path)
    assert done.status == "success", done.why
    assert done.score == 0.5
    assert done.clearance > ROOM
    assert done.rows[-1, 0] < done.course.optimal_length  # s: faster than 1 m/s on the reference path
    assert np.hypot(*(done.rows[-1, 1:3] - done.course.goal)) <= done.course.goal_radius
