# SPDX-License-Identifier: Apache-2.0
"""Does the reference of a log agree with the log's own scans?

    python -m tests.unit.zenav.slam.reference_fit LOG.log.gz LOG.relations [trajectory.tum]

A hand-checked displacement may be wrong. Of each pair of up to 20 s, the later scan is laid on the earlier one by the
reference, and by odometry. Where it fits by odometry and does not by the reference, the reference is wrong. A pair that
is odometry to a millimetre was not measured, but taken from it.

A reference may also be the displacement of another point than the robot's. Pairs that turn show it: their scans fit
best with the laser at some distance ahead of that point. Of a trajectory, the errors on the short pairs and on all
others are printed, and how well the scans fit by it.
"""

import sys
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import groupby, pairwise, product
from math import nan
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from shared.geometry import Pose2
from shared.types import Float64s, Int64s
from zenav.convert.carmen import read_carmen
from zenav.convert.records import LoggedScan
from zenav.slam.slam_error import PosePairs, pair_errors, pairs_of, read_tum, relative_poses

MAX_RANGE_M = 25.0  # beams beyond it are far apart
MAX_PAIR_S = 20.0
MIN_APART_M = 0.25  # between reference and odometry: less does not show in a fit
SCALE_M, MAX_DISTANCE_M = 0.15, 0.5  # of a Geman-McClure kernel, and of a point to the earlier scan
SLACK_M, SLACK_RAD = 0.15, 0.04  # a pose within them may fit better, of either
MAX_COPY_M = 0.001  # from odometry to a reference that was taken from it
MAX_FIT_RATIO = 0.5  # of the reference's fit to odometry's, for a reference that is wrong
MAX_GAP_S = 30.0  # between two wrong pairs of one stretch
MIN_TURN_RAD, MAX_TURN_RAD = 0.5, 2.6  # of pairs that show where the laser is, and see the same things
PLACES_AHEAD_M = np.linspace(-0.2, 0.8, 51)  # of the laser


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
    return (scan.odom_from_base.inverse() @ scan.odom_from_laser) @ _ends(scan)


def _ends(scan: LoggedScan) -> Float64s:
    """(n, 2) m in the laser's frame."""
    angles = scan.angle_min + scan.angle_increment * np.arange(len(scan.ranges))
    ends = np.column_stack((np.cos(angles), np.sin(angles))) * scan.ranges[:, None]
    return ends[scan.ranges < MAX_RANGE_M]


def _best_share(tree: cKDTree, points: Float64s, pose: Pose2) -> float:
    """The largest share of points (n, 2) that lie on an earlier scan, at a pose or near it."""
    return max(
        _share(tree, pose @ Pose2(x, y, yaw) @ points)
        for x, y, yaw in product((-SLACK_M, 0.0, SLACK_M), (-SLACK_M, 0.0, SLACK_M), (-SLACK_RAD, 0.0, SLACK_RAD))
    )


def _share(tree: cKDTree, points: Float64s) -> float:
    distance = np.minimum(tree.query(points, distance_upper_bound=MAX_DISTANCE_M)[0], MAX_DISTANCE_M)
    return float((1 / (1 + (distance / SCALE_M) ** 2) ** 2).mean())


def displacements(stamps: Float64s, poses: Float64s, pairs: PosePairs) -> Float64s:
    """(n, 3) of the pairs, by the nearest poses (k, 3) at stamps (k,), s in order."""
    return relative_poses(poses[_nearest(stamps, pairs.early)], poses[_nearest(stamps, pairs.late)])


def _nearest(stamps: Float64s, times: Float64s) -> Int64s:
    """(n,) index of the stamp (k,) that is nearest to each time (n,), s."""
    return np.abs(stamps - times[:, None]).argmin(axis=1)


