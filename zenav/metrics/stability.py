# SPDX-License-Identifier: Apache-2.0
"""How steadily a robot drives: plans that change sides, stops on the way, jerk and turning acceleration.

Everything is about the time in which a task was under way. Velocities are the simulator's truth, or odometry's where
there is none; on a real robot the counts of its encoders are in jerk too.
"""

from dataclasses import dataclass, field
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from shared.messages import Message, NavState, NavStatus, Odometry, Path, Truth
from shared.types import Float64s

TaskSpan = tuple[float, float]
"""s, from and until when one task was under way."""

KEYS = ("sim/truth", "odom", "plan", "nav/status")
"""The topics that the figures need; of the first two one is enough."""

FIGURES = {
    "side_changes_per_min": "plan changes side, 1/min",
    "stops_per_min": "stops, 1/min",
    "standing_share": "stands, share",
    "jerk_rms": "jerk rms, m/s^3",
    "jerk_p99": "jerk p99",
    "turn_acceleration_rms": "turning rms, rad/s^2",
    "turn_acceleration_p99": "turning p99",
}
"""The figures' names, and what stands over their columns."""

UNDER_WAY = frozenset((NavState.NAVIGATING, NavState.EXPLORING, NavState.RECOVERING))
STEP = 0.02  # s between samples
WINDOW = 0.2  # s over which a difference counts as a derivative: what a passenger feels, not what one tick does
STANDS, MOVES = 0.03, 0.15  # m/s under which a moving robot stands, over which a standing one moves
TURNS = 0.1  # rad/s: faster is no standing
BESIDE = 0.5  # m beside the last plan from which a plan is another way
AHEAD = 5.0  # m along a plan in which that is looked for
SAME_END = 0.3  # m between two plans' ends that lead to the same place


@dataclass
class Ride:
    """What was heard of a run, in the order of time."""

    truths: list[tuple[int, float, float]] = field(default_factory=list)  # ns, m/s, rad/s
    odoms: list[tuple[int, float, float]] = field(default_factory=list)
    plans: list[tuple[int, Float64s]] = field(default_factory=list)  # ns, (n, 2) m
    states: list[tuple[int, int, bool]] = field(default_factory=list)  # ns, task, under way

    def add(self, message: Message) -> None:
        """Takes a message of one of KEYS."""
        if isinstance(message, Truth):
            self.truths.append((message.stamp, message.v, message.w))
        elif isinstance(message, Odometry):
            self.odoms.append((message.stamp, message.v, message.w))
        elif isinstance(message, Path) and len(message.xs):
            self.plans.append((message.stamp, np.column_stack((message.xs, message.ys))))
        elif isinstance(message, NavStatus):
            self.states.append((message.stamp, message.task_id, message.state in UNDER_WAY))

    def figures(self) -> dict[str, float | None]:
        """The figures of `stability`; None where nothing was driven."""
        rows = self.truths or self.odoms
        if not rows:
            return stability_figures(np.zeros((0, 3)), [], [])
        since = rows[0][0]
        motion = np.array([((stamp - since) / 1e9, v, w) for stamp, v, w in rows])
        plans = [((stamp - since) / 1e9, points) for stamp, points in self.plans]
        return stability_figures(motion, self._spans(since), plans)

    def _spans(self, since: int) -> list[TaskSpan]:
        spans: list[TaskSpan] = []
        begun: tuple[int, int] | None = None
        for stamp, task, under_way in self.states:
            if begun is not None and (not under_way or task != begun[1]):
                spans.append(((begun[0] - since) / 1e9, (stamp - since) / 1e9))
                begun = None
            if under_way and begun is None:
                begun = stamp, task
        if begun is not None:
            spans.append(((begun[0] - since) / 1e9, (self.states[-1][0] - since) / 1e9))
        return spans


