# SPDX-License-Identifier: Apache-2.0
"""Registration: alignment of a scan with the map by the distances to its surfaces.

Robust ICP against a downsampled map of points, from a motion prior, as in KISS-ICP (Vizzo et al., RA-L 2023, section
III). It minimises the distance from point to line (Censi, ICRA 2008) where the map has a normal.
kiss_registration.py uses the package of KISS-ICP instead.
"""

from dataclasses import dataclass, replace
from math import atan2, cos, hypot, pi, sin, sqrt
from typing import ClassVar, Literal

import numpy as np
from numba import njit
from pydantic import Field

from services.mapper.front_end.deskew import remove_twist
from services.mapper.front_end.point_map import PointMap, nearest
from shared.config import Section
from shared.geometry import Pose2, wrapped
from shared.types import Bools, Float64s, Int64s

Registrar = Literal["line", "kiss"]


class RegistrationConfig(Section):
    """Alignment of a scan with the map."""

    registrar: Registrar = Field("line", description="line: point to line; kiss: the package kiss-icp")
    kernel: float = Field(0.2, ge=0.02, le=2, description="m, scale of the Geman-McClure kernel")
    gate: float = Field(0.6, ge=0.05, le=3, description="m, maximum distance of a correspondence at the start")
    final_gate: float = Field(0.5, ge=0.05, le=3, description="m, maximum distance of a correspondence at the end")
    noise: float = Field(0.05, ge=0.005, le=1, description="m, standard deviation of one correspondence")
    prior: float = Field(0.005, ge=0.001, le=1, description="m, standard deviation of odometry in 0.065 s, at least")
    prior_share: float = Field(0.05, ge=0, le=1, description="m a metre of the step, added to `prior`")
    prior_turn: float = Field(0.005, ge=0.0005, le=1, description="rad, of the turn in 0.065 s, at least")
    prior_turn_share: float = Field(0.1, ge=0, le=1, description="rad a radian of the turn, added to `prior_turn`")
    trust: float = Field(
        2.0, ge=0, le=100, description="ratio of the prior's standard deviation to the recent errors of odometry"
    )
    iterations: int = Field(30, ge=3, le=200, description="maximum Gauss-Newton steps")
    spacing: float = Field(0.1, ge=0.01, le=0.5, description="m, minimum distance of two points of the map")
    inlier_distance: float = Field(0.1, ge=0.01, le=1, description="m, maximum distance of an inlier from its surface")

    RENAMED: ClassVar[dict[str, str]] = {"agrees": "inlier_distance"}


MIN_DIRECTION_SHARE = 0.06  # of the information; less is noise of the normals, and clutter
MIN_MATCH_VARIANCE = 1e-9  # m^2, rad^2; less changes nothing
TWIST_SIGMA_RAD = 0.006  # of a sweep's twist about its share of the turn between two sweeps


@dataclass(frozen=True, slots=True)
class Match:
    """The pose of a scan on the map. `map` is the frame of the point map.

    information: (3, 3) of (x, y, yaw) in `map` about the pose, in m and rad, from the beams alone.
    inliers: (n,) bool, points that lie on the map's surfaces.  inlier_ratio: their share, 0..1.
    twist: rad that the robot turned during the sweep beyond the turn that de-skewing removed.
    """

    map_from_base: Pose2
    information: Float64s
    inliers: Bools
    inlier_ratio: float
    twist: float = 0.0


@dataclass(frozen=True, slots=True)
class Prior:
    """The pose expected from odometry, with the standard deviations of the last step: sigma m, sigma_turn rad.

    skew: share of the step's time that the sweep took; 0 if registration shall not estimate the sweep's twist.
    match_variance, match_turn_variance: m^2 and rad^2, of a match beyond what its beams claim; see `MatchError`.
    """

    map_from_base: Pose2
    sigma: float
    sigma_turn: float
    skew: float = 0.0
    match_variance: float = 0.0
    match_turn_variance: float = 0.0

    @property
    def information(self) -> Float64s:
        """(3, 3) of (x, y, yaw) in `map`."""
        return np.diag((self.sigma**-2, self.sigma**-2, self.sigma_turn**-2))

    def squared_sigmas(self, pose: Pose2) -> float:
        """Squared Mahalanobis distance of a pose in `map`."""
        guess = self.map_from_base
        off = np.array((pose.x - guess.x, pose.y - guess.y, wrapped(pose.yaw - guess.yaw)))
        return float(off @ self.information @ off)