class ScanPairs:
    """The scans of pairs, to be laid on each other by any displacements."""

    def __init__(self, scans: Sequence[LoggedScan], pairs: PosePairs) -> None:
        stamps = np.array([scan.stamp / 1e9 for scan in scans])
        self.trees = [cKDTree(_ends(scans[k])) for k in _nearest(stamps, pairs.early)]
        self.ends = [_ends(scans[k]) for k in _nearest(stamps, pairs.late)]

    def mean_fit(self, early_from_late: Float64s, base_from_laser: Pose2) -> float:
        """How much of the later scans lies on the earlier ones, 0..1."""
        shares = (
            _share(tree, base_from_laser.inverse() @ Pose2(*row) @ base_from_laser @ ends)
            for tree, ends, row in zip(self.trees, self.ends, early_from_late.tolist())
        )
        return float(np.mean(list(shares)))

    def laser_ahead(self, early_from_late: Float64s) -> float:
        """m, the laser's place ahead of the point that moves so, at which the scans fit best; nan without pairs."""
        if not self.trees:
            return nan
        fits = [self.mean_fit(early_from_late, Pose2(x, 0, 0)) for x in PLACES_AHEAD_M]
        return float(PLACES_AHEAD_M[np.argmax(fits)])


def turning(pairs: PosePairs) -> PosePairs:
    """Those of the pairs that show where the laser is."""
    turn = np.abs(pairs.early_from_late[:, 2])
    return _only(pairs, (turn >= MIN_TURN_RAD) & (turn <= MAX_TURN_RAD))


def _only(pairs: PosePairs, which: NDArray[np.bool_]) -> PosePairs:
    return PosePairs(pairs.early[which], pairs.late[which], pairs.early_from_late[which])


def stretches(wrong: Sequence[PairFit]) -> list[list[PairFit]]:
    """Groups of wrong pairs that follow each other."""
    ends = np.cumsum([0] + [b.early - a.late > MAX_GAP_S for a, b in pairwise(wrong)])
    return [[fit for _, fit in group] for _, group in groupby(zip(ends, wrong), key=lambda one: one[0])]


def main(log: str, reference: str, trajectory: str = "") -> None:
    scans = [record for record in read_carmen(Path(log)).records if isinstance(record, LoggedScan)]
    scans.sort(key=lambda scan: scan.stamp)
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
    odometry = np.array([(p.x, p.y, p.yaw) for p in (scan.odom_from_base for scan in scans)])
    paths = {"odometry": (np.array([scan.stamp / 1e9 for scan in scans]), odometry)}
    if trajectory:
        paths["the trajectory"] = read_tum(Path(trajectory))
    is_short = np.abs(pairs.late - pairs.early) <= MAX_PAIR_S
    print_fits("pairs of up to 20 s", scans, _only(pairs, is_short), paths)
    del paths["odometry"]
    print_fits("other pairs", scans, _only(pairs, ~is_short), paths)


def print_fits(
    title: str, scans: Sequence[LoggedScan], pairs: PosePairs, paths: dict[str, tuple[Float64s, Float64s]]
) -> None:
    """How well the scans fit by the reference and by paths, each with stamps (k,), s, and poses (k, 3)."""
    base_from_laser, turned = scans[0].odom_from_base.inverse() @ scans[0].odom_from_laser, turning(pairs)
    of_all, of_turned = ScanPairs(scans, pairs), ScanPairs(scans, turned)
    print(
        f"{len(pairs.early)} {title}, of which {len(turned.early)} turn; "
        f"the log has the laser {base_from_laser.x:.2f} m ahead"
    )
    rows = {"the reference": (pairs.early_from_late, turned.early_from_late)}
    rows |= {name: (displacements(*path, pairs), displacements(*path, turned)) for name, path in paths.items()}
    ahead = {name: of_turned.laser_ahead(turned_rows) for name, (_, turned_rows) in rows.items()}
    for name, (all_rows, _) in rows.items():
        fit = of_all.mean_fit(all_rows, base_from_laser)
        print(f"  by {name} {fit:.3f} of the beams fit, and those of turns best with the laser at {ahead[name]:.2f} m")
    point = base_from_laser.x - ahead["the reference"]
    for name, (stamps, poses) in paths.items():
        errors = [pair_errors(stamps, moved, pairs).metres.mean() for moved in (poses, moved_ahead(poses, point))]
        print(f"  {name} has an error of {errors[0]:.3f} m; for a point {point:.2f} m ahead {errors[1]:.3f} m")


def moved_ahead(poses: Float64s, distance: float) -> Float64s:
    """Poses (n, 3) of a point so far ahead, m, of that of the given ones."""
    return poses + distance * np.column_stack((np.cos(poses[:, 2]), np.sin(poses[:, 2]), np.zeros(len(poses))))


if __name__ == "__main__":
    main(*sys.argv[1:])
