# SPDX-License-Identifier: Apache-2.0
"""How a scan is aligned with the map, by distances to its surfaces.

As KISS-ICP (Vizzo et al., RA-L 2023): robust ICP against a thinned map of points from a motion prior. It minimises the
distance to the surfaces (Censi, ICRA 2008) where the map knows their direction. kiss_registration has the package.
"""

from dataclasses import dataclass, replace
from math import atan2, cos, hypot, pi, sin, sqrt
from typing import Literal

import numpy as np
from numba import njit
from numpy.typing import NDArray
from pydantic import Field

from services.mapper.deskew import turned_back
from services.mapper.point_map import PointMap, nearest
from shared.config import Section
from shared.geometry import Pose2

Float64s = NDArray[np.float64]
Int64s = NDArray[np.int64]
Bools = NDArray[np.bool_]


Registrar = Literal["line", "kiss"]


class RegistrationConfig(Section):
    """Alignment of a scan with the map."""

    registrar: Registrar = Field("line", description="line (point to line, ours) or kiss (the package)")
    kernel: float = Field(0.2, ge=0.02, le=2, description="m, scale of the Geman-McClure kernel")
    gate: float = Field(0.6, ge=0.05, le=3, description="m, farthest match at the start")
    final_gate: float = Field(0.5, ge=0.05, le=3, description="m, farthest match at the end")
    noise: float = Field(0.05, ge=0.005, le=1, description="m, one match's standard deviation")
    prior: float = Field(0.005, ge=0.001, le=1, description="m, standard deviation of odometry in 0.065 s, at least")
    prior_share: float = Field(0.05, ge=0, le=1, description="m a metre of the step, added to `prior`")
    prior_turn: float = Field(0.005, ge=0.0005, le=1, description="rad, of the turn in 0.065 s, at least")
    prior_turn_share: float = Field(0.1, ge=0, le=1, description="rad a radian of the turn, added to `prior_turn`")
    trust: float = Field(2.0, ge=0, le=100, description="prior's standard deviation over odometry's errors of late")
    iterations: int = Field(30, ge=3, le=200, description="Gauss-Newton steps at most")
    spacing: float = Field(0.1, ge=0.01, le=0.5, description="m between the map's points")
    agrees: float = Field(0.1, ge=0.01, le=1, description="m from the map's surface up to which a beam agrees with it")


SHARE = 0.06  # of the beams, under which they say little about a direction: noise of the normals, clutter
TWIST = 0.006  # rad, standard deviation of a sweep's twist about its share of the turn between two sweeps


@dataclass(frozen=True, slots=True)
class Match:
    """A scan's place on the map. information: (3, 3) of (x, y, yaw) in `map` about the pose, from the beams alone.

    agree: (n,) bool, which points lie on the map's surfaces.  share: of them, 0..1.  twist: rad that the robot turned
    during the sweep beyond what it was de-skewed with.
    """

    map_from_base: Pose2
    information: Float64s
    agree: Bools
    share: float
    twist: float = 0.0


@dataclass(frozen=True, slots=True)
class Prior:
    """Where odometry says that the robot is, with the standard deviations of the step that led there (m, rad).

    skew: share of the step that the sweep took and was de-skewed by; 0 where no more is to be learnt of it.
    """

    map_from_base: Pose2
    sigma: float
    sigma_turn: float
    skew: float = 0.0


