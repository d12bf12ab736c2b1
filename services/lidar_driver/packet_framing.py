# SPDX-License-Identifier: Apache-2.0
"""Finds packets of fixed length in a byte stream with losses and noise."""

from collections.abc import Callable

import numpy as np

from services.lidar_driver.device import PacketCounts
from shared.types import Bools, Int64s, UInt8s


class PacketFramer:
    """Finds all packets with a correct checksum that overlap no earlier one. Buffers less than one packet.

    is_header: (k,), (k,) first and second bytes -> (k,) bool.  is_checksum_valid: (p, length) packets -> (p,) bool.
    """

    def __init__(
        self,
        length: int,
        is_header: Callable[[UInt8s, UInt8s], Bools],
        is_checksum_valid: Callable[[UInt8s], Bools],
        counts: PacketCounts,
    ) -> None:
        self.length, self.is_header, self.is_checksum_valid, self.counts = length, is_header, is_checksum_valid, counts
        self.buffer = b""
        self.is_synchronized = True  # False when bytes were skipped since the last packet

    def extract(self, data: bytes) -> tuple[UInt8s, Int64s]:
        """The packets (p, length), and the number of bytes after each (p,)."""
        self.buffer += data
        n, length = len(self.buffer), self.length
        if n < length:
            return np.empty((0, length), np.uint8), np.empty(0, np.int64)
        stream = np.frombuffer(self.buffer, np.uint8)
        whole = n // length * length
        packets = stream[:whole].reshape(-1, length)
        if self.is_header(packets[:, 0], packets[:, 1]).all() and self.is_checksum_valid(packets).all():
            return self._take_contiguous(packets), n - np.arange(length, whole + 1, length)
        starts = np.flatnonzero(self.is_header(stream[: n - length + 1], stream[1 : n - length + 2]))
        windows = np.lib.stride_tricks.sliding_window_view(stream, length)[starts]
        good = self.is_checksum_valid(windows)
        packet_starts = non_overlapping(starts[good], length)
        self._count(starts[~good], packet_starts)
        end = int(packet_starts[-1]) + length if len(packet_starts) else 0
        used = max(end, n - length + 1)
        self.is_synchronized = end == used if len(packet_starts) else False
        self.buffer = self.buffer[used:]
        packets_found = windows[np.searchsorted(starts, packet_starts)]
        return packets_found, n - packet_starts - length

    def _take_contiguous(self, packets: UInt8s) -> UInt8s:
        """Takes packets without bytes before or between them: the frequent case, without a search."""
        self.counts.n_resyncs += self.counts.n_good > 0 and not self.is_synchronized
        self.counts.n_good += len(packets)
        self.is_synchronized = True
        self.buffer = self.buffer[packets.size :]
        return packets

    def _count(self, bad: Int64s, packet_starts: Int64s) -> None:
        """Counts packets, and headers with a wrong checksum outside packets."""
        counts = self.counts
        before = np.searchsorted(packet_starts, bad, "right") - 1
        inside = (
            (before >= 0) & (bad < packet_starts[before] + self.length)
            if len(packet_starts)
            else np.zeros(len(bad), bool)
        )
        counts.n_bad += int(np.count_nonzero(~inside))
        if len(packet_starts):
            gaps = np.diff(packet_starts) > self.length
            first = counts.n_good > 0 and (not self.is_synchronized or packet_starts[0] > 0)
            counts.n_resyncs += int(np.count_nonzero(gaps)) + first
            counts.n_good += len(packet_starts)


def non_overlapping(starts: Int64s, length: int) -> Int64s:
    """The starts (k,), ascending, without those less than `length` after the previous start that is kept."""
    if len(starts) < 2 or np.diff(starts).min() >= length:
        return starts
    kept_starts, end = [], 0
    for start in starts.tolist():
        if start >= end:
            kept_starts.append(start)
            end = start + length
    return np.array(kept_starts, np.int64)
