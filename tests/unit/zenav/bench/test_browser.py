# SPDX-License-Identifier: Apache-2.0
"""The page in a browser: its limits, and the map that it is measured with."""

import numpy as np
import pytest

from shared import topics
from shared.codec import Envelope, decode, encode
from shared.messages import TILE_CELLS
from zenav.bench.browser import MAX_PSS_MB, MIN_FRAMES_PER_S, figures
from zenav.bench.published_robot import PART, building

SMALL = {"frames_per_s": 1.0, "pss_mb": 1e6}


@pytest.mark.parametrize(
    ("frames", "pss", "kept"),
    [
        (MIN_FRAMES_PER_S, MAX_PSS_MB, True),
        (MIN_FRAMES_PER_S - 1, MAX_PSS_MB, False),
        (MIN_FRAMES_PER_S, MAX_PSS_MB + 1, False),
    ],
)
def test_the_limits_are_those_of_the_largest_map(frames, pss, kept):
    assert figures({"small": SMALL, "large": {"frames_per_s": frames, "pss_mb": pss}})["kept"] is kept


def test_a_part_of_the_map_is_a_valid_message_and_its_rooms_have_doors():
    tiles = 31
    whole = building(tiles)
    assert len({*zip(whole.rows.tolist(), whole.columns.tolist())}) == tiles**2
    part = whole.only(np.arange(tiles**2) < PART)
    read, _ = decode(topics.MAP.type, encode(part, Envelope("mapper", "a", 0, 1)))
    assert np.array_equal(read.cells, whole.cells[:PART])
    cells = whole.cells.reshape(tiles, tiles, TILE_CELLS, TILE_CELLS).swapaxes(1, 2).reshape(tiles * TILE_CELLS, -1)
    wall, inside = cells[96], cells[48 + 24]
    assert (wall == 100).mean() > 0.7
    assert (wall[96 + 40 : 96 + 56] == 100).mean() < 0.2, "a door"
    assert (inside == 100).mean() < 0.1
