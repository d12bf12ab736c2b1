# SPDX-License-Identifier: Apache-2.0
"""Standard scan nodes: 5 bytes without a checksum. Several plausible nodes in a row show where they begin.

Node: quality << 2 | not start << 1 | start; angle (1/64 degree) << 1 | 1, u16; distance (1/4 mm), u16.
"""

import numpy as np

from services.lidar_driver.device import PacketCounts, differences
from shared.types import Bools, Int64s, UInt8s

LENGTH = 5
MIN_PLAUSIBLE_NODES = 8  # plausible nodes in a row that synchronize
MAX_STEP_AHEAD = 12 * 64  # 1/64 degree from a beam to the next; a larger step loses synchronization
MAX_STEP_BACK = 8 * 64  # 1/64 degree; the device corrects angles beam by beam
TURN = 360 * 64


class NodeFramer:
    """Finds nodes in a stream. Buffers less than MIN_PLAUSIBLE_NODES nodes."""

    def __init__(self, counts: PacketCounts) -> None:
        self.counts = counts
        self.buffer = b""
        self.last_angle: int | None = None  # 1/64 degree; None while not synchronized

    def extract(self, data: bytes) -> tuple[UInt8s, Int64s, Bools]:
        """The nodes (p, 5), the number of bytes after each (p,), and whether nodes were lost before each (p,)."""
        self.buffer += data
        plausible_runs, after, first = [], [], []
        while True:
            is_resync = self.last_angle is None
            if is_resync and not self._synchronize():
                break
            stream = np.frombuffer(self.buffer, np.uint8)
            nodes = stream[: len(stream) // LENGTH * LENGTH].reshape(-1, LENGTH)
            if not len(nodes):
                break
            plausible, angles = plausible_nodes(nodes, self.last_angle)
            n = len(nodes) if plausible.all() else int(np.argmin(plausible))
            plausible_runs.append(nodes[:n])
            after.append(len(stream) - LENGTH * np.arange(1, n + 1))
            first.append(is_resync & (np.arange(n) == 0))
            self.counts.n_good += n
            self.buffer = self.buffer[n * LENGTH :]
            if n == len(nodes):
                self.last_angle = int(angles[-1])
                break
            self.last_angle = None
            self.counts.n_bad += 1
            self.counts.n_resyncs += 1
        if not plausible_runs:
            return np.empty((0, LENGTH), np.uint8), np.empty(0, np.int64), np.empty(0, bool)
        if len(plausible_runs) == 1:
            return plausible_runs[0], after[0], first[0]
        return np.concatenate(plausible_runs), np.concatenate(after), np.concatenate(first)

    def _synchronize(self) -> bool:
        """Drops bytes up to the first row of plausible nodes; False without one."""
        stream = np.frombuffer(self.buffer, np.uint8)
        span = MIN_PLAUSIBLE_NODES * LENGTH
        if len(stream) < span:
            return False
        rows = np.lib.stride_tricks.sliding_window_view(stream, span).reshape(-1, MIN_PLAUSIBLE_NODES, LENGTH)
        flags = rows[:, :, 0] & 3
        starts = np.flatnonzero((((flags == 1) | (flags == 2)) & (rows[:, :, 1] & 1 == 1)).all(axis=1))
        for start in starts.tolist():
            plausible, angles = plausible_nodes(rows[start], None)
            if plausible.all():
                self.buffer = self.buffer[start:]
                self.last_angle = int(angles[0])
                return True
        self.buffer = self.buffer[len(stream) - span + 1 :]
        return False


def plausible_nodes(nodes: UInt8s, last_angle: int | None) -> tuple[Bools, Int64s]:
    """(p, 5) -> (p,), (p,): whether each node can follow the previous one (or `last_angle`); its angle, 1/64 degree."""
    flags = nodes[:, 0] & 3
    angles = (nodes[:, 1:3].view("<u2")[:, 0] >> 1).astype(np.int64)
    steps = (differences(angles, int(angles[0]) if last_angle is None else last_angle) + MAX_STEP_BACK) % TURN
    fits = (flags == 1) | (flags == 2)
    return fits & (nodes[:, 1] & 1 == 1) & (angles < TURN) & (steps <= MAX_STEP_BACK + MAX_STEP_AHEAD), angles
