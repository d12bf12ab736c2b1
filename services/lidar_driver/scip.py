# SPDX-License-Identifier: Apache-2.0
"""Hokuyo URG, UTM and UST by SCIP 2.0, serial or TCP: asked for its parameters, then for continuous distances.

Hokuyo, 'Communication protocol specification for SCIP2.0 standard', C-42-03320. Answers are lines that end in an empty
one: echo, status and its sum, time (4 characters) and its sum, blocks of 64 characters and their sum. Steps run
counter-clockwise; the time is when the sweep passed straight behind (hokuyo_node's measurement).
"""

import re
from math import pi

import numpy as np

from services.lidar_driver.device import Counts, Float32s, Int64s, Returns, Uint8s, since
from shared.config import Laser

MS = 1_000_000
TIME_WRAP = 1 << 24  # ticks
TICK = 1e-3  # s
MOST_BACK = 500  # ticks: a sweep that began before its clock was asked
LONGEST = 1 << 16  # bytes of an answer; over three times that of the longest one known
ERRORS_BELOW = 20  # mm: lower distances are codes of errors
BLOCK = 64
PATIENCE = 700 * MS  # for an answer
FIRST = ("SCIP2.0", "QT", "PP")  # QT ends what an earlier driver left running
TIME = ("TM0", "TM1", "TM2")  # its clock can be asked while the laser is off
CHARACTERS = {b"MD": 3, b"ME": 6}  # of a step
SCANS = tuple(CHARACTERS)
HARDWARE = range(50, 98)  # status of a fault of laser or motor


def sum_of(characters: bytes) -> int:
    """The character that follows them."""
    return (sum(characters) & 0x3F) + 0x30


def decoded(characters: Uint8s, width: int) -> Int64s:
    """(n * width,) characters -> (n,): 6 bits each, the most significant first."""
    digits = (characters.reshape(-1, width).astype(np.int64) - 0x30) & 0x3F
    return np.asarray((digits << 6 * np.arange(width - 1, -1, -1)).sum(axis=1), np.int64)


def payload(lines: bytes) -> Uint8s | None:
    """The blocks' characters without sums and line ends; None where a sum is wrong."""
    stream = np.frombuffer(lines + b"\n", np.uint8)
    n_whole = len(stream) // (BLOCK + 2) * (BLOCK + 2)
    blocks, rest = stream[:n_whole].reshape(-1, BLOCK + 2), stream[n_whole:]
    right = (blocks[:, :BLOCK].sum(axis=1, dtype=np.int64) & 0x3F) + 0x30 == blocks[:, BLOCK]
    if not (right & (blocks[:, BLOCK + 1] == 10)).all():
        return None
    if len(rest) and (len(rest) < 3 or rest[-2] != sum_of(rest[:-2].tobytes())):
        return None
    return np.concatenate([blocks[:, :BLOCK].ravel(), rest[:-2]])


def clock_of(line: bytes) -> int | None:
    """The ticks of a line with 4 characters and their sum; None where it is not one."""
    if len(line) != 5 or line[4] != sum_of(line[:4]):
        return None
    return int(decoded(np.frombuffer(line[:4], np.uint8), 4)[0])


