# SPDX-License-Identifier: Apache-2.0
"""Standard scan nodes: 5 bytes with no sum. Only that many in a row make sense tells where they begin.

Node: quality << 2 | not start << 1 | start; angle (1/64 degree) << 1 | 1, u16; distance (1/4 mm), u16.
"""

import numpy as np

from services.lidar_driver.device import Bools, Counts, Int64s, Uint8s, steps_of

LENGTH = 5
IN_A_ROW = 8  # nodes that make sense one after the other, before the first of them is believed
FURTHEST = 12 * 64  # 1/64 degree that the next beam may lie ahead; lost nodes are found anew
BACK = 8 * 64  # 1/64 degree that it may lie behind: angles are corrected beam by beam
TURN = 360 * 64


class Nodes:
    """Cuts nodes out of a stream. Keeps less than IN_A_ROW nodes between readings."""

    def __init__(self, counts: Counts) -> None:
        self.counts = counts
        self.rest = b""
        self.last_angle: int | None = None  # 1/64 degree; None while out of step

    def cut(self, data: bytes) -> tuple[Uint8s, Int64s, Bools]:
        """The nodes, (p, 5), how many bytes came after each, (p,), and which follow lost ones, (p,)."""
        self.rest += data
        found, after, first = [], [], []
        while True:
            anew = self.last_angle is None
            if anew and not self._found_step():
                break
            stream = np.frombuffer(self.rest, np.uint8)
            nodes = stream[: len(stream) // LENGTH * LENGTH].reshape(-1, LENGTH)
            if not len(nodes):
                break
            plausible, angles = sensible(nodes, self.last_angle)
            n = len(nodes) if plausible.all() else int(np.argmin(plausible))
            found.append(nodes[:n])
            after.append(len(stream) - LENGTH * np.arange(1, n + 1))
            first.append(anew & (np.arange(n) == 0))
            self.counts.n_good += n
            self.rest = self.rest[n * LENGTH :]
            if n == len(nodes):
                self.last_angle = int(angles[-1])
                break
            self.last_angle = None
            self.counts.n_bad += 1
            self.counts.n_resyncs += 1
        if not found:
            return np.empty((0, LENGTH), np.uint8), np.empty(0, np.int64), np.empty(0, bool)
        if len(found) == 1:
            return found[0], after[0], first[0]
        return np.concatenate(found), np.concatenate(after), np.concatenate(first)

    def _found_step(self) -> bool:
        """Drops bytes up to the first node of a row that makes sense; False where there is none yet."""
        stream = np.frombuffer(self.rest, np.uint8)
        span = IN_A_ROW * LENGTH
        if len(stream) < span:
            return False
        rows = np.lib.stride_tricks.sliding_window_view(stream, span).reshape(-1, IN_A_ROW, LENGTH)
        flags = rows[:, :, 0] & 3
        starts = np.flatnonzero((((flags == 1) | (flags == 2)) & (rows[:, :, 1] & 1 == 1)).all(axis=1))
        for start in starts.tolist():
            plausible, angles = sensible(rows[start], None)
            if plausible.all():
                self.rest = self.rest[start:]
                self.last_angle = int(angles[0])
                return True
        self.rest = self.rest[len(stream) - span + 1 :]
        return False


def sensible(nodes: Uint8s, last_angle: int | None) -> tuple[Bools, Int64s]:
    """Whether each node, (p, 5), can follow the one before (or `last_angle`), and the angles, 1/64 degree."""
    flags = nodes[:, 0] & 3
    angles = (nodes[:, 1:3].view("<u2")[:, 0] >> 1).astype(np.int64)
    steps = (steps_of(angles, int(angles[0]) if last_angle is None else last_angle) + BACK) % TURN
    fits = (flags == 1) | (flags == 2)
    return fits & (nodes[:, 1] & 1 == 1) & (angles < TURN) & (steps <= BACK + FURTHEST), angles