class LineRegistrar:
    """Point to line where a map point has a normal, point to point elsewhere, with a weak prior."""

    def __init__(self, config: RegistrationConfig, range_max: float) -> None:
        self.config = config
        self.range_max = range_max
        self.map = PointMap(config.spacing)

    def clear(self) -> None:
        """Forgets the map."""
        self.map.clear()

    def extend(self, points: Float64s, normals: Float64s) -> None:
        """Adds surface points (n, 2) m with normals (n, 2), in `map`."""
        self.map.insert(points, normals)

    def forget(self, gone: Bools) -> None:
        """Nothing is matched again with these of the map's points, (n,)."""
        self.map.forget(gone)

    def register(
        self, points: Float64s, normals: Float64s, start: Pose2, prior: Prior, back: Float64s | None = None
    ) -> Match:
        """Aligns points (n, 2) m in `base`, with normals, beginning at `start`.

        back: (n,), share of the sweep from a point to its end; with the prior's skew, the sweep's twist is found too.
        """
        c = self.config
        pose, twist = _aligned(
            points, normals, np.zeros(len(points)) if back is None else back, _row(start), _row(prior.map_from_base),
            prior.sigma, prior.sigma_turn, 0.0 if back is None else prior.skew,
            c.gate, c.final_gate, c.kernel, c.noise, c.iterations, *self.map.index,
        )  # fmt: skip
        if back is not None:
            points, normals = turned_back(points, back, twist), turned_back(normals, back, twist)
        match = self.measured(points, normals, Pose2(float(pose[0]), float(pose[1]), float(pose[2])))
        return replace(match, twist=float(twist))

    def measured(self, points: Float64s, normals: Float64s, pose: Pose2) -> Match:
        """How well the points fit the map at a pose, without moving it."""
        c = self.config
        agree, information = _measured(
            points, normals, _row(pose), c.final_gate, c.kernel, c.noise, c.agrees, *self.map.index
        )
        return Match(pose, information, agree, float(agree.mean()) if len(agree) else 0.0)

    def found(self, points: Float64s, normals: Float64s, match: Match) -> Int64s:
        """(k,): the map's points that those of a scan which agree were found to be."""
        agree = match.agree
        return np.asarray(
            _found(points[agree], normals[agree], _row(match.map_from_base), self.config.final_gate, *self.map.index)
        )


def _row(pose: Pose2) -> Float64s:
    return np.array((pose.x, pose.y, pose.yaw))


@njit(cache=True, nogil=True)
def _normal_equations(  # type: ignore[no-untyped-def]  # compiled: numba finds the types
    source, directions, back, twist, pose, gate, kernel, agrees, agree, hessian, gradient, points, following, keys,
    heads,
):  # fmt: skip
    """Sums J'wJ and J'wr over all matches at a pose, unscaled; marks the points that agree.

    The increment is (dx, dy, dyaw, dtwist) in `map`, turning about the robot: J of a moved point is [1 0 -ry; 0 1 rx],
    and that of the twist is the turn's, -`back` times.
    """
    hessian[:] = 0.0
    gradient[:] = 0.0
    c, s = cos(pose[2]), sin(pose[2])
    for k in range(len(source)):
        if twist != 0.0:
            c, s = cos(pose[2] - back[k] * twist), sin(pose[2] - back[k] * twist)
        rx = c * source[k, 0] - s * source[k, 1]
        ry = s * source[k, 0] + c * source[k, 1]
        nx = c * directions[k, 0] - s * directions[k, 1]
        ny = s * directions[k, 0] + c * directions[k, 1]
        i, _ = nearest(pose[0] + rx, pose[1] + ry, nx, ny, gate, points, following, keys, heads)
        agree[k] = False
        if i < 0:
            continue
        dx, dy = pose[0] + rx - points[i, 0], pose[1] + ry - points[i, 1]
        mx, my = points[i, 2], points[i, 3]
        if mx == 0.0 and my == 0.0:
            mx, my = nx, ny
        if mx != 0.0 or my != 0.0:
            r = dx * mx + dy * my
            w = 1.0 / (1.0 + (r / kernel) ** 2) ** 2
            turn = mx * -ry + my * rx
            hessian[0, 0] += w * mx * mx
            hessian[0, 1] += w * mx * my
            hessian[1, 1] += w * my * my
            hessian[0, 2] += w * mx * turn
            hessian[1, 2] += w * my * turn
            hessian[2, 2] += w * turn * turn
            gradient[0] += w * r * mx
            gradient[1] += w * r * my
            gradient[2] += w * r * turn
            if back[k] != 0.0:
                early = -back[k] * turn
                hessian[0, 3] += w * mx * early
                hessian[1, 3] += w * my * early
                hessian[2, 3] += w * turn * early
                hessian[3, 3] += w * early * early
                gradient[3] += w * r * early
            # beside the end of a wall the line goes on where the wall does not
            agree[k] = abs(r) < agrees and dx * dx + dy * dy < 9.0 * agrees * agrees
        else:
            d = dx * dx + dy * dy
            w = 1.0 / (1.0 + d / kernel**2) ** 2
            hessian[0, 0] += w
            hessian[1, 1] += w
            hessian[0, 2] -= w * ry
            hessian[1, 2] += w * rx
            hessian[2, 2] += w * (rx * rx + ry * ry)
            gradient[0] += w * dx
            gradient[1] += w * dy
            gradient[2] += w * (rx * dy - ry * dx)
            if back[k] != 0.0:
                hessian[0, 3] += w * ry * back[k]
                hessian[1, 3] -= w * rx * back[k]
                hessian[2, 3] -= w * (rx * rx + ry * ry) * back[k]
                hessian[3, 3] += w * (rx * rx + ry * ry) * back[k] * back[k]
                gradient[3] -= w * (rx * dy - ry * dx) * back[k]
            agree[k] = d < agrees * agrees
    hessian[1, 0], hessian[2, 0], hessian[2, 1] = hessian[0, 1], hessian[0, 2], hessian[1, 2]


