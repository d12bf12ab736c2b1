# SPDX-License-Identifier: Apache-2.0
import numpy as np
import pytest

from services.mapper.front_end.correlative_match import SearchConfig, candidate_poses, window_scores
from services.mapper.front_end.point_map import nearest
from shared.geometry import Pose2, wrapped
from tests.unit.services.mapper.front_end.test_registration import mapped, points_at
from tests.unit.services.mapper.rooms import ROOM


@pytest.mark.parametrize("true", [Pose2(0.42, -0.3, 0.28), Pose2(-0.38, 0.2, -0.3), Pose2(0, 0, 0)])
def test_the_best_candidate_lies_within_a_step_of_the_truth(true):
    points, _ = points_at(ROOM, true, n=180)
    config = SearchConfig()
    best = candidate_poses(points, mapped(ROOM).map, Pose2(), config)[0]
    assert abs(best.x - true.x) <= config.step
    assert abs(best.y - true.y) <= config.step
    assert abs(wrapped(best.yaw - true.yaw)) <= config.turn_step


def test_a_score_is_the_mean_over_beams_of_the_nearness_to_the_map():
    """Brute force at the centre of the window, where beams fall on the picture's own cells."""
    map_ = mapped(ROOM).map
    points = np.round(points_at(ROOM, Pose2(), n=60)[0], 1)
    scores = window_scores(points, (0.0, 0.0, 0.0), 1, 0, 0.1, 0.05, *map_.index)
    values = []
    for x, y in points:
        i, d = nearest(x, y, 0.0, 0.0, 0.2, *map_.index)
        values.append(max(1 - np.sqrt(d) / 0.2, 0) if i >= 0 else 0)
    assert scores[1, 1, 0] == pytest.approx(np.mean(values), abs=1e-6)


def test_where_nothing_matches_there_is_no_candidate():
    map_ = mapped(ROOM).map
    assert candidate_poses(points_at(ROOM, Pose2())[0], map_, Pose2(100, 0, 0), SearchConfig()) == []
    assert candidate_poses(np.zeros((0, 2)), map_, Pose2(), SearchConfig()) == []
