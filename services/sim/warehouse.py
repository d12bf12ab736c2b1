# SPDX-License-Identifier: Apache-2.0
"""A warehouse of 40 x 60 m as the tree of a world's YAML: rows of racks, and a hall behind two doors.

Aisles are in turn wide enough for one robot and for two. The layout is our own.
"""

from typing import Any

WIDTH, LENGTH = 40.0, 60.0  # m
RACK_DEPTH, NARROW_AISLE, WIDE_AISLE = 1.0, 1.3, 2.4  # m
FIRST_RACK_X, N_PAIRS = 2.5, 6  # of racks with a narrow aisle between them
BLOCKS = (4.0, 16.0), (19.0, 31.0), (34.0, 45.0)  # m along the warehouse; aisles across lie between them
BAY, GAP = 2.2, 0.25  # m of a rack's bay, and between two bays
HALL_WALL_Y, DOOR_XS, DOOR = 48.0, (10.0, 30.0), 1.0  # m


def warehouse() -> dict[str, Any]:
    """The tree of the world's YAML, with every value plain."""
    boxes = [
        {"x": round(x + RACK_DEPTH / 2, 3), "y": round(y + length / 2, 3), "size": [RACK_DEPTH, round(length, 3)]}
        for x in _rack_xs()
        for low, high in BLOCKS
        for y, length in _bays(low, high)
    ]
    boxes += [{"x": x, "y": 54.0, "size": [1.2, 0.8]} for x in (6.0, 14.0, 22.0, 33.0)]  # pallets in the hall
    return {
        "about": "A warehouse of 40 x 60 m.",
        "start": {"x": 6.0, "y": 2.0, "yaw_deg": 90.0},
        "walls": [
            {"points": [[0.0, 0.0], [WIDTH, 0.0], [WIDTH, LENGTH], [0.0, LENGTH]], "closed": True},
            *({"points": [[a, HALL_WALL_Y], [b, HALL_WALL_Y]]} for a, b in _between_doors()),
        ],
        "boxes": boxes,
        "goals": [{"name": "hall", "x": 20.0, "y": 57.0}, {"name": "racks", "x": 20.0, "y": 17.5}],
    }


def _rack_xs() -> list[float]:
    """m: the left side of each rack."""
    xs, x = [], FIRST_RACK_X
    for _ in range(N_PAIRS):
        xs += [x, x + RACK_DEPTH + NARROW_AISLE]
        x += 2 * RACK_DEPTH + NARROW_AISLE + WIDE_AISLE
    return xs


def _bays(low: float, high: float) -> list[tuple[float, float]]:
    """m: begin and length of each bay of a rack."""
    n = int((high - low + GAP) / (BAY + GAP))
    return [(low + i * (BAY + GAP), BAY) for i in range(n)]


def _between_doors() -> list[tuple[float, float]]:
    """m: begin and end of the pieces of the hall's wall."""
    ends = [0.0, *(x + side * DOOR / 2 for x in DOOR_XS for side in (-1, 1)), WIDTH]
    return list(zip(ends[::2], ends[1::2], strict=True))
