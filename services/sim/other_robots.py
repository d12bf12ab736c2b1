# SPDX-License-Identifier: Apache-2.0
"""Other robots in this robot's world: discs that come from outside, which the laser sees and the body touches.

Each robot has a simulator of its own. What moves all of them shows each one where the others are.
"""

from math import ceil, hypot, inf

import numpy as np

from services.sim.contact import offset_polygon, transform_polygon
from services.sim.people import PAUSE, RADIUS, People, X, Y
from shared.geometry import Pose2
from shared.messages import RobotDiscs
from shared.polygon import signed_distances
from shared.polygon_kernels import distance_to_polygon
from shared.types import Float64s

FAR_M = 1e5  # where the discs are that no robot has
DISC_M = 0.06  # radius of the discs along an outline: they leave 1 cm of it open
TOUCH_M = 0.0005  # m: a disc ends so far from the body that it would enter; nearer than dynamics.CONTACT_M


def with_discs(people: People, n: int) -> People:
    """The people, and below them n discs that stand still far away."""
    p, k = people.routes.shape[:2]
    state = np.zeros((p + n, people.state.shape[1]))
    state[:p] = people.state
    state[p:, [X, Y]], state[p:, PAUSE] = FAR_M, inf
    return people._replace(
        state=state,
        routes=np.concatenate((people.routes, np.zeros((n, k, 2)))),
        lengths=np.concatenate((people.lengths, np.ones(n, np.int64))),
        speeds=np.concatenate((people.speeds, np.zeros(n))),
        pauses=np.concatenate((people.pauses, np.zeros((n, people.pauses.shape[1])))),
        n_pauses=np.concatenate((people.n_pauses, np.zeros(n, np.int64))),
    )


def place_discs(rows: Float64s, others: RobotDiscs, corners: Float64s, pose: Float64s) -> None:
    """Puts the other robots into the rows (n, 10) of `with_discs`; what has no row is left out.

    corners: (k, 2) m, this robot's footprint in `base`.  pose: (3,) x, y, yaw of this robot, m, rad. The other robot
    moves between two messages, so a disc may come out inside the body. It then only touches it.
    """
    body = transform_polygon(corners, pose[0], pose[1], pose[2])
    rows[:, [X, Y]], rows[:, RADIUS] = FAR_M, 0.0
    for row, x, y, radius in zip(rows, others.x, others.y, others.radius, strict=False):
        row[X], row[Y] = x, y
        row[RADIUS] = min(float(radius), max(distance_to_polygon(body, float(x), float(y)) - TOUCH_M, 0.0))


def footprint_discs(corners: Float64s) -> Float64s:
    """(n, 3) x, y, radius, m: discs inside a convex footprint (k, 2) in `base`, along its outline and in its middle."""
    middle = corners.mean(axis=0)
    inner = -float(signed_distances(corners, middle[None])[0])
    radius = min(DISC_M, inner / 2.0)
    discs = [(*middle, inner)]
    inset = offset_polygon(corners, -radius)
    for a, b in zip(inset, np.roll(inset, -1, axis=0), strict=True):
        steps = max(1, ceil(hypot(*(b - a)) / radius))
        discs += [(*(a + i / steps * (b - a)), radius) for i in range(steps)]
    return np.array(discs)


def discs_at(discs: Float64s, pose: Pose2) -> Float64s:
    """(n, 3) discs in `base`, in the world."""
    return np.column_stack((transform_polygon(discs[:, :2], pose.x, pose.y, pose.yaw), discs[:, 2]))