class Scip:
    """A Hokuyo that speaks SCIP 2.0."""

    clockwise = False

    def __init__(self, laser: Laser, inverted: bool, intensities: bool) -> None:
        self.laser = laser
        self.orders = ("ME", "MD") if intensities else ("MD",)  # with intensities, which an URG does not know; without
        self.ahead = -1.0 if inverted else 1.0
        self.counts = Counts()
        self.trouble = ""
        self.opened(0)

    def opened(self, now: int) -> bytes:
        self.speed: float | None = None
        self.rest = b""
        self.waiting = list(FIRST)
        self.asked = ""
        self.until = now
        self.parameters: dict[str, int] = {}
        self.scanning = False
        self.met: tuple[float, int, int] | None = None
        self.asked_at = now
        self.begun = now  # when the first byte of the answer under way came
        self.last_tick: int | None = None
        self.time = 0.0  # s on the device's clock, unwrapped, of the last sweep
        return b""

    def farewell(self) -> bytes:
        return b"QT\n"

    def due(self, now: int) -> bytes:
        if self.scanning or now < self.until:
            return b""
        if not self.waiting:
            return self.opened(now)
        self.asked = self.waiting.pop(0)
        self.asked_at, self.until = now, now + PATIENCE
        return self.asked.encode() + b"\n"

    def received(self, data: bytes, now: int) -> list[Returns]:
        if not self.rest:
            self.begun = now
        self.rest += data
        *answers, self.rest = self.rest.split(b"\n\n")
        if len(self.rest) > LONGEST:
            self.rest = self.rest[-BLOCK:]
            self.counts.n_resyncs += 1
        found = []
        for answer in answers:
            found += self._understood(answer, now)
            self.begun = now
        return found

    def _understood(self, answer: bytes, now: int) -> list[Returns]:
        answer = answer.replace(b"\r", b"").lstrip(b"\n")
        echo = self.asked.encode()
        kind = echo[:2]
        if kind in SCANS:
            at = answer.rfind(echo[:13])  # long enough to be told from data; what is left of a scan is not repeated
        else:
            at = 0 if echo and answer.startswith(echo + b"\n") else answer.rfind(b"\n" + echo + b"\n") + 1 or -1
        if at < 0:
            self.counts.n_bad += bool(answer)
            return []
        self.counts.n_resyncs += at > 0
        _, _, rest = answer[at:].partition(b"\n")
        status, _, rest = rest.partition(b"\n")
        if kind in SCANS and status == b"99b":
            return self._sweep(kind, rest, 0 if at > 0 else now - self.begun)
        if len(status) == 3 and status[2] != sum_of(status[:2]):
            self.counts.n_bad += 1
        else:
            self.counts.n_good += 1
            self._answered(kind, status[:2].decode("ascii", "replace"), rest)
        return []

    def _answered(self, kind: bytes, status: str, rest: bytes) -> None:
        if kind == b"PP":
            found = re.findall(rb"([A-Z]{4}): *(\d{1,9})", rest)
            self.parameters = {key.decode(): int(value) for key, value in found}
            if not self._request():
                return
        if self.asked == "TM1" and status == "00":
            tick = clock_of(rest.split(b"\n")[0])
            if tick is not None:
                self.last_tick, self.time = tick, 0.0
                self.met = TICK / 2, self.asked_at, self.begun
        if kind in SCANS or kind == b"BM":
            broken = status.isdecimal() and int(status) in HARDWARE
            self.trouble = f"the laser reports a fault of its hardware, status {status}" if broken else ""
            if kind in SCANS and status != "00":
                if self.waiting:
                    self.until = 0  # the next order is one that it may know
                    return
                self.trouble = self.trouble or f"the laser refuses to scan, status {status}"
                return  # asked anew when patience ends
            self.scanning = kind in SCANS
        self.until = 0  # the next question need not wait

    def _request(self) -> bool:
        """Orders the steps that cover the grid; False where the laser's parameters make no sense."""
        try:
            per_turn, low, high, front, rpm = (self.parameters[k] for k in ("ARES", "AMIN", "AMAX", "AFRT", "SCAN"))
        except KeyError:
            return False
        if not (0 <= low < high <= 9999 and per_turn > 0):
            return False
        laser = self.laser
        step = 2 * pi / per_turn
        ends = laser.angle_min, laser.angle_min + (laser.n_beams - 1) * laser.angle_increment
        first, last = (front + round(f(self.ahead * end for end in ends) / step) for f in (min, max))
        if first < low or last > high or first >= last:  # wider than it sees, or counted over another turn
            first, last = low, high
        self.first, self.step, self.front = first, step, front
        self.cluster = min(max(1, int(abs(laser.angle_increment) / step + 0.01)), 99)
        self.n = (last - first) // self.cluster + 1
        self.speed = rpm / 60
        self.period = 60 / max(rpm, 1)
        steps = f"{first:04d}{last:04d}{self.cluster:02d}000"
        self.waiting = [*TIME, "BM", *(order + steps for order in self.orders)]
        return True

    def _sweep(self, kind: bytes, rest: bytes, age: int) -> list[Returns]:
        """age: ns since its first byte came; 0 where other bytes came before it, so that nobody knows."""
        clock, _, blocks = rest.partition(b"\n")
        characters = payload(blocks)
        tick = clock_of(clock)
        if tick is None or characters is None or len(characters) != CHARACTERS[kind] * self.n:
            self.counts.n_bad += 1
            return []
        self.counts.n_good += 1
        self.scanning, self.trouble = True, ""
        elapsed, restarted = since(np.array([tick]), self.last_tick, TIME_WRAP, MOST_BACK)
        self.last_tick = tick
        self.time += float(elapsed[0]) * TICK
        values = decoded(characters, 3).reshape(self.n, -1)  # a distance, with ME an intensity, too
        mm = values[:, 0]
        bright = values[:, 1].clip(0, 65535).astype(np.float32) if values.shape[1] == 2 else None
        ranges: Float32s = np.where(mm >= ERRORS_BELOW, mm * 1e-3, np.nan).astype(np.float32)
        middle = self.first + np.arange(self.n) * self.cluster + (self.cluster - 1) / 2
        angles = ((middle - self.front) * self.step).astype(np.float64)
        times = (self.time + TICK / 2 + (angles + pi) / (2 * pi) * self.period).astype(np.float64)
        return [Returns(angles, ranges, bright, times, times[-1:] - TICK / 2, np.array([age * 1e-9]), restarted)]
