# SPDX-License-Identifier: Apache-2.0
"""Point cloud packets of YDLIDAR's triangulation lasers: their framing, and their beams.

YDLIDAR, 'YDLidar-SDK Communication Protocol', and the development manuals of X2, X4 and G2. A packet, little-endian:

    AA 55 | CT u8: bit 0 zero packet, bits 1 to 7 turns/s * 10 or 0 | samples u8
    first angle u16, last angle u16: bit 0 is 1, then 1/64 degree | xor of all words but itself u16 | samples

A sample is a distance (1/4 mm, u16). With intensities it is a byte and a word: the intensity's low 8 bits, then its
high 2 bits below a distance in mm. A zero packet has one sample and marks a new turn. Angles rise clockwise.
"""

import numpy as np
from numpy.typing import NDArray

from services.lidar_driver.device import PacketCounts
from shared.types import Float64s, Int64s

HEADER = b"\xaa\x55"
HEAD_LENGTH = 10
MAX_SAMPLES = 80  # of the SDK (TRI_PACKMAXNODES)
HEAD = np.dtype([("header", "<u2"), ("ct", "u1"), ("n", "u1"), ("first", "<u2"), ("last", "<u2"), ("sum", "<u2")])
PLAIN = np.dtype([("word", "<u2")])
WITH_INTENSITY = np.dtype([("low", "u1"), ("word", "<u2")])


def checksum(packet: bytes, sample: np.dtype[np.void]) -> int:
    """The xor of the head's words and of the samples' parts, without the packet's own checksum."""
    head = np.frombuffer(packet, "<u2", HEAD_LENGTH // 2 - 1)
    samples = np.frombuffer(packet, sample, offset=HEAD_LENGTH)
    total = int(np.bitwise_xor.reduce(head))
    for name in sample.names or ():
        total ^= int(np.bitwise_xor.reduce(samples[name]))
    return total


class YdlidarFramer:
    """Finds all packets with a correct checksum that overlap no earlier one. sample: PLAIN or WITH_INTENSITY.

    Buffers less than one packet.
    """

    def __init__(self, sample: np.dtype[np.void], counts: PacketCounts) -> None:
        self.sample, self.counts = sample, counts
        self.length = HEAD_LENGTH + MAX_SAMPLES * sample.itemsize  # of the longest packet
        self.buffer = b""
        self.is_synchronized = True  # False when bytes were skipped since the last packet

    def extract(self, data: bytes) -> tuple[list[bytes], Int64s]:
        """The packets (p), and the number of bytes after each (p,)."""
        self.buffer += data
        buffer, packets, ends = self.buffer, [], []
        searched, used = 0, 0  # bytes; up to the next header, and up to the end of the last packet
        while (start := buffer.find(HEADER, searched)) >= 0:
            end = self._end(buffer, start)
            if end is not None and end > len(buffer):
                break  # incomplete
            packet = buffer[start:end] if end is not None else b""
            if not packet:
                searched = start + 1
            elif checksum(packet, self.sample) == int.from_bytes(packet[8:10], "little"):
                in_sync = start == used and self.is_synchronized
                self.counts.n_resyncs += self.counts.n_good > 0 and not in_sync
                self.counts.n_good += 1
                self.is_synchronized = True
                packets.append(packet)
                ends.append(end)
                searched = used = start + len(packet)
            else:
                self.counts.n_bad += 1
                searched = start + 1
        kept_from = start if start >= 0 else len(buffer) - buffer.endswith(HEADER[:1])
        self.is_synchronized = self.is_synchronized and kept_from == used
        self.buffer = buffer[kept_from:]
        return packets, len(buffer) - np.array(ends, np.int64)

    def _end(self, buffer: bytes, start: int) -> int | None:
        """The end of the packet that starts here, perhaps after the buffer's; None where none can start."""
        if len(buffer) < start + HEAD_LENGTH:
            return len(buffer) + 1
        n = buffer[start + 3]
        if not 0 < n <= MAX_SAMPLES or not buffer[start + 4] & buffer[start + 6] & 1:
            return None
        return start + HEAD_LENGTH + n * self.sample.itemsize


def angle_corrections(mm: Float64s) -> Float64s:
    """(n,) mm -> (n,) degrees to add to the head's angles.

    The beam leaves the head beside its axis, so its direction from the axis depends on the distance ('second-level
    analysis' of the protocol). A beam without a distance counts as a far one: angles stay in the order of time.
    The protocol leaves it at the head's angle.
    """
    distances = np.where(mm > 0, mm, np.inf)
    return np.degrees(np.arctan(21.8 * (1 / distances - 1 / 155.3)))


def decode_samples(samples: NDArray[np.void]) -> tuple[Float64s, Float64s | None]:
    """(n,) samples -> (n,) mm, 0 without a measurement; (n,) intensities, or None."""
    words = samples["word"]
    if samples.dtype != WITH_INTENSITY:
        return words / 4, None
    return (words >> 2).astype(np.float64), ((words & 3) * 256.0 + samples["low"])
