# SPDX-License-Identifier: Apache-2.0
"""Hokuyo URG, UTM and UST by SCIP 2.0, serial or TCP: requests of its parameters, then a continuous scan.

Hokuyo, 'Communication protocol specification for SCIP2.0 standard', C-42-03320. An answer is a group of
lines that ends with an empty line: echo; status; time, 4 characters; blocks of 64 characters. Each line but the echo
ends with a checksum. Steps run counter-clockwise; the time is that of the sweep straight behind (hokuyo_node's
measurement).
"""

import re
from math import pi

import numpy as np

from services.lidar_driver.device import PacketCounts, Returns, is_before, unwrapped_ticks
from shared.config import Laser
from shared.types import Float32s, Int64s, UInt8s

MS = 1_000_000
TIME_WRAP = 1 << 24  # ticks
TICK = 1e-3  # s
MAX_TICKS_BACK = 500  # ticks; a sweep may begin before the clock reading
MAX_ANSWER_BYTES = 1 << 16  # bytes; over three times the longest known answer
MIN_DISTANCE_MM = 20  # lower values are error codes
BLOCK = 64
ANSWER_TIMEOUT_NS = 700 * MS
START_COMMANDS = ("SCIP2.0", "QT", "PP")  # QT ends a scan of an earlier driver
CLOCK_COMMANDS = ("TM0", "TM1", "TM2")  # the clock is read while the laser is off
N_CHARACTERS = {b"MD": 3, b"ME": 6}  # characters of a step
SCAN_COMMANDS = tuple(N_CHARACTERS)
HARDWARE_FAULTS = range(50, 98)  # status codes of laser or motor faults


def checksum(characters: bytes) -> int:
    """The checksum of characters, itself a character."""
    return (sum(characters) & 0x3F) + 0x30


def decode_characters(characters: UInt8s, width: int) -> Int64s:
    """(n * width,) characters -> (n,): 6 bits each, the most significant first."""
    digits = (characters.reshape(-1, width).astype(np.int64) - 0x30) & 0x3F
    return np.asarray((digits << 6 * np.arange(width - 1, -1, -1)).sum(axis=1), np.int64)


def block_characters(lines: bytes) -> UInt8s | None:
    """The characters of all blocks without checksums and line ends; None if a checksum is wrong."""
    stream = np.frombuffer(lines + b"\n", np.uint8)
    n_whole = len(stream) // (BLOCK + 2) * (BLOCK + 2)
    blocks, buffer = stream[:n_whole].reshape(-1, BLOCK + 2), stream[n_whole:]
    right = (blocks[:, :BLOCK].sum(axis=1, dtype=np.int64) & 0x3F) + 0x30 == blocks[:, BLOCK]
    if not (right & (blocks[:, BLOCK + 1] == 10)).all():
        return None
    if len(buffer) and (len(buffer) < 3 or buffer[-2] != checksum(buffer[:-2].tobytes())):
        return None
    return np.concatenate([blocks[:, :BLOCK].ravel(), buffer[:-2]])


def decode_clock(line: bytes) -> int | None:
    """The ticks of a line with 4 characters and a checksum; None if it is invalid."""
    if len(line) != 5 or line[4] != checksum(line[:4]):
        return None
    return int(decode_characters(np.frombuffer(line[:4], np.uint8), 4)[0])


