# SPDX-License-Identifier: Apache-2.0
"""Does the reference of a log agree with the log's own scans?

    python -m tests.unit.zenav.slam.reference_fit LOG.log.gz LOG.relations [trajectory.tum]

A hand-checked displacement may be wrong. Of each pair of up to 20 s, the later scan is laid on the earlier one by the
reference, and by odometry. Where it fits by odometry and does not by the reference, the reference is wrong. A pair that
is odometry to a millimetre was not measured, but taken from it. Of a trajectory, the errors on the short pairs and on
all others are printed.
"""

import sys
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import groupby, pairwise, product
from pathlib import Path

import numpy as np
from scipy.spatial import cKDTree

from shared.geometry import Pose2
from shared.types import Float64s
from zenav.convert.carmen import read_carmen
from zenav.convert.records import LoggedScan
from zenav.slam.slam_error import PosePairs, pair_errors, pairs_of, read_tum

MAX_RANGE_M = 25.0  # beams beyond it are far apart
MAX_PAIR_S = 20.0
MIN_APART_M = 0.25  # between reference and odometry: less does not show in a fit
SCALE_M, MAX_DISTANCE_M = 0.15, 0.5  # of a Geman-McClure kernel, and of a point to the earlier scan
SLACK_M, SLACK_RAD = 0.15, 0.04  # a pose within them may fit better, of either
MAX_COPY_M = 0.001  # from odometry to a reference that was taken from it
MAX_FIT_RATIO = 0.5  # of the reference's fit to odometry's, for a reference that is wrong
MAX_GAP_S = 30.0  # between two wrong pairs of one stretch


@dataclass(frozen=True, slots=True)
class PairFit:
    """A pair, s after the log's start, and how much of the later scan fits: 0..1.  apart: m between both poses."""

    early: float
    late: float
    by_reference: float
    by_odometry: float
    apart: float

    @property
    def is_wrong(self) -> bool:
        """Whether the scans contradict the reference and agree with odometry."""
        return self.apart > MIN_APART_M and self.by_reference < MAX_FIT_RATIO * self.by_odometry

    @property
    def is_copy(self) -> bool:
        """Whether the reference is odometry's own displacement."""
        return self.apart < MAX_COPY_M


def pair_fits(scans: Sequence[LoggedScan], pairs: PosePairs) -> list[PairFit]:
    """The fit of each short pair, in the order of time."""
    scans = sorted(scans, key=lambda scan: scan.stamp)
    stamps = np.array([scan.stamp / 1e9 for scan in scans])
    fits = []
    for early, late, row in sorted(zip(pairs.early, pairs.late, pairs.early_from_late.tolist()), key=lambda p: p[0]):
        if late - early > MAX_PAIR_S:
            continue
        a, b = (scans[int(np.argmin(np.abs(stamps - stamp)))] for stamp in (early, late))
        tree, points = cKDTree(_points(a)), _points(b)
        by_reference, by_odometry = Pose2(*row), a.odom_from_base.inverse() @ b.odom_from_base
        shares = [_best_share(tree, points, pose) for pose in (by_reference, by_odometry)]
        fits.append(PairFit(early - stamps[0], late - stamps[0], *shares, by_reference.distance(by_odometry)))
    return fits


def _points(scan: LoggedScan) -> Float64s:
    """(n, 2) m in `base`."""
    angles = scan.angle_min + scan.angle_increment * np.arange(len(scan.ranges))
    ends = np.column_stack((np.cos(angles), np.sin(angles))) * scan.ranges[:, None]
    return (scan.odom_from_base.inverse() @ scan.odom_from_laser) @ ends[scan.ranges < MAX_RANGE_M]


def _best_share(tree: cKDTree, points: Float64s, pose: Pose2) -> float:
    """The largest share of points (n, 2) that lie on an earlier scan, at a pose or near it."""
    return max(
        _share(tree, pose @ Pose2(x, y, yaw) @ points)
        for x, y, yaw in product((-SLACK_M, 0.0, SLACK_M), (-SLACK_M, 0.0, SLACK_M), (-SLACK_RAD, 0.0, SLACK_RAD))
    )


def _share(tree: cKDTree, points: Float64s) -> float:
    distance = np.minimum(tree.query(points, distance_upper_bound=MAX_DISTANCE_M)[0], MAX_DISTANCE_M)
    return float((1 / (1 + (distance / SCALE_M) ** 2) ** 2).mean())


def stretches(wrong: Sequence[PairFit]) -> list[list[PairFit]]:
    """Groups of wrong pairs that follow each other."""
    ends = np.cumsum([0] + [b.early - a.late > MAX_GAP_S for a, b in pairwise(wrong)])
    return [[fit for _, fit in group] for _, group in groupby(zip(ends, wrong), key=lambda one: one[0])]


def mean_errors(pairs: PosePairs, trajectory: Path) -> tuple[float, float]:
    """m, the mean errors of a trajectory on the short pairs and on the others."""
    is_short = np.abs(pairs.late - pairs.early) <= MAX_PAIR_S
    short, long = (
        PosePairs(pairs.early[which], pairs.late[which], pairs.early_from_late[which])
        for which in (is_short, ~is_short)
    )
    return tuple(float(pair_errors(*read_tum(trajectory), part).metres.mean()) for part in (short, long))


def main(log: str, reference: str, trajectory: str = "") -> None:
    scans = [record for record in read_carmen(Path(log)).records if isinstance(record, LoggedScan)]
    pairs = pairs_of(Path(reference))["relations"]
    fits = pair_fits(scans, pairs)
    n_copies, apart = sum(fit.is_copy for fit in fits), np.mean([fit.apart for fit in fits])
    print(f"{n_copies} of {len(fits)} pairs are odometry to {MAX_COPY_M} m; all are {apart:.3f} m from it in the mean")
    wrong = [fit for fit in fits if fit.is_wrong]
    print(f"{len(wrong)} of {len(fits)} pairs of up to {MAX_PAIR_S:.0f} s contradict the scans, odometry does not")
    for group in stretches(wrong) if wrong else ():
        columns = np.array([(fit.by_reference, fit.by_odometry, fit.apart) for fit in group])
        reference_fit, odometry_fit, off = np.median(columns, axis=0)
        print(
            f"{group[0].early:.0f} to {group[-1].late:.0f} s: {len(group)} pairs, {off:.2f} m from odometry; "
            f"{reference_fit:.2f} of the beams fit by the reference, {odometry_fit:.2f} by odometry"
        )
    if trajectory:
        short, long = mean_errors(pairs, Path(trajectory))
        n = len(pairs.early) - len(fits)
        print(f"the trajectory has {short:.3f} m on these pairs, and {long:.3f} m on the {n} others")


if __name__ == "__main__":
    main(*sys.argv[1:])
