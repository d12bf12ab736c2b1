# SPDX-License-Identifier: Apache-2.0
"""Which wheels, and which laser mount, make the wheels' motion and the laser's motion agree? All six numbers together.

Source: Censi, Franchi, Marchionni, Oriolo 2013, "Simultaneous calibration of odometry and sensor parameters for mobile
robots". Its closed form gives the initial values. Robust least squares, weighted by each motion's own uncertainty,
gives the result.
"""

from dataclasses import dataclass
from math import hypot, pi, radians, sqrt

import numpy as np
from numpy.typing import NDArray

from shared.config import UserError
from shared.geometry import wrapped
from shared.types import Bools, Float64s
from zenav.calibrate.rolling import WheelGeometry, WheelTravel, composed_poses, relative_poses
from zenav.calibrate.scan_track import ScanTrack

STEP = 0.3  # m driven that make an interval: slips of one spell fall into one interval, not into two
STEP_TURN = 0.5  # rad turned that make one
MAX_INTERVAL_S = 3.0  # of an interval: odometry does not see the slip of a slowly turning wheel
MATCH_SIGMA, MATCH_SIGMA_TURN = 0.003, 0.0015  # m, rad: of the motion between two scans, until it is measured
SLIP = 4e-5  # m^2 of variance for each m that a wheel rolls, until it is measured
ROBUST = 2.0  # standard deviations from which a residual counts less
TAILS = 10  # degrees of freedom of Student's t that the scatter is fitted with: a slip now and then is no surprise
MIN_INTERVALS = 12
MIN_TRAVEL_M, MIN_TURNING_RAD = 2.0, 2 * pi
NAMES = ("left radius", "right radius", "wheel distance", "laser x", "laser y", "laser yaw")


@dataclass(frozen=True, slots=True)
class MotionIntervals:
    """Pieces of a drive. path: the wheels, sampled at each piece's ends begin and end (n,), indices into it.

    laser: (n, 3) the laser's motion in each piece by its scans, yaw not wrapped.
    """

    path: WheelTravel
    begin: NDArray[np.intp]
    end: NDArray[np.intp]
    laser: Float64s

    def base(self, wheels: WheelGeometry) -> Float64s:
        """(n, 3) the base's motion in each piece, had it these wheels."""
        poses = self.path.poses(wheels)
        return relative_poses(poses[self.begin], poses[self.end])

    def turned(self) -> tuple[Float64s, Float64s]:
        """(n,) rad by which each wheel turned in each piece."""
        return (
            self.path.left[self.end] - self.path.left[self.begin],
            self.path.right[self.end] - self.path.right[self.begin],
        )

    def only(self, chosen: Bools) -> "MotionIntervals":
        """Some of the pieces."""
        return MotionIntervals(self.path, self.begin[chosen], self.end[chosen], self.laser[chosen])


@dataclass(frozen=True, slots=True)
class HandEyeSolution:
    """What fits best: wheels, mount (3,) base_from_laser, and covariance (6, 6) in the order of NAMES.

    residuals: (n, 3) m, m, rad, the laser's motion less what wheels and mount make of it.
    """

    wheels: WheelGeometry
    mount: Float64s
    covariance: Float64s
    residuals: Float64s
    slip: float  # m^2 of variance for each m that a wheel rolls

    @property
    def sigmas(self) -> Float64s:
        """(6,) standard deviations."""
        return np.asarray(np.sqrt(np.maximum(np.diag(self.covariance), 0.0)))

    @property
    def sigma_radius(self) -> float:
        """m, of the mean radius"""
        return self._sigma(np.array((0.5, 0.5, 0, 0, 0, 0)))

    @property
    def sigma_ratio(self) -> float:
        """of right over left"""
        w = self.wheels
        return self._sigma(np.array((-w.ratio / w.left_radius, 1 / w.left_radius, 0, 0, 0, 0)))

    @property
    def sigma_turn_share(self) -> float:
        """of radius over distance, as a share of it"""
        w = self.wheels
        return self._sigma(np.array((0.5 / w.radius, 0.5 / w.radius, -1 / w.distance, 0, 0, 0)))

    def _sigma(self, gradient: Float64s) -> float:
        return sqrt(max(float(gradient @ self.covariance @ gradient), 0.0))