class LineRegistrar:
    """Point to line where a map point has a normal, point to point elsewhere, with a weak prior.

    range_max: m, of the laser.
    """

    def __init__(self, config: RegistrationConfig, range_max: float) -> None:
        self.config = config
        self.range_max = range_max
        self.map = PointMap(config.spacing)

    def clear(self) -> None:
        """Removes all points of the map."""
        self.map.clear()

    def add_points(self, points: Float64s, normals: Float64s) -> None:
        """Adds surface points (n, 2) m with normals (n, 2), in `map`."""
        self.map.insert(points, normals)

    def remove_points(self, mask: Bools) -> None:
        """Removes the map's points of a mask (map.n,)."""
        self.map.remove(mask)

    def register(
        self, points: Float64s, normals: Float64s, start: Pose2, prior: Prior, back: Float64s | None = None
    ) -> Match:
        """The match of points (n, 2) m in `base` with normals (n, 2). The iteration begins at `start`.

        back: (n,) share of the sweep that follows each point. With it and the prior's skew, the twist is estimated too.
        """
        c = self.config
        pose, twist = _align(
            points, normals, np.zeros(len(points)) if back is None else back, _row(start), _row(prior.map_from_base),
            prior.information, prior.match_variance, prior.match_turn_variance,
            0.0 if back is None else prior.skew, c.gate, c.final_gate, c.kernel, c.noise, c.iterations, *self.map.index,
        )  # fmt: skip
        if back is not None:
            points, normals = remove_twist(back, twist, points, normals)
        match = self.evaluate(points, normals, Pose2(float(pose[0]), float(pose[1]), float(pose[2])))
        information = match.information.copy()
        _widen(information, np.zeros(3), prior.match_variance, prior.match_turn_variance)
        return replace(match, information=information, twist=float(twist))

    def evaluate(self, points: Float64s, normals: Float64s, pose: Pose2) -> Match:
        """The match of points (n, 2) m in `base` with normals (n, 2) at a pose that is not refined."""
        c = self.config
        inliers, information = _evaluate(
            points, normals, _row(pose), c.final_gate, c.kernel, c.noise, c.inlier_distance, *self.map.index
        )
        return Match(pose, information, inliers, float(inliers.mean()) if len(inliers) else 0.0)

    def correspondences(self, points: Float64s, normals: Float64s, match: Match) -> Int64s:
        """(k,) int64: the map's point of each inlier. points, normals: those of the match."""
        own, own_normals = points[match.inliers], normals[match.inliers]
        pose, gate = _row(match.map_from_base), self.config.final_gate
        return np.asarray(_correspondences(own, own_normals, pose, gate, *self.map.index))

    def are_near(self, points: Float64s, pose: Pose2, distance: float) -> Bools:
        """(n,) bool: which points (n, 2) m in `base` are within `distance` m of a map point with any normal."""
        indices = _correspondences(points, np.zeros_like(points), _row(pose), distance, *self.map.index)
        return np.asarray(indices >= 0)


def _row(pose: Pose2) -> Float64s:
    return np.array((pose.x, pose.y, pose.yaw))


@njit(cache=True, nogil=True)
def _normal_equations(  # type: ignore[no-untyped-def]  # compiled: numba finds the types
    source, directions, back, twist, pose, gate, kernel, inlier_distance, inliers, hessian, gradient, points,
    following, keys, heads,
):  # fmt: skip
    """Sums J'wJ and J'wr over all correspondences at a pose, unscaled, and marks the inliers.

    The increment is (dx, dy, dyaw, dtwist) in `map`, with rotation about the robot. J of a moved point is
    [1 0 -ry; 0 1 rx]; the column of the twist is that of the yaw, times -`back`. Weights: Geman-McClure.
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
        inliers[k] = False
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
            # a line extends past the end of its wall, so the distance to the point is bounded too
            inliers[k] = abs(r) < inlier_distance and dx * dx + dy * dy < 9.0 * inlier_distance * inlier_distance
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
            inliers[k] = d < inlier_distance * inlier_distance
    hessian[1, 0], hessian[2, 0], hessian[2, 1] = hessian[0, 1], hessian[0, 2], hessian[1, 2]


@njit(cache=True, nogil=True)
def _align(  # type: ignore[no-untyped-def]  # compiled: numba finds the types; -> pose (3,), twist
    source, directions, back, start, prior, prior_information, match_variance, match_turn_variance, skew,
    gate, final_gate, kernel, noise, iterations, points, following, keys, heads,
):  # fmt: skip
    pose, twist = start.copy(), 0.0
    hessian, gradient = np.zeros((4, 4)), np.zeros(4)
    inliers = np.zeros(len(source), np.bool_)
    scale = 1.0 / noise**2
    for n in range(iterations):
        reach = max(final_gate, gate - 0.02 * n)
        _normal_equations(
            source, directions, back, twist, pose, reach, kernel, 0.0, inliers, hessian, gradient, points, following,
            keys, heads,
        )  # fmt: skip
        off_turn = (pose[2] - prior[2] + pi) % (2 * pi) - pi
        if skew > 0.0:
            _eliminate_twist(hessian, gradient, skew, skew * off_turn - twist, 1.0 / (TWIST_SIGMA_RAD**2 * scale))
        _damp_weak_direction(hessian, gradient)
        hessian *= scale
        gradient *= scale
        _widen(hessian, gradient, match_variance, match_turn_variance)
        for a in range(3):
            x, y, turn = prior_information[a]
            hessian[a, 0] += x
            hessian[a, 1] += y
            hessian[a, 2] += turn
            gradient[a] += x * (pose[0] - prior[0]) + y * (pose[1] - prior[1]) + turn * off_turn
        step = _solve(hessian, gradient)
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
def _eliminate_twist(hessian, gradient, skew, off, weight):  # type: ignore[no-untyped-def]  # compiled; (4, 4), (4,) in place
    """Adds the prior of the twist, then eliminates it from the other three equations (Schur complement).

    The twist expected is `skew` times the turn since the last sweep, less the turn by odometry.  off: rad, expected
    twist less the present one.  weight: of that prior.  The twist's own row remains; it gives the step of the twist.
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
def _widen(hessian, gradient, variance, turn_variance):  # type: ignore[no-untyped-def]  # compiled; (3, 3), (3,) in place
    """Adds variances Q to the covariance of the beams: H becomes (H^-1 + Q)^-1, the position that they give stays.

    It is H - H (H + Q^-1)^-1 H (Woodbury), which needs no inverse of H. For `@` in place of loops numba
    would load scipy, while the robot drives.
    """
    if variance < MIN_MATCH_VARIANCE and turn_variance < MIN_MATCH_VARIANCE:
        return
    beams = hessian[:3, :3].copy()
    total = beams.copy()
    for a in range(3):
        total[a, a] += 1.0 / max(turn_variance if a == 2 else variance, MIN_MATCH_VARIANCE)
    for column in range(4):
        solved = _solve(total, gradient if column == 3 else beams[column])  # H is symmetric
        for a in range(3):
            less = beams[a, 0] * solved[0] + beams[a, 1] * solved[1] + beams[a, 2] * solved[2]
            if column == 3:
                gradient[a] -= less
            else:
                hessian[a, column] -= less