def stability_figures(
    motion: Float64s, spans: list[TaskSpan], plans: list[tuple[float, Float64s]]
) -> dict[str, float | None]:
    """Figures of how steadily the robot drove; a figure is None where its input is empty.

    motion: (n, 3) s, m/s, rad/s, rising in time.  plans: s, and (k, 2) m from the robot on.

    side_changes_per_min: plans that end where the last plan ended, but lie beside it.
    stops_per_min: how often the robot stopped and went on.
    standing_share: share of standing in the time from first motion to last.
    Of jerk (m/s^3) and turning acceleration (rad/s^2): root mean square and 99th percentile.
    """
    rides = [ride for span in spans if (ride := _ride(motion, span)) is not None]
    seconds = sum(STEP * len(ride) for ride in rides)
    if not seconds:
        return dict.fromkeys(FIGURES)
    n_stops, standing = np.sum([_stops(ride) for ride in rides], axis=0)
    jerk = np.concatenate([_derivative(_derivative(ride[:, 0])) for ride in rides])
    turning = np.concatenate([_derivative(ride[:, 1]) for ride in rides])
    n_changes = sum(n_side_changes([points for at, points in plans if low <= at <= high]) for low, high in spans)
    values = (
        round(60 * n_changes / seconds, 3),
        round(60 * float(n_stops) / seconds, 3),
        round(STEP * float(standing) / seconds, 4),
        *(_rms(jerk), _p99(jerk)),
        *(_rms(turning), _p99(turning)),
    )
    return dict(zip(FIGURES, values, strict=True))


def n_side_changes(plans: list[Float64s]) -> int:
    """How many of the plans lead to where the one before did, but over BESIDE m beside it within AHEAD m."""
    n_changes = 0
    for old, new in pairwise(plans):
        if np.hypot(*(old[-1] - new[-1])) > SAME_END:
            continue
        along = np.concatenate(([0.0], np.cumsum(np.hypot(*np.diff(new, axis=0).T))))
        away = [_away(old, point) for point in new[along <= AHEAD]]
        n_changes += max(away) > BESIDE
    return n_changes


def _away(line: Float64s, point: Float64s) -> float:
    """m from a point to a polyline (n, 2)."""
    if len(line) == 1:
        return float(np.hypot(*(line[0] - point)))
    legs = np.diff(line, axis=0)
    square = np.maximum((legs**2).sum(axis=1), 1e-12)
    along = np.clip(((point - line[:-1]) * legs).sum(axis=1) / square, 0.0, 1.0)
    return float(np.hypot(*(line[:-1] + along[:, None] * legs - point).T).min())


def _ride(motion: Float64s, span: TaskSpan) -> Float64s | None:
    """(n, 2) m/s, rad/s every STEP s, from the span's first motion to its last; None where there is none."""
    inside = motion[(motion[:, 0] >= span[0]) & (motion[:, 0] <= span[1])]
    moving = np.flatnonzero(~_standing(inside[:, 1:]))
    if len(moving) < 2:
        return None
    part = inside[moving[0] : moving[-1] + 1]
    times = np.arange(part[0, 0], part[-1, 0], STEP)
    return np.column_stack([np.interp(times, part[:, 0], part[:, i]) for i in (1, 2)]) if len(times) else None


def _standing(velocities: Float64s) -> NDArray[np.bool_]:
    return (np.abs(velocities[:, 0]) < STANDS) & (np.abs(velocities[:, 1]) < TURNS)


def _stops(ride: Float64s) -> tuple[int, int]:
    """Times that it stood after it had moved, and samples in which it stood."""
    standing, fast = _standing(ride), np.abs(ride[:, 0]) > MOVES
    n_stops, moved = 0, False
    for stands, moves in zip(standing.tolist(), fast.tolist(), strict=True):
        if stands and moved:
            n_stops, moved = n_stops + 1, False
        elif moves:
            moved = True
    return n_stops, int(standing.sum())


def _derivative(values: Float64s) -> Float64s:
    n = round(WINDOW / STEP)
    return (values[n:] - values[:-n]) / WINDOW


def _rms(values: Float64s) -> float | None:
    return round(float(np.sqrt(np.mean(values**2))), 4) if len(values) else None


def _p99(values: Float64s) -> float | None:
    return round(float(np.percentile(np.abs(values), 99)), 4) if len(values) else None


def figure_rows(figures: dict[str, Any]) -> list[tuple[str, str]]:
    """Name and value of each figure, for a table."""
    return [(label, "-" if figures[name] is None else f"{figures[name]:.3g}") for name, label in FIGURES.items()]