def intervals(rolled: WheelTravel, track: ScanTrack) -> MotionIntervals:
    """Cuts a drive into pieces of enough motion, from scan to scan. Raises UserError where it does not hold enough."""
    path = rolled.with_samples(track.stamps)
    index = np.searchsorted(path.stamps, track.stamps)
    pairs: list[tuple[int, int]] = []
    begin: int | None = None
    travel = turn = 0.0
    for i in range(len(track.stamps)):
        if not track.good[i]:
            begin = None
            continue
        if begin is not None:
            dx, dy, dyaw = (float(v) for v in track.poses[i] - track.poses[i - 1])
            travel, turn = travel + hypot(dx, dy), turn + abs(dyaw)
            late = track.stamps[i] - track.stamps[begin] > MAX_INTERVAL_S * 1e9
            if travel < STEP and turn < STEP_TURN and not late:
                continue
            if not late or travel > STEP / 2 or turn > STEP_TURN / 2:
                pairs.append((begin, i))
        begin, travel, turn = i, 0.0, 0.0
    chosen = np.array(pairs, np.intp).reshape(-1, 2)
    chosen = chosen[rolled.is_known(track.stamps[chosen[:, 0]], track.stamps[chosen[:, 1]])]
    motions = MotionIntervals(
        path,
        index[chosen[:, 0]],
        index[chosen[:, 1]],
        relative_poses(track.poses[chosen[:, 0]], track.poses[chosen[:, 1]]),
    )
    _enough(motions)
    return motions


def _enough(motions: MotionIntervals) -> None:
    """Raises UserError where a drive does not determine the six numbers."""
    travel = float(np.hypot(motions.laser[:, 0], motions.laser[:, 1]).sum())
    turning = float(np.abs(motions.laser[:, 2]).sum())
    if turning < MIN_TURNING_RAD:
        raise UserError(
            f"the drive turns by {np.degrees(turning):.0f} degrees in all, "
            f"{np.degrees(MIN_TURNING_RAD):.0f} are needed",
            "record again with turns on the spot and curves, to both sides",
        )
    straight = np.abs(motions.laser[:, 2]) < 0.5 * STEP_TURN
    driven = float(np.hypot(motions.laser[straight, 0], motions.laser[straight, 1]).sum())
    if min(travel, driven) < MIN_TRAVEL_M:
        raise UserError(
            f"the drive goes straight on for {driven:.1f} m in all, {MIN_TRAVEL_M:g} are needed",
            "record again with some metres straight on between the turns",
        )
    if len(motions.begin) < MIN_INTERVALS:
        raise UserError(
            f"the drive has {len(motions.begin)} usable pieces of {STEP} m or {np.degrees(STEP_TURN):.0f} degrees",
            f"drive for longer: {MIN_INTERVALS} are the least, 100 are good",
        )


def closed_form(pieces: MotionIntervals) -> tuple[WheelGeometry, Float64s] | None:
    """Wheels and mount (3,) by linear least squares; None where the motion does not determine them.

    Turning gives radius over distance for each wheel. With these, the path is known up to the distance b.
    (R - I) l + b c = R(l_yaw) m is linear in b, l, cos l_yaw and sin l_yaw. Elimination leaves an eigenvalue problem,
    whose smallest eigenvector is the solution. Censi 2013, section IV.
    """
    left, right = pieces.turned()
    wheels = np.column_stack((left, right))
    shares, _, rank, _ = np.linalg.lstsq(wheels, pieces.laser[:, 2], rcond=1e-6)
    if rank < 2 or abs(shares[1] - shares[0]) < 1e-9:
        return None
    unit = pieces.base(WheelGeometry(-shares[0], shares[1], 1.0))
    c, s = np.cos(unit[:, 2]), np.sin(unit[:, 2])
    mx, my = pieces.laser[:, 0], pieces.laser[:, 1]
    rows = np.concatenate(
        (
            np.column_stack((unit[:, 0], c - 1, -s, -mx, my)),
            np.column_stack((unit[:, 1], s, c - 1, -my, -mx)),
        )
    )
    m = rows.T @ rows
    a, b, d = m[:3, :3], m[:3, 3:], m[3:, 3:]
    if np.linalg.cond(a) > 1e10:
        return None
    inner = np.linalg.solve(a, b)
    _, vectors = np.linalg.eigh(d - b.T @ inner)
    heading = vectors[:, 0]
    distance, x, y = -inner @ heading
    if distance < 0:
        distance, x, y, heading = -distance, -x, -y, -heading
    yaw = float(np.arctan2(heading[1], heading[0]))
    return WheelGeometry(float(-shares[0] * distance), float(shares[1] * distance), float(distance)), np.array(
        (x, y, yaw)
    )