class Scip:
    """A Hokuyo that speaks SCIP 2.0."""

    clockwise = False

    def __init__(self, laser: Laser, inverted: bool, intensities: bool) -> None:
        self.laser = laser
        self.scan_commands = ("ME", "MD") if intensities else ("MD",)  # a URG does not know ME, with intensities
        self.direction = -1.0 if inverted else 1.0
        self.counts = PacketCounts()
        self.fault = ""
        self.start(0)

    def start(self, now: int) -> bytes:
        self.speed: float | None = None
        self.buffer = b""
        self.commands = list(START_COMMANDS)
        self.command_sent = ""
        self.deadline = now
        self.parameters: dict[str, int] = {}
        self.scanning = False
        self.clock_reading: tuple[float, int, int] | None = None
        self.command_sent_at = now
        self.answer_start = now  # ns, arrival of the first byte of the present answer
        self.last_tick: int | None = None
        self.time = 0.0  # s on the device's clock, unwrapped, of the last sweep
        return b""

    def stop_command(self) -> bytes:
        return b"QT\n"

    def next_command(self, now: int) -> bytes:
        if self.scanning or is_before(self.deadline, now):
            return b""
        if not self.commands:
            return self.start(now)
        self.command_sent = self.commands.pop(0)
        self.command_sent_at, self.deadline = now, now + ANSWER_TIMEOUT_NS
        return self.command_sent.encode() + b"\n"

    def receive(self, data: bytes, now: int) -> list[Returns]:
        if not self.buffer:
            self.answer_start = now
        self.buffer += data
        *answers, self.buffer = self.buffer.split(b"\n\n")
        if len(self.buffer) > MAX_ANSWER_BYTES:
            self.buffer = self.buffer[-BLOCK:]
            self.counts.n_resyncs += 1
        sweeps = []
        for answer in answers:
            sweeps += self._handle_message(answer, now)
            self.answer_start = now
        return sweeps

    def _handle_message(self, answer: bytes, now: int) -> list[Returns]:
        answer = answer.replace(b"\r", b"").lstrip(b"\n")
        echo = self.command_sent.encode()
        kind = echo[:2]
        if kind in SCAN_COMMANDS:
            at = answer.rfind(echo[:13])  # long enough to differ from data; the rest of an echo is not repeated
        else:
            at = 0 if echo and answer.startswith(echo + b"\n") else answer.rfind(b"\n" + echo + b"\n") + 1 or -1
        if at < 0:
            self.counts.n_bad += bool(answer)
            return []
        self.counts.n_resyncs += at > 0
        _, _, buffer = answer[at:].partition(b"\n")
        status, _, buffer = buffer.partition(b"\n")
        if kind in SCAN_COMMANDS and status == b"99b":
            return self._sweep(kind, buffer, 0 if at > 0 else now - self.answer_start)
        if len(status) == 3 and status[2] != checksum(status[:2]):
            self.counts.n_bad += 1
        else:
            self.counts.n_good += 1
            self._handle_answer(kind, status[:2].decode("ascii", "replace"), buffer)
        return []

    def _handle_answer(self, kind: bytes, status: str, buffer: bytes) -> None:
        if kind == b"PP":
            pairs = re.findall(rb"([A-Z]{4}): *(\d{1,9})", buffer)
            self.parameters = {key.decode(): int(value) for key, value in pairs}
            if not self._plan_scan():
                return
        if self.command_sent == "TM1" and status == "00":
            tick = decode_clock(buffer.split(b"\n")[0])
            if tick is not None:
                self.last_tick, self.time = tick, 0.0
                self.clock_reading = TICK / 2, self.command_sent_at, self.answer_start
        if kind in SCAN_COMMANDS or kind == b"BM":
            broken = status.isdecimal() and int(status) in HARDWARE_FAULTS
            self.fault = f"the laser reports a fault of its hardware, status {status}" if broken else ""
            if kind in SCAN_COMMANDS and status != "00":
                if self.commands:
                    self.deadline = 0  # try the next command
                    return
                self.fault = self.fault or f"the laser refuses to scan, status {status}"
                return  # the next try is after the timeout
            self.scanning = kind in SCAN_COMMANDS
        self.deadline = 0  # the next command need not wait

    def _plan_scan(self) -> bool:
        """Plans the commands of a scan that covers the grid; False if the laser's parameters are invalid."""
        try:
            per_turn, low, high, front, rpm = (self.parameters[k] for k in ("ARES", "AMIN", "AMAX", "AFRT", "SCAN"))
        except KeyError:
            return False
        if not (0 <= low < high <= 9999 and per_turn > 0):
            return False
        laser = self.laser
        step = 2 * pi / per_turn
        ends = laser.angle_min, laser.angle_min + (laser.n_beams - 1) * laser.angle_increment
        first, last = (front + round(f(self.direction * end for end in ends) / step) for f in (min, max))
        if first < low or last > high or first >= last:  # outside its field of view, or counted over another turn
            first, last = low, high
        self.first, self.step, self.front = first, step, front
        self.cluster = min(max(1, int(abs(laser.angle_increment) / step + 0.01)), 99)
        self.n = (last - first) // self.cluster + 1
        self.speed = rpm / 60
        self.period = 60 / max(rpm, 1)
        steps = f"{first:04d}{last:04d}{self.cluster:02d}000"
        self.commands = [*CLOCK_COMMANDS, "BM", *(command + steps for command in self.scan_commands)]
        return True

    def _sweep(self, kind: bytes, buffer: bytes, age: int) -> list[Returns]:
        """The beams of a sweep. age: ns since the arrival of its first byte; 0 if unknown, after other bytes."""
        clock, _, blocks = buffer.partition(b"\n")
        characters = block_characters(blocks)
        tick = decode_clock(clock)
        if tick is None or characters is None or len(characters) != N_CHARACTERS[kind] * self.n:
            self.counts.n_bad += 1
            return []
        self.counts.n_good += 1
        self.scanning, self.fault = True, ""
        elapsed, restarted = unwrapped_ticks(np.array([tick]), self.last_tick, TIME_WRAP, MAX_TICKS_BACK)
        self.last_tick = tick
        self.time += float(elapsed[0]) * TICK
        values = decode_characters(characters, 3).reshape(self.n, -1)  # a distance, with ME an intensity, too
        mm = values[:, 0]
        intensities = values[:, 1].clip(0, 65535).astype(np.float32) if values.shape[1] == 2 else None
        ranges: Float32s = np.where(mm >= MIN_DISTANCE_MM, mm * 1e-3, np.nan).astype(np.float32)
        middle = self.first + np.arange(self.n) * self.cluster + (self.cluster - 1) / 2
        angles = ((middle - self.front) * self.step).astype(np.float64)
        times = (self.time + TICK / 2 + (angles + pi) / (2 * pi) * self.period).astype(np.float64)
        return [
            Returns(
                angles=angles,
                ranges=ranges,
                intensities=intensities,
                times=times,
                sent=times[-1:] - TICK / 2,
                ages=np.array([age * 1e-9]),
                restarted=restarted,
            )
        ]
