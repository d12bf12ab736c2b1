# SPDX-License-Identifier: Apache-2.0
"""A run in figures, for two of them side by side: what was said how often, the way, the map, how late it was."""

from collections.abc import Iterable
from dataclasses import dataclass, field
from math import degrees

import numpy as np
from numpy.typing import NDArray

from shared import topics
from shared.codec import CodecError, decode
from shared.geometry import Pose2, wrapped_all
from shared.grid import FREE_UP_TO, OCCUPIED_FROM, OccupancyGrid
from shared.messages import (
    TILE_CELLS,
    GuardStatus,
    Localization,
    MapUpdate,
    NavStatus,
    Odometry,
    Path,
    PoseEstimate,
    Truth,
)
from shared.recording import Entry
from shared.runners.host import DONE
from shared.runners.journal import Life
from shared.types import Float64s
from zenav.metrics.nav_counts import NavCounts

Metrics = dict[str, float]
"""By name with its unit, like `pose path, m`."""

TIMING_METRICS = (topics.HEALTH, topics.JOURNAL, topics.LOG)
"""Topics that describe the machine, not the robot."""
LATE_S = ("odom", "pose", "plan", "cmd/nav", "cmd/vel")
"""Keys whose delay from stamp to sending is a figure."""


@dataclass
class RecordedRun:
    """What was heard of a run; `take` each entry, in their order."""

    counts: dict[str, int] = field(default_factory=dict)
    odoms: list[tuple[int, Pose2]] = field(default_factory=list)
    poses: list[tuple[int, Pose2]] = field(default_factory=list)
    grid: OccupancyGrid = field(default_factory=OccupancyGrid)
    n_lost: int = 0
    n_plans: int = 0
    n_refused: int = 0
    nav: NavCounts = field(default_factory=NavCounts)
    standing: dict[str, int] = field(default_factory=dict)  # guard's messages by reason
    truth: Truth | None = None
    delays: dict[str, list[float]] = field(default_factory=dict)  # ms

    def add(self, entry: Entry) -> None:
        topic = topics.topic_of(entry.key)
        if topic is None or topic in TIMING_METRICS:
            return
        try:
            message, envelope = decode(topic.type, entry.payload)
        except CodecError:
            return
        self.counts[entry.key] = self.counts.get(entry.key, 0) + 1
        if entry.key in LATE_S:
            self.delays.setdefault(entry.key, []).append((envelope.sent - message.stamp) / 1e6)
        if isinstance(message, Odometry):
            self.odoms.append((message.stamp, message.odom_from_base))
        elif isinstance(message, PoseEstimate):
            self.poses.append((message.stamp, message.map_from_base))
            self.n_lost += message.state is Localization.LOST
        elif isinstance(message, MapUpdate):
            self.grid.apply(message)
        elif isinstance(message, Path):
            self.n_plans += not message.reason
            self.n_refused += bool(message.reason)
        elif isinstance(message, NavStatus):
            self.nav.add(message)
        elif isinstance(message, GuardStatus):
            if message.reason:
                self.standing[message.reason] = self.standing.get(message.reason, 0) + 1
        elif isinstance(message, Truth):
            self.truth = message

    @property
    def trajectory(self) -> Float64s:
        """(n, 3) map_from_base."""
        return _array(self.poses)


def run_from_entries(entries: Iterable[Entry]) -> RecordedRun:
    """A run from its recording."""
    run = RecordedRun()
    for entry in entries:
        run.add(entry)
    return run


def run_metrics(run: RecordedRun, lives: Iterable[Life] = ()) -> Metrics:
    """The figures of one run, without a reference. lives: its journals' sessions, for the jobs."""
    metrics: Metrics = {f"{key}, messages": n for key, n in sorted(run.counts.items())}
    for name, poses in (("odom", run.odoms), ("pose", run.poses)):
        if poses:
            path = _array(poses)
            metrics[f"{name} path, m"] = float(np.hypot(*np.diff(path[:, :2], axis=0).T).sum())
            metrics[f"{name} turned, deg"] = degrees(float(np.abs(wrapped_all(np.diff(path[:, 2]))).sum()))
    if run.poses:
        end = run.poses[-1][1]
        metrics |= {
            "pose at the end x, m": end.x,
            "pose at the end y, m": end.y,
            "pose at the end, deg": degrees(end.yaw),
        }
        metrics["pose lost, messages"] = run.n_lost
    if not run.grid.empty:
        metrics["map known, m2"] = float((run.grid.cells >= 0).sum()) * run.grid.resolution**2
        metrics["map occupied, cells"] = int(run.grid.occupied.sum())
    if run.n_plans or run.n_refused:
        metrics |= {"plan ways, messages": run.n_plans, "plan without a way, messages": run.n_refused}
    if run.nav.last is not None:
        metrics |= {"goals reached": run.nav.n_reached, "recoveries": run.nav.n_recoveries}
    metrics |= {f"guard {reason}, messages": n for reason, n in sorted(run.standing.items())}
    if run.truth is not None:
        metrics |= {"truly driven, m": run.truth.distance, "contacts": run.truth.n_contacts}
    for key, delays in run.delays.items():
        metrics |= {f"{key} delay {p} %, ms": float(np.percentile(delays, p)) for p in (50, 95)}
    for life in lives:
        n = sum(event.kind == DONE for event in life.events)
        if n:
            metrics[f"{life.name} jobs done"] = metrics.get(f"{life.name} jobs done", 0) + n
    return metrics


