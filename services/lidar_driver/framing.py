# SPDX-License-Identifier: Apache-2.0
"""Packets of one length out of a stream of bytes that may be cut, joined, or have garbage between them."""

from collections.abc import Callable

import numpy as np

from services.lidar_driver.device import Bools, Counts, Int64s, Uint8s


class Framing:
    """Finds every packet with a good sum that overlaps no earlier one. Keeps less than one packet between readings.

    begins: whether first and second bytes, (k,) each, are a packet's.  sums: whether packets, (p, length), are whole.
    """

    def __init__(
        self,
        length: int,
        begins: Callable[[Uint8s, Uint8s], Bools],
        sums: Callable[[Uint8s], Bools],
        counts: Counts,
    ) -> None:
        self.length, self.begins, self.sums, self.counts = length, begins, sums, counts
        self.rest = b""
        self.in_step = True  # nothing has been skipped since the last packet

    def cut(self, data: bytes) -> tuple[Uint8s, Int64s]:
        """The packets, (p, length), and how many bytes came after each, (p,)."""
        self.rest += data
        n, length = len(self.rest), self.length
        if n < length:
            return np.empty((0, length), np.uint8), np.empty(0, np.int64)
        stream = np.frombuffer(self.rest, np.uint8)
        whole = n // length * length
        packets = stream[:whole].reshape(-1, length)
        if self.begins(packets[:, 0], packets[:, 1]).all() and self.sums(packets).all():
            return self._in_a_row(packets), n - np.arange(length, whole + 1, length)
        starts = np.flatnonzero(self.begins(stream[: n - length + 1], stream[1 : n - length + 2]))
        windows = np.lib.stride_tricks.sliding_window_view(stream, length)[starts]
        good = self.sums(windows)
        chosen = apart(starts[good], length)
        self._count(starts[~good], chosen)
        end = int(chosen[-1]) + length if len(chosen) else 0
        used = max(end, n - length + 1)
        self.in_step = end == used if len(chosen) else False
        self.rest = self.rest[used:]
        picked = windows[np.searchsorted(starts, chosen)]
        return picked, n - chosen - length

    def _in_a_row(self, packets: Uint8s) -> Uint8s:
        """Takes packets with nothing before or between them, as they nearly always come: no need to search."""
        self.counts.n_resyncs += self.counts.n_good > 0 and not self.in_step
        self.counts.n_good += len(packets)
        self.in_step = True
        self.rest = self.rest[packets.size :]
        return packets

    def _count(self, bad: Int64s, chosen: Int64s) -> None:
        """Counts packets, and headers with a wrong sum that lie in no packet."""
        counts = self.counts
        before = np.searchsorted(chosen, bad, "right") - 1
        inside = (before >= 0) & (bad < chosen[before] + self.length) if len(chosen) else np.zeros(len(bad), bool)
        counts.n_bad += int(np.count_nonzero(~inside))
        if len(chosen):
            gaps = np.diff(chosen) > self.length
            first = counts.n_good > 0 and (not self.in_step or chosen[0] > 0)
            counts.n_resyncs += int(np.count_nonzero(gaps)) + first
            counts.n_good += len(chosen)


def apart(starts: Int64s, length: int) -> Int64s:
    """The starts, rising, without those that lie within `length` after one that is taken."""
    if len(starts) < 2 or np.diff(starts).min() >= length:
        return starts
    taken, end = [], 0
    for start in starts.tolist():
        if start >= end:
            taken.append(start)
            end = start + length
    return np.array(taken, np.int64)