@njit(cache=True, nogil=True)
def _aligned(  # type: ignore[no-untyped-def]  # compiled: numba finds the types; -> pose (3,), twist
    source, directions, back, start, prior, sigma, sigma_turn, skew, gate, final_gate, kernel, noise, iterations,
    points, following, keys, heads,
):  # fmt: skip
    pose, twist = start.copy(), 0.0
    hessian, gradient = np.zeros((4, 4)), np.zeros(4)
    agree = np.zeros(len(source), np.bool_)
    scale = 1.0 / noise**2
    for n in range(iterations):
        reach = max(final_gate, gate - 0.02 * n)
        _normal_equations(
            source, directions, back, twist, pose, reach, kernel, 0.0, agree, hessian, gradient, points, following,
            keys, heads,
        )  # fmt: skip
        turned = (pose[2] - prior[2] + pi) % (2 * pi) - pi
        if skew > 0.0:
            _couple(hessian, gradient, skew, skew * turned - twist, 1.0 / (TWIST**2 * scale))
        _temper(hessian, gradient)
        hessian *= scale
        gradient *= scale
        hessian[0, 0] += 1.0 / sigma**2
        hessian[1, 1] += 1.0 / sigma**2
        hessian[2, 2] += 1.0 / sigma_turn**2
        gradient[0] += (pose[0] - prior[0]) / sigma**2
        gradient[1] += (pose[1] - prior[1]) / sigma**2
        gradient[2] += turned / sigma_turn**2
        step = _solved(hessian, gradient)
        pose -= step
        if skew > 0.0:
            twist -= (
                gradient[3] - hessian[0, 3] * step[0] - hessian[1, 3] * step[1] - hessian[2, 3] * step[2]
            ) / hessian[3, 3]
        if hypot(step[0], step[1]) < 1e-4 and abs(step[2]) < 1e-5:
            break
    pose[2] = (pose[2] + pi) % (2 * pi) - pi
    return pose, twist


@njit(cache=True, nogil=True)
def _couple(hessian, gradient, skew, off, weight):  # type: ignore[no-untyped-def]  # compiled; (4, 4), (4,) in place
    """Ties the twist to the turn since the last sweep, less odometry's, and takes it out of the others' equations.

    off: rad, what it should be less what it is.  What is left of its own row gives the twist's step from the others'.
    """
    hessian[2, 2] += weight * skew * skew
    hessian[2, 3] -= weight * skew
    hessian[3, 3] += weight
    gradient[2] += weight * skew * off
    gradient[3] -= weight * off
    own = hessian[3, 3]
    for a in range(3):
        for b in range(3):
            hessian[a, b] -= hessian[a, 3] * hessian[b, 3] / own
        gradient[a] -= hessian[a, 3] * gradient[3] / own