@njit(cache=True, nogil=True)
def _evaluate(  # type: ignore[no-untyped-def]  # compiled: numba finds the types
    source, directions, pose, gate, kernel, noise, inlier_distance, points, following, keys, heads
):
    hessian, gradient = np.zeros((4, 4)), np.zeros(4)
    inliers = np.zeros(len(source), np.bool_)
    _normal_equations(
        source, directions, np.zeros(len(source)), 0.0, pose, gate, kernel, inlier_distance, inliers, hessian,
        gradient, points, following, keys, heads,
    )  # fmt: skip
    _damp_weak_direction(hessian, gradient)
    return inliers, hessian[:3, :3] / noise**2


@njit(cache=True, nogil=True)
def _correspondences(source, directions, pose, gate, points, following, keys, heads):  # type: ignore[no-untyped-def]  # compiled; -> (k,) int64
    indices = np.empty(len(source), np.int64)
    c, s = cos(pose[2]), sin(pose[2])
    for k in range(len(source)):
        x, y = pose[0] + c * source[k, 0] - s * source[k, 1], pose[1] + s * source[k, 0] + c * source[k, 1]
        nx, ny = c * directions[k, 0] - s * directions[k, 1], s * directions[k, 0] + c * directions[k, 1]
        indices[k], _ = nearest(x, y, nx, ny, gate, points, following, keys, heads)
    return indices


@njit(cache=True, nogil=True)
def _damp_weak_direction(hessian, gradient):  # type: ignore[no-untyped-def]  # compiled; (3, 3), (3,) in place
    """Reduces the information of the weaker direction of translation, so that the prior decides there.

    A soft form of solution remapping: Zhang et al., "On degeneracy of optimization-based state estimation problems",
    ICRA 2016. The position that the beams give along this direction stays. Its weight falls with the share of the
    information under MIN_DIRECTION_SHARE.
    """
    if hessian[2, 2] <= 0.0:
        return
    # information of x and y with the yaw eliminated (Schur complement), and its weaker direction
    bx, by, d = hessian[0, 2], hessian[1, 2], hessian[2, 2]
    xx, xy, yy = hessian[0, 0] - bx * bx / d, hessian[0, 1] - bx * by / d, hessian[1, 1] - by * by / d
    half = 0.5 * (xx - yy)
    weak = 0.5 * (xx + yy) - sqrt(half * half + xy * xy)
    angle = 0.5 * atan2(2.0 * xy, xx - yy) + 0.5 * pi
    vx, vy = cos(angle), sin(angle)
    doubtful = MIN_DIRECTION_SHARE * (hessian[0, 0] + hessian[1, 1])
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
def _solve(a, b):  # type: ignore[no-untyped-def]  # compiled; (3, 3) symmetric positive definite, (3,) -> (3,), by Cramer's rule
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