def run_differences(a: RecordedRun, b: RecordedRun) -> Metrics:
    """How far two runs on the same inputs are apart: poses by their stamps, odometry, maps cell by cell."""
    metrics: Metrics = {}
    for name, of_a, of_b in (("odom", a.odoms, b.odoms), ("pose", a.poses, b.poses)):
        second = dict(of_b)
        pairs = [(pose, second[stamp]) for stamp, pose in of_a if stamp in second]
        if pairs:
            off = np.array([pose.distance(other) for pose, other in pairs])
            turned = np.abs(wrapped_all(np.array([other.yaw - pose.yaw for pose, other in pairs])))
            metrics[f"{name} apart mean, m"], metrics[f"{name} apart most, m"] = float(off.mean()), float(off.max())
            metrics[f"{name} apart most, deg"] = degrees(float(turned.max()))
    if a.grid.resolution == b.grid.resolution and not (a.grid.empty and b.grid.empty):
        first, second_, _ = on_one_window(a.grid, b.grid)
        metrics["map differs, cells"] = int((cell_classes(first) != cell_classes(second_)).sum())
        metrics["map known in both, cells"] = int(((first >= 0) & (second_ >= 0)).sum())
    return metrics


def on_one_window(a: OccupancyGrid, b: OccupancyGrid) -> tuple[NDArray[np.int8], NDArray[np.int8], tuple[int, int]]:
    """The cells of two grids of one resolution on the same rectangle, and its lower left tile (row, column)."""
    grids = [grid for grid in (a, b) if not grid.empty]
    row, column = min(g.first_row for g in grids), min(g.first_column for g in grids)
    height = max((g.first_row - row) * TILE_CELLS + g.cells.shape[0] for g in grids)
    width = max((g.first_column - column) * TILE_CELLS + g.cells.shape[1] for g in grids)

    def placed(grid: OccupancyGrid) -> NDArray[np.int8]:
        cells = np.full((height, width), -1, np.int8)
        if not grid.empty:
            r, c = (grid.first_row - row) * TILE_CELLS, (grid.first_column - column) * TILE_CELLS
            cells[r : r + grid.cells.shape[0], c : c + grid.cells.shape[1]] = grid.cells
        return cells

    return placed(a), placed(b), (row, column)


def cell_classes(cells: NDArray[np.int8]) -> NDArray[np.int8]:
    """Per cell 0 unknown, 1 free, 2 in between, 3 occupied."""
    classes = np.where(cells >= OCCUPIED_FROM, 3, np.where(cells > FREE_UP_TO, 2, 1))
    return np.where(cells < 0, 0, classes).astype(np.int8)


def comparison_table(a: Metrics, b: Metrics, names: tuple[str, str], only_changed: bool = False) -> list[str]:
    """A table of two runs' figures with what changed. Where one has no such figure, its place is empty."""
    rows = [(name, a.get(name), b.get(name)) for name in dict.fromkeys((*a, *b))]
    if only_changed:
        rows = [row for row in rows if row[1] != row[2]]
    width = max((len(name) for name, _, _ in rows), default=6)
    lines = [f"{'':<{width}} {names[0]:>14} {names[1]:>14} {'change':>14}"]
    for name, x, y in rows:
        change = "" if x is None or y is None or x == y else f"{y - x:+.6g}"
        lines.append(f"{name:<{width}} {_number(x):>14} {_number(y):>14} {change:>14}".rstrip())
    return lines


def _number(value: float | None) -> str:
    return "" if value is None else f"{value:.6g}"


def _array(poses: list[tuple[int, Pose2]]) -> Float64s:
    return np.array([(p.x, p.y, p.yaw) for _, p in poses]).reshape(-1, 3)