@njit(cache=True, nogil=True)
def _measured(  # type: ignore[no-untyped-def]  # compiled: numba finds the types
    source, directions, pose, gate, kernel, noise, agrees, points, following, keys, heads
):
    hessian, gradient = np.zeros((4, 4)), np.zeros(4)
    agree = np.zeros(len(source), np.bool_)
    _normal_equations(
        source, directions, np.zeros(len(source)), 0.0, pose, gate, kernel, agrees, agree, hessian, gradient, points,
        following, keys, heads,
    )  # fmt: skip
    _temper(hessian, gradient)
    return agree, hessian[:3, :3] / noise**2


@njit(cache=True, nogil=True)
def _found(source, directions, pose, gate, points, following, keys, heads):  # type: ignore[no-untyped-def]  # compiled; -> (k,) int64
    found = np.empty(len(source), np.int64)
    c, s = cos(pose[2]), sin(pose[2])
    for k in range(len(source)):
        x, y = pose[0] + c * source[k, 0] - s * source[k, 1], pose[1] + s * source[k, 0] + c * source[k, 1]
        nx, ny = c * directions[k, 0] - s * directions[k, 1], s * directions[k, 0] + c * directions[k, 1]
        found[k], _ = nearest(x, y, nx, ny, gate, points, following, keys, heads)
    return found


@njit(cache=True, nogil=True)
def _temper(hessian, gradient):  # type: ignore[no-untyped-def]  # compiled; (3, 3), (3,) in place
    """Takes its say from the direction of travel that hardly any beam speaks for, where the prior is to decide.

    Zhang et al., "On degeneracy of optimization-based state estimation problems", ICRA 2016, softly: where the beams
    place the robot along the weaker direction stays the same, how firmly they do falls off under a share of them.
    """
    if hessian[2, 2] <= 0.0:
        return
    # what is known of x and y where the heading follows (Schur complement), and its weaker direction
    bx, by, d = hessian[0, 2], hessian[1, 2], hessian[2, 2]
    xx, xy, yy = hessian[0, 0] - bx * bx / d, hessian[0, 1] - bx * by / d, hessian[1, 1] - by * by / d
    half = 0.5 * (xx - yy)
    weak = 0.5 * (xx + yy) - sqrt(half * half + xy * xy)
    angle = 0.5 * atan2(2.0 * xy, xx - yy) + 0.5 * pi
    vx, vy = cos(angle), sin(angle)
    doubtful = SHARE * (hessian[0, 0] + hessian[1, 1])
    if weak <= 0.0 or doubtful <= 0.0:
        return
    less = weak * doubtful**2 / (weak**2 + doubtful**2)
    along = -(vx * (gradient[0] - bx * gradient[2] / d) + vy * (gradient[1] - by * gradient[2] / d)) / weak
    hessian[0, 0] -= less * vx * vx
    hessian[0, 1] -= less * vx * vy
    hessian[1, 0] -= less * vx * vy
    hessian[1, 1] -= less * vy * vy
    gradient[0] += less * along * vx
    gradient[1] += less * along * vy


@njit(cache=True, nogil=True)
def _solved(a, b):  # type: ignore[no-untyped-def]  # compiled; (3, 3) symmetric positive definite, (3,) -> (3,), by Cramer's rule
    c00 = a[1, 1] * a[2, 2] - a[1, 2] * a[2, 1]
    c01 = a[1, 2] * a[2, 0] - a[1, 0] * a[2, 2]
    c02 = a[1, 0] * a[2, 1] - a[1, 1] * a[2, 0]
    det = a[0, 0] * c00 + a[0, 1] * c01 + a[0, 2] * c02
    out = np.empty(3)
    out[0] = (
        b[0] * c00 + a[0, 1] * (a[1, 2] * b[2] - b[1] * a[2, 2]) + a[0, 2] * (b[1] * a[2, 1] - a[1, 1] * b[2])
    ) / det
    out[1] = (
        a[0, 0] * (b[1] * a[2, 2] - a[1, 2] * b[2]) + b[0] * c01 + a[0, 2] * (a[1, 0] * b[2] - b[1] * a[2, 0])
    ) / det
    out[2] = (
        a[0, 0] * (a[1, 1] * b[2] - b[1] * a[2, 1]) + a[0, 1] * (b[1] * a[2, 0] - a[1, 0] * b[2]) + b[0] * c02
    ) / det
    return out
