# SPDX-License-Identifier: Apache-2.0
"""YDLIDAR X2, X4 and G2: triangulation lasers, clockwise, without a clock. The X2 transmits only.

X4 and G2 take requests of two bytes (development manuals, section 'system command'): stop A5 65, device information
A5 90, health A5 91, scan A5 60. Their answers are framed as in request_answers.py.
"""

import struct
from dataclasses import dataclass

import numpy as np

from services.lidar_driver.device import PacketCounts, Returns, is_before
from services.lidar_driver.request_answers import MAX_BUFFER, find_answer
from services.lidar_driver.ydlidar_packets import (
    HEAD,
    HEAD_LENGTH,
    PLAIN,
    WITH_INTENSITY,
    YdlidarFramer,
    angle_corrections,
    decode_samples,
)
from shared.types import Float64s, Int64s

MS = 1_000_000
STOP, INFO, HEALTH, SCAN = b"\xa5\x65", b"\xa5\x90", b"\xa5\x91", b"\xa5\x60"
ANSWERS: dict[bytes, dict[int, int | None]] = {INFO: {0x04: 20}, HEALTH: {0x06: 3}, SCAN: {0x81: 5}}
"""Request -> types of its answer -> length in bytes."""
UNHEALTHY = 2
MAX_STEP_DEG = 3.0  # degrees between two beams, at 12 turns/s and 3000 samples/s twice as many; more is no packet
MAX_GAP_DEG = 5.0  # degrees from a packet to the next; a larger gap is lost packets
MAX_STEP_BACK_DEG = 40.0  # degrees back from the last beam before a loss to the first one after it


@dataclass(frozen=True, slots=True)
class YdlidarModel:
    """samples: a second (SDK, 'YDLIDAR DATASET').  answers: whether it takes requests."""

    samples: int
    answers: bool
    has_intensity: bool


MODELS = {
    "ydlidar_x2": YdlidarModel(3000, answers=False, has_intensity=False),
    "ydlidar_x4": YdlidarModel(5000, answers=True, has_intensity=False),
    "ydlidar_g2": YdlidarModel(5000, answers=True, has_intensity=True),
}


