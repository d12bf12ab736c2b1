# SPDX-License-Identifier: Apache-2.0
"""How wrong is a trajectory, by relative displacements instead of absolute positions?

Kuemmerle et al. 2009, "On measuring the accuracy of SLAM algorithms". The error of a pair of moments is the
displacement between its estimated relative pose and the reference's. So an early heading error counts once, where it
happened, and not in every later pose.
"""

import warnings
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from shared.config import UserError
from shared.geometry import wrapped_all
from shared.types import Float64s, Int64s

STEPS = 1, 5, 20  # scans between two neighbours
NEAR, APART = 2.0, 20.0  # m of two places of a loop at most; m of driving between them at least
N_FROM, EVERY = 1500, 5  # places that loops are sought from, about; of those that are found, each fifth counts
SLACK = 1.0  # s that a pair may lie outside the trajectory
UNCOVERED = 0.02  # share of the pairs that may lie farther outside: they are left out
SUFFIXES = ".relations", ".ref.tum"


@dataclass(frozen=True, slots=True)
class PosePairs:
    """Pairs of moments, s, each (n,), and the reference's pose at `late` in its frame at `early`: (n, 3), m, m, rad."""

    early: Float64s
    late: Float64s
    early_from_late: Float64s


@dataclass(frozen=True, slots=True)
class SlamErrors:
    """What is left of each pair that the trajectory covers: m, and degrees; each (n,)."""

    metres: Float64s
    degrees: Float64s

    def figures(self) -> dict[str, float]:
        """The benchmark's figures."""
        return {
            "n": len(self.metres),
            "trans_mean_m": float(self.metres.mean()),
            "trans_std_m": float(self.metres.std()),
            "trans_median_m": float(np.median(self.metres)),
            "trans_max_m": float(self.metres.max()),
            "rot_mean_deg": float(self.degrees.mean()),
        }


def read_tum(path: Path) -> tuple[Float64s, Float64s]:
    """A file of `stamp x y z qx qy qz qw` lines: stamps (n,) in s, in order, and planar poses (n, 3).

    Raises UserError where it holds anything else, or nothing.
    """
    rows = _numbers(path, 8, "a TUM line is `stamp x y z qx qy qz qw`")
    rows = rows[np.argsort(rows[:, 0], kind="stable")]
    qx, qy, qz, qw = rows[:, 4:8].T
    yaw = np.arctan2(2 * (qw * qz + qx * qy), 1 - 2 * (qy**2 + qz**2))
    return rows[:, 0], np.column_stack((rows[:, 1], rows[:, 2], yaw))


def pairs_of(reference: Path) -> dict[str, PosePairs]:
    """A reference's pairs, by kind.

    NAME.relations (`early late dx dy dtheta` a line): `relations`. NAME.ref.tum, a corrected trajectory: `neighbours`,
    and `loops` where it has any. Raises UserError where the file cannot be read.
    """
    if reference.name.endswith(".relations"):
        rows = _numbers(reference, 5, "a relation is `early late dx dy dtheta`")
        return {"relations": PosePairs(rows[:, 0], rows[:, 1], rows[:, 2:5])}
    stamps, poses = read_tum(reference)
    chosen = {"neighbours": neighbour_pairs(len(stamps)), "loops": loop_pairs(poses)}
    return {
        kind: PosePairs(stamps[i], stamps[j], relative_poses(poses[i], poses[j]))
        for kind, (i, j) in chosen.items()
        if len(i)
    }


def neighbour_pairs(n: int) -> tuple[Int64s, Int64s]:
    """Indices (earlier, later) of all pairs of n poses that are 1, 5 or 20 apart."""
    early = np.concatenate([np.arange(max(n - step, 0)) for step in STEPS])
    late = np.concatenate([np.arange(step, max(n, step)) for step in STEPS])
    return early, late


def loop_pairs(poses: Float64s) -> tuple[Int64s, Int64s]:
    """Indices (earlier, later) of pairs of poses (n, 3) at one place, with a long way between them."""
    steps = np.diff(poses[:, :2], axis=0)
    driven = np.concatenate(((0.0,), np.cumsum(np.hypot(steps[:, 0], steps[:, 1]))))
    early, late = [np.empty(0, np.int64)], [np.empty(0, np.int64)]
    for k in range(0, len(poses), max(1, len(poses) // N_FROM)):
        away = np.hypot(poses[:, 0] - poses[k, 0], poses[:, 1] - poses[k, 1])
        again = np.flatnonzero((away < NEAR) & (driven - driven[k] > APART))[::EVERY]
        early.append(np.full(len(again), k))
        late.append(again)
    return np.concatenate(early), np.concatenate(late)


def pair_errors(stamps: Float64s, poses: Float64s, pairs: PosePairs) -> SlamErrors:
    """The errors of a trajectory, stamps (n,) in order and poses (n, 3), interpolated linearly between poses.

    Raises UserError where it does not cover the pairs: a missing pair is an error, not an excuse.
    """
    first = np.minimum(pairs.early, pairs.late)
    last = np.maximum(pairs.early, pairs.late)
    inside = (first >= stamps[0] - SLACK) & (last <= stamps[-1] + SLACK)
    n_missing = int((~inside).sum())
    if n_missing > UNCOVERED * len(inside):
        raise UserError(
            f"{n_missing} of {len(inside)} pairs lie outside the trajectory's time",
            "the reference is another log's, or the log was not read to its end",
        )
    early_from_late = relative_poses(_at(stamps, poses, pairs.early[inside]), _at(stamps, poses, pairs.late[inside]))
    left = relative_poses(pairs.early_from_late[inside], early_from_late)
    return SlamErrors(np.hypot(left[:, 0], left[:, 1]), np.abs(np.degrees(left[:, 2])))


def slam_errors(trajectory: Path, reference: Path) -> dict[str, dict[str, float]]:
    """The figures of a trajectory (TUM format, the robot's pose) by kind of pair. Raises UserError, see above."""
    stamps, poses = read_tum(trajectory)
    return {kind: pair_errors(stamps, poses, pairs).figures() for kind, pairs in pairs_of(reference).items()}


def relative_poses(a: Float64s, b: Float64s) -> Float64s:
    """Poses b in the frames of poses a, row by row: (n, 3)."""
    d = b - a
    c, s = np.cos(a[:, 2]), np.sin(a[:, 2])
    return np.column_stack((c * d[:, 0] + s * d[:, 1], c * d[:, 1] - s * d[:, 0], wrapped_all(d[:, 2])))


def _at(stamps: Float64s, poses: Float64s, times: Float64s) -> Float64s:
    yaw = np.unwrap(poses[:, 2])
    return np.column_stack([np.interp(times, stamps, column) for column in (poses[:, 0], poses[:, 1], yaw)])


def _numbers(path: Path, columns: int, form: str) -> Float64s:
    """A file's rows of numbers, (n, columns), without its comments."""
    try:
        with warnings.catch_warnings(action="ignore", category=UserWarning):  # of a file without rows: reported below
            rows = np.loadtxt(path, comments="#", ndmin=2)
    except OSError as error:
        raise UserError(f"cannot read {path}: {error.strerror or error}", "check the path") from None
    except ValueError as error:
        raise UserError(f"{path}: {error}", form) from None
    if not len(rows) or rows.shape[1] < columns or not np.isfinite(rows[:, :columns]).all():
        raise UserError(f"{path} does not hold rows of {columns} finite numbers", form)
    return rows
