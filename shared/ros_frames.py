# SPDX-License-Identifier: Apache-2.0
"""The tree of frames in /tf and /tf_static, in three dimensions. Source: REP 105, tf2."""

from math import atan2, cos, degrees

import numpy as np

from shared.geometry import Pose2
from shared.types import Float64s, Int64s

MAX_COORDINATE = 1e6  # m
LEVEL = cos(np.radians(20.0))  # of the vertical: a laser tilted by more does not measure the plane


class Frames:
    """Transforms of a log or of a robot; `find` gives one frame in another at any time."""

    def __init__(self) -> None:
        self._edges: dict[str, dict[str, list[tuple[int, Float64s]]]] = {}  # by child and parent: stamp, 7 numbers
        self._fixed: set[str] = set()  # children of /tf_static

    def add(self, parent: str, child: str, stamp: int, transform: Float64s, static: bool) -> None:
        """Takes `parent_from_child`. stamp: ns.   transform: (7,) x y z, m, and the quaternion x y z w.

        Raises ValueError where it is none.
        """
        sane = parent != child and bool((np.abs(transform) <= MAX_COORDINATE).all())  # NaN is not
        norm = float(np.linalg.norm(transform[3:])) if sane else 0.0
        if not 0.5 < norm < 2:
            raise ValueError("a transform that is none")
        row = np.concatenate((transform[:3], transform[3:] / norm))
        if static:
            self._fixed.add(child)
        self._edges.setdefault(child, {}).setdefault(parent, []).append((stamp, row))

    def parent(self, child: str) -> str | None:
        """The parent of a frame; where there are several, the one with the most transforms."""
        edges = self._edges.get(child)
        return max(edges, key=lambda name: len(edges[name])) if edges else None

    def ancestors(self, frame: str) -> list[str]:
        """The frame itself, its parent, and so on up to the root."""
        chain = [frame]
        while (above := self.parent(chain[-1])) is not None and above not in chain:
            chain.append(above)
        return chain

    def moves(self, child: str) -> bool:
        """Whether a frame may move in its parent: the log has several transforms, none of them static."""
        parent = self.parent(child)
        return child not in self._fixed and parent is not None and len(self._edges[child][parent]) > 1

    def stamps(self, child: str) -> Int64s:
        """(n,) ns, the stamps of a frame's transforms in its parent, in order."""
        parent = self.parent(child)
        return np.unique([stamp for stamp, _ in self._edges[child][parent]]) if parent else np.empty(0, np.int64)

    def find(self, target: str, source: str, stamps: Int64s) -> Float64s | None:
        """`target_from_source` at stamps (n,) ns: (n, 4, 4), interpolated; None where no frames lead there."""
        up, down = self.ancestors(source), self.ancestors(target)
        common = next((frame for frame in up if frame in down), None)
        if common is None:
            return None
        common_from_source = self._chain(up[: up.index(common)], stamps)
        common_from_target = self._chain(down[: down.index(common)], stamps)
        return np.asarray(np.linalg.inv(common_from_target) @ common_from_source)

    def _chain(self, frames: list[str], stamps: Int64s) -> Float64s:
        """The last one's parent from the first of the frames: (n, 4, 4)."""
        transforms = np.tile(np.eye(4), (len(stamps), 1, 1))
        for child in frames:
            transforms = self._edge(child, stamps) @ transforms
        return transforms

    def _edge(self, child: str, stamps: Int64s) -> Float64s:
        parent = self.parent(child)
        assert parent is not None
        edge = self._edges[child][parent]
        if child in self._fixed or len(edge) == 1:
            return np.tile(matrices(edge[-1][1][None])[0], (len(stamps), 1, 1))
        edge = sorted(edge, key=lambda row: row[0])
        times = np.array([stamp for stamp, _ in edge])
        rows = np.array([row for _, row in edge])
        turned = np.einsum("ij,ij->i", rows[1:, 3:], rows[:-1, 3:]) < 0  # q and -q are the same turn
        rows[1:, 3:] *= np.where(np.cumsum(turned) % 2, -1.0, 1.0)[:, None]
        first = int(times[0])  # differences fit a float, stamps of today do not
        x, xp = (stamps - first).astype(np.float64), (times - first).astype(np.float64)
        return matrices(np.column_stack([np.interp(x, xp, column) for column in rows.T]))


def matrices(rows: Float64s) -> Float64s:
    """Transforms (n, 7), x y z and a quaternion x y z w of about length 1, as (n, 4, 4)."""
    x, y, z, w = (rows[:, 3:] / np.linalg.norm(rows[:, 3:], axis=1)[:, None]).T
    out = np.tile(np.eye(4), (len(rows), 1, 1))
    out[:, :3, 3] = rows[:, :3]
    out[:, 0, 0], out[:, 0, 1], out[:, 0, 2] = 1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)
    out[:, 1, 0], out[:, 1, 1], out[:, 1, 2] = 2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)
    out[:, 2, 0], out[:, 2, 1], out[:, 2, 2] = 2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)
    return out


def planar(transform: Float64s) -> Pose2:
    """What a transform (4, 4) is in the plane: the place and heading of the source's x axis."""
    return Pose2(float(transform[0, 3]), float(transform[1, 3]), atan2(transform[1, 0], transform[0, 0]))


def level(transform: Float64s) -> bool:
    """Whether the source's x-y plane is about the target's, either side up."""
    return abs(float(transform[2, 2])) >= LEVEL


def upside_down(transform: Float64s) -> bool:
    """Whether the source's z axis looks down."""
    return float(transform[2, 2]) < 0


def tilt(transform: Float64s) -> float:
    """Degrees by which the source's plane is off the target's."""
    return degrees(np.arccos(min(abs(float(transform[2, 2])), 1.0)))
