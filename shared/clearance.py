# SPDX-License-Identifier: Apache-2.0
"""Clearance of a path around the circles of the footprint.

The bound is our own, from the geometry of square cells.
"""


def required_clearance(margin: float, resolution: float) -> float:
    """Clearance (m) around the footprint's circles: the margin (m), and an addition for cells larger than 5 cm.

    resolution: m a cell. A distance between cell centres is uncertain by half a diagonal at both ends: 1.4 cells. With
    cells of 5 cm the margin covers that.
    """
    return margin + 1.4 * max(resolution - 0.05, 0.0)