def predicted_motion(pieces: MotionIntervals, wheels: WheelGeometry, mount: Float64s) -> Float64s:
    """(n, 3) the laser's motion in each piece, had the robot these wheels and this base_from_laser (3,)."""
    base = pieces.base(wheels)
    moved = composed_poses(base, mount)
    return relative_poses(np.broadcast_to(mount, moved.shape), moved)


def residuals(pieces: MotionIntervals, wheels: WheelGeometry, mount: Float64s) -> Float64s:
    """(n, 3) m, m, rad: by the scans less `predicted`."""
    off = pieces.laser - predicted_motion(pieces, wheels, mount)
    off[:, 2] = (off[:, 2] + pi) % (2 * pi) - pi
    return off


def solve(pieces: MotionIntervals, wheels: WheelGeometry, mount: Float64s) -> HandEyeSolution:
    """The best wheels and mount; `wheels` and `mount` (3,) are what is believed so far.

    Raises UserError where the motion leaves them open, or a wheel counts backwards.
    """
    from scipy.optimize import least_squares

    starts = [np.array((*wheels, *mount))]
    if (start := closed_form(pieces)) is not None:
        starts.append(np.array((*start[0], *start[1])))
    x_scale = np.array((0.01, 0.01, 0.05, 0.05, 0.05, 0.1))
    match, slip = 1.0, SLIP

    def cost(p: Float64s) -> Float64s:
        off = residuals(pieces, WheelGeometry(*p[:3]), p[3:])
        return np.asarray(np.einsum("nij,nj->ni", whitening, off).ravel())

    for _ in range(3):  # the second and third time with the scatter that the one before found
        covariances = _scatter(pieces, WheelGeometry(*starts[0][:3]), starts[0][3:])
        whitening = np.linalg.inv(np.linalg.cholesky(match * covariances[0] + slip * covariances[1]))
        fits = [least_squares(cost, p, loss="soft_l1", f_scale=ROBUST, x_scale=x_scale) for p in starts]
        best = min(fits, key=lambda fit: float(fit.cost))
        starts = [best.x]
        match, slip = _noise(residuals(pieces, WheelGeometry(*best.x[:3]), best.x[3:]), *covariances, match, slip)
    information = best.jac.T @ best.jac
    _observed(information, x_scale)
    # all lengths negative, and the laser turned about: the same motion. Distances are positive
    mirror = np.array((-1.0, -1.0, -1.0, -1.0, -1.0, 1.0)) if best.x[2] < 0 else np.ones(6)
    x = best.x * mirror
    n = 3 * len(pieces.begin)
    covariance = np.linalg.inv(information) * np.outer(mirror, mirror) * n / (n - 6)
    yaw = wrapped(float(x[5]) + (pi if best.x[2] < 0 else 0.0))
    fitted, fitted_mount = WheelGeometry(*(float(v) for v in x[:3])), np.array((x[3], x[4], yaw))
    _forward(fitted)
    return HandEyeSolution(fitted, fitted_mount, covariance, residuals(pieces, fitted, fitted_mount), slip)


