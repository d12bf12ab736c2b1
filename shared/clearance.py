# SPDX-License-Identifier: Apache-2.0
"""How much room around the robot's circles a path keeps."""


def kept_free(margin: float, resolution: float) -> float:
    """m around the footprint's circles: the margin, and by how much cells of this size, m, hide more than 5 cm do.

    How far a path is from an obstacle is known from cell's centre to cell's centre, to half a diagonal at either end:
    1.4 cells, which the margin covers with cells of 5 cm.
    """
    return margin + 1.4 * max(resolution - 0.05, 0.0)
