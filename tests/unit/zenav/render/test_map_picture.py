# SPDX-License-Identifier: Apache-2.0
"""The way on a map's picture: one line for each drive."""

from io import BytesIO

import numpy as np
import pytest
from PIL import Image

from shared.grid import OccupancyGrid
from tests.unit.services.maps import message
from zenav.maps.saved_map import with_gaps
from zenav.render.map_picture import WAY, map_picture

S = 10**9
FIRST, SECOND = np.array([[0.5, 0.5, 0.0], [2.0, 0.5, 0.0]]), np.array([[2.0, 2.5, 0.0], [0.5, 2.5, 0.0]])


def n_red(poses):
    grid = OccupancyGrid()
    grid.apply(message(np.zeros((64, 64), np.int8)))
    pixels = np.asarray(Image.open(BytesIO(map_picture(grid, poses))).convert("RGB"))
    return int((pixels == WAY).all(axis=2).sum())


@pytest.mark.parametrize(
    ("stamps", "is_one_drive"),
    [
        ((0, 2 * S, 4 * S, 6 * S), True),
        ((5 * S, 7 * S, 4 * S, 6 * S), False),  # another robot, at the same time
        ((0, 2 * S, 2 * S + S // 10, 4 * S), False),  # 2 m in a tenth of a second
    ],
)
def test_no_line_is_drawn_from_one_drive_to_the_next(stamps, is_one_drive):
    poses = with_gaps(np.concatenate((FIRST, SECOND)), stamps)
    assert len(poses) == 4 + (not is_one_drive)
    both = n_red(FIRST) + n_red(SECOND)
    assert (n_red(poses) > 1.2 * both) is is_one_drive


def test_no_way_at_all_is_drawn_for_no_pose():
    assert n_red(with_gaps(np.zeros((0, 3)), ())) == 0