def _noise(off: Float64s, scans: Float64s, wheels: Float64s, match: float, slip: float) -> tuple[float, float]:
    """The factors of both scatters (n, 3, 3) under which the residuals (n, 3) are likeliest, from a first guess."""
    from scipy.optimize import minimize

    def unlikely(logs: Float64s) -> float:
        covariance = np.exp(logs[0]) * scans + np.exp(logs[1]) * wheels
        root = np.linalg.cholesky(covariance)
        q = (np.linalg.solve(root, off[:, :, None])[:, :, 0] ** 2).sum(axis=1)
        volume = np.log(np.diagonal(root, axis1=1, axis2=2)).sum()
        return float(volume + (TAILS + 3) / 2 * np.log1p(q / TAILS).sum())

    bounds = [(np.log(1e-4), np.log(1e4)), (np.log(1e-9), np.log(1e-1))]
    fit = minimize(unlikely, np.log((match, slip)), method="Nelder-Mead", bounds=bounds, options={"xatol": 0.02})
    return float(np.exp(fit.x[0])), float(np.exp(fit.x[1]))


def _scatter(pieces: MotionIntervals, wheels: WheelGeometry, mount: Float64s) -> tuple[Float64s, Float64s]:
    """Covariances (n, 3, 3) of the residuals: of the scans' noise, and of 1 m^2 of slip for each m that a wheel rolls.

    Slip moves the base forward and turns it, halfway through the piece; the laser swings with it.
    """
    n = len(pieces.begin)
    left, right = pieces.turned()
    forward = (left * wheels.left_radius + right * wheels.right_radius) / 2
    by_wheel = np.zeros((n, 3, 2))
    by_wheel[:, 0] = 0.5
    by_wheel[:, 2] = -1 / wheels.distance, 1 / wheels.distance
    by_wheel[:, 1] = by_wheel[:, 2] * forward[:, None] / 2
    by_wheel[:, 0] -= by_wheel[:, 2] * mount[1]
    by_wheel[:, 1] += by_wheel[:, 2] * mount[0]
    c, s = np.cos(pieces.laser[:, 2] - mount[2]), np.sin(pieces.laser[:, 2] - mount[2])
    turned = np.zeros((n, 3, 3))
    turned[:, 0, 0] = turned[:, 1, 1] = c
    turned[:, 0, 1], turned[:, 1, 0], turned[:, 2, 2] = -s, s, 1.0
    by_wheel = turned @ by_wheel
    rolled = np.abs(np.column_stack((left * wheels.left_radius, right * wheels.right_radius)))
    match = np.diag((MATCH_SIGMA**2, MATCH_SIGMA**2, MATCH_SIGMA_TURN**2))
    return np.broadcast_to(match, (n, 3, 3)), np.einsum("nik,nk,njk->nij", by_wheel, rolled, by_wheel)


def _observed(information: Float64s, scale: Float64s) -> None:
    """Raises UserError where the motion leaves a combination of the six numbers open."""
    values, vectors = np.linalg.eigh(information * np.outer(scale, scale))
    if values[0] <= 0 or values[-1] / max(values[0], 1e-300) > 1e8:
        unobserved = NAMES[int(np.argmax(np.abs(vectors[:, 0])))]
        raise UserError(
            f"this drive does not determine the {unobserved}: every piece of it moves alike",
            "record again with some metres straight on, and turns on the spot to both sides",
        )


def _forward(wheels: WheelGeometry) -> None:
    for name, radius in (("left", wheels.left_radius), ("right", wheels.right_radius)):
        if radius <= 0:
            raise UserError(
                f"the {name} wheel counts backwards when the robot drives forward",
                "look at both wheels with: zenav calibrate motors --blocks",
            )


def uncertain_values(solution: HandEyeSolution) -> list[str]:
    """What is not known well enough to be written, in words; empty where all is."""
    limits = {"wheel_radius": (solution.sigma_radius / solution.wheels.radius, 0.02),
              "wheel_radius_ratio": (solution.sigma_ratio, 0.02),
              "wheel_distance": (solution.sigmas[2] / solution.wheels.distance, 0.02),
              "mount.x": (solution.sigmas[3], 0.02), "mount.y": (solution.sigmas[4], 0.02),
              "mount.yaw": (solution.sigmas[5], radians(1.0))}  # fmt: skip
    return [f"{name} is known to {sigma:.3f} only" for name, (sigma, limit) in limits.items() if sigma > limit]


def mount_difference(mount: Float64s, other: Float64s) -> tuple[float, float]:
    """m and rad between two mounts (3,)."""
    return hypot(mount[0] - other[0], mount[1] - other[1]), abs(wrapped(float(mount[2] - other[2])))