class Ydlidar:
    """A YDLIDAR on a serial line. Times follow from the number of samples at a constant rate."""

    clockwise = True
    clock_reading = None

    def __init__(self, baud: int, model: YdlidarModel) -> None:
        self.model = model
        self.counts = PacketCounts()
        self.byte_time = 10.0 / baud  # s
        self.fault = ""
        self.start(0)

    def start(self, now: int) -> bytes:
        self.framing = YdlidarFramer(WITH_INTENSITY if self.model.has_intensity else PLAIN, self.counts)
        self.speed: float | None = None
        self.is_speed_reported = False  # by the zero packets
        self.turn_rate = 0.0  # turns/s by the last packet's angles
        self.time = 0.0  # s on the clock of its samples
        self.last_degrees: float | None = None  # the head's, at the last sample
        self.scanning = not self.model.answers
        self.last_request, self.is_answered, self.buffer = STOP, False, b""
        self.deadline = now + 100 * MS  # bytes of an earlier scan have passed by then
        return self.stop_command()

    def stop_command(self) -> bytes:
        return STOP if self.model.answers else b""

    def next_command(self, now: int) -> bytes:
        if self.scanning or (is_before(self.deadline, now) and not self.is_answered):
            return b""
        if self.last_request == STOP:
            return self._ask(INFO, now, 500)
        if self.is_answered and self.last_request == INFO:
            return self._ask(HEALTH, now, 500)
        if self.is_answered and not self.fault:
            return self._ask(SCAN, now, 2000)
        if self.fault:  # the health is asked again after a pause
            self.last_request, self.is_answered, self.deadline = STOP, False, now + 1000 * MS
            return b""
        return self.start(now)

    def _ask(self, request: bytes, now: int, timeout_ms: int) -> bytes:
        """Sends a request; `timeout_ms` is the maximum time to its answer."""
        self.last_request, self.is_answered, self.deadline, self.buffer = request, False, now + timeout_ms * MS, b""
        return request

    def receive(self, data: bytes, now: int) -> list[Returns]:
        if not self.scanning:
            data = self._receive_answer(data)
        packets, after = self.framing.extract(data) if data else ([], np.empty(0, np.int64))
        if not packets:
            return []
        heads = np.frombuffer(b"".join(packet[:HEAD_LENGTH] for packet in packets), HEAD)
        first, last = ((heads[name] >> 1) / 64 for name in ("first", "last"))
        n = heads["n"].astype(np.int64)
        steps = (last - first) % 360 / np.maximum(n - 1, 1)
        plausible = steps < MAX_STEP_DEG
        if not plausible.all():
            heads, first, last = heads[plausible], first[plausible], last[plausible]
            n, steps, after = n[plausible], steps[plausible], after[plausible]
            packets = [packet for packet, fits in zip(packets, plausible) if fits]
            if not packets:
                return []
        self._update_speed(heads["ct"].tolist(), steps[n > 1])
        ends = self._end_times(first, last, n)
        mm, intensities = decode_samples(
            np.frombuffer(b"".join(packet[HEAD_LENGTH:] for packet in packets), self.framing.sample)
        )
        place = np.arange(len(mm)) - np.repeat(np.cumsum(n) - n, n)  # of each sample in its packet
        head_degrees = np.repeat(first, n) + place * np.repeat(steps, n)
        returns = Returns(
            angles=-np.radians(head_degrees + angle_corrections(mm)),
            ranges=np.where(mm > 0, mm * 1e-3, np.nan).astype(np.float32),
            intensities=intensities.astype(np.float32) if intensities is not None else None,
            times=np.repeat(ends, n) - (np.repeat(n, n) - 1 - place) / self.model.samples,
            sent=ends,
            ages=(after + np.array([len(packet) for packet in packets])) * self.byte_time,
        )
        return [returns]

    def _receive_answer(self, data: bytes) -> bytes:
        """Searches for the answer to the last request. Returns the bytes after it when the scan has begun."""
        if self.is_answered or self.last_request not in ANSWERS:
            return b""
        self.buffer = (self.buffer + data)[-MAX_BUFFER:]
        answer = find_answer(self.buffer, ANSWERS[self.last_request])
        if answer is None:
            return b""
        self.is_answered, self.buffer = True, b""
        self.counts.n_good += 1
        if self.last_request == HEALTH:
            status, code = struct.unpack_from("<BH", answer[1])
            self.fault = f"the laser reports a health error, code {code}" if status == UNHEALTHY else ""
        self.scanning = self.last_request == SCAN
        return answer[1] if self.scanning else b""

    def _update_speed(self, cts: list[int], steps: Float64s) -> None:
        """From the zero packets where they report it, else from the angles of the packets. steps: degrees a sample."""
        if len(steps):
            self.turn_rate = float(steps[-1]) / 360 * self.model.samples
        reported = [ct >> 1 for ct in cts if ct & 1 and ct >> 1]
        if reported:
            self.speed = reported[-1] / 10
            self.is_speed_reported = True
        elif not self.is_speed_reported:
            self.speed = self.turn_rate or None

    def _end_times(self, first: Float64s, last: Float64s, n: Int64s) -> Float64s:
        """(p,) s on the clock of its samples, at the last sample of each packet. Lost samples follow from the angle.

        first, last: (p,) degrees of the head.  n: (p,) samples.
        """
        before = np.concatenate([[first[0] if self.last_degrees is None else self.last_degrees], last[:-1]])
        gaps = (first - before + MAX_STEP_BACK_DEG) % 360 - MAX_STEP_BACK_DEG
        steps = np.ones(len(n))
        if self.turn_rate:
            lost = np.maximum(np.rint(gaps / 360 / self.turn_rate * self.model.samples), 1)
            steps = np.where(gaps > MAX_GAP_DEG, lost, 1)
        ends: Float64s = self.time + np.cumsum(steps + n - 1) / self.model.samples
        self.time, self.last_degrees = float(ends[-1]), float(last[-1])
        return ends
