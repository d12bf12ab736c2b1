# SPDX-License-Identifier: Apache-2.0
"""SLAMTEC RPLIDAR A1, A2, A3: asked for its health, its speed of sampling and then to scan, clockwise.

SLAMTEC, 'RPLIDAR interface protocol and application notes', rev. 1.1 (A1, A2) and 2.1: requests are A5 cmd [length,
payload, xor of all]; an answer is a descriptor A5 5A, u32 (30 bits length, 2 bits mode), u8 type, then packets of
that length. It has no clock, but samples at a constant speed: the number of samples is the clock.
"""

from typing import cast

import numpy as np

from services.lidar_driver.device import Bools, Counts, Int64s, Returns, Uint8s, steps_of
from services.lidar_driver.framing import Framing
from services.lidar_driver.rplidar_nodes import Nodes

MS = 1_000_000
STOP, RESET, SCAN = b"\xa5\x25", b"\xa5\x40", b"\xa5\x20"
EXPRESS = bytes.fromhex("a5 82 05 00 00 00 00 00 22")  # legacy express scan, working mode 0
INFO, HEALTH, SAMPLE_RATE = b"\xa5\x50", b"\xa5\x52", b"\xa5\x59"
MOTOR = bytes.fromhex("a5 f0 02 94 02 c1")  # 660 of 1023: the speed that SLAMTEC's driver sets
MOTOR_OFF = bytes.fromhex("a5 f0 02 00 00 57")
ANSWERS = {  # descriptor -> bytes of the answer; a stream's are one packet's
    INFO: (bytes.fromhex("a5 5a 14 00 00 00 04"), 20),
    HEALTH: (bytes.fromhex("a5 5a 03 00 00 00 06"), 3),
    SAMPLE_RATE: (bytes.fromhex("a5 5a 04 00 00 00 15"), 4),
    SCAN: (bytes.fromhex("a5 5a 05 00 00 40 81"), 0),
    EXPRESS: (bytes.fromhex("a5 5a 54 00 00 40 82"), 0),
}
MOST_KEPT = 4096  # bytes among which an answer is looked for
FIRST_A2 = 0x20  # models from here on take a motor speed, and scan fully only in express mode
UNHEALTHY = 2
CAPSULE = 84
N_CAPSULE_BEAMS = 32
WIDEST_CAPSULE = 120.0  # degrees: 32 samples of a laser that turns
SPEED_TIME = 0.2  # s of samples from which the speed is found
MOST_RECENT = 15  # capsules from which the speed is found
BACK = 40.0  # degrees by which the first beam after lost ones may lie behind the last one before


def begins(first: Uint8s, second: Uint8s) -> Bools:
    """A capsule's two sync nibbles."""
    return cast(Bools, (first >> 4 == 0xA) & (second >> 4 == 0x5))


def sums(packets: Uint8s) -> Bools:
    """(p, 84) -> (p,): whether the xor of all after the first two bytes is in their low nibbles."""
    total = np.bitwise_xor.reduce(packets[:, 2:], axis=1)
    return cast(Bools, total == (packets[:, 0] & 0xF | (packets[:, 1] & 0xF) << 4))


class Rplidar:
    """An RPLIDAR on a serial line. express: whether to ask for it; None: where the model needs it."""

    clockwise = True

    def __init__(self, baud: int, express: bool | None) -> None:
        self.counts = Counts()
        self.byte_time = 10.0 / baud  # s
        self.express = express
        self.trouble = ""
        self.met = None
        self.opened(0)

    def opened(self, now: int) -> bytes:
        self.speed: float | None = None
        self.asked, self.answered = STOP, False
        self.until = now + 100 * MS  # what was under way on the line has passed by then
        self.rest = b""
        self.model = 0
        self.sample_times = (500e-6, 500e-6)  # s, standard and express, of firmware that does not tell
        self.nodes: Nodes | None = None
        self.capsules: Framing | None = None
        self.before: Uint8s | None = None  # the last capsule; its angles are known when the next one begins
        self.time = 0.0  # s on the clock that its sampling is
        self.degrees: float | None = None  # of the last beam
        self.turned, self.turned_in = 0.0, 0.0  # turns, and s that they took, since the speed was last found
        self.recent: list[float] = []  # degrees from capsule to capsule
        return STOP

    def farewell(self) -> bytes:
        return STOP + (MOTOR_OFF if self.model >= FIRST_A2 else b"")

    @property
    def scanning(self) -> bool:
        return self.nodes is not None or self.capsules is not None

    def due(self, now: int) -> bytes:
        if self.scanning:
            return b""
        if self.answered:
            if self.asked == INFO:
                return self._ask(HEALTH, now, 500)
            if self.asked == HEALTH:
                return self._ask(RESET, now, 2000) if self.trouble else self._ask(SAMPLE_RATE, now, 500)
            return self._scan(now)
        if now < self.until:
            return b""
        if self.asked in (STOP, RESET):
            return self._ask(INFO, now, 500)
        if self.asked == SAMPLE_RATE:
            return self._scan(now)  # firmware before 1.17 does not know the question
        return self.opened(now)

    def _ask(self, request: bytes, now: int, patience: int) -> bytes:
        """patience: ms."""
        self.asked, self.answered, self.until, self.rest = request, False, now + patience * MS, b""
        return request

    def _scan(self, now: int) -> bytes:
        express = self.model >= FIRST_A2 if self.express is None else self.express
        motor = MOTOR if self.model >= FIRST_A2 else b""
        return motor + self._ask(EXPRESS if express else SCAN, now, 2000)

    def received(self, data: bytes, now: int) -> list[Returns]:
        if not self.scanning:
            data = self._answered(data, now)
        if self.nodes is not None:
            return self._from_nodes(*self.nodes.cut(data))
        if self.capsules is not None:
            return self._from_capsules(*self.capsules.cut(data))
        return []

    def _answered(self, data: bytes, now: int) -> bytes:
        """Takes the answer to what was asked; gives back what follows it when a scan has begun."""
        if self.asked not in ANSWERS or self.answered:
            return b""
        self.rest = (self.rest + data)[-MOST_KEPT:]
        descriptor, length = ANSWERS[self.asked]
        at = self.rest.find(descriptor)
        answer = self.rest[at + len(descriptor) :]
        if at < 0 or len(answer) < length:
            return b""
        if self.asked == INFO:
            self.model = answer[0]
        elif self.asked == HEALTH:
            code = answer[1] | answer[2] << 8
            self.trouble = f"the laser reports a health error, code {code}" if answer[0] == UNHEALTHY else ""
        elif self.asked == SAMPLE_RATE:
            standard, express = answer[0] | answer[1] << 8, answer[2] | answer[3] << 8
            self.sample_times = max(standard, 20) * 1e-6, max(express, 20) * 1e-6
        elif self.asked == SCAN:
            self.nodes = Nodes(self.counts)
        else:
            self.capsules = Framing(CAPSULE, begins, sums, self.counts)
        self.answered, self.rest = True, b""
        return answer

    def _from_nodes(self, nodes: Uint8s, after: Int64s, anew: Bools) -> list[Returns]:
        if not len(nodes):
            return []
        words = nodes[:, 1::2].astype(np.int64) | nodes[:, 2::2].astype(np.int64) << 8
        degrees = (words[:, 0] >> 1) / 64
        steps = steps_of(degrees, float(degrees[0]) if self.degrees is None else self.degrees)
        turned = np.where(anew, (steps + BACK) % 360 - BACK, (steps + 180) % 360 - 180)
        sample_time = self.sample_times[0]
        n_samples = np.ones(len(nodes))
        if self.speed:  # as many were lost as it turned meanwhile
            n_samples = np.where(anew, np.maximum(np.rint(turned / 360 / self.speed / sample_time), 1), 1)
        times = self.time + np.cumsum(n_samples * sample_time)
        self.time = float(times[-1])
        self.turned += float(turned[~anew].sum()) / 360
        self.turned_in += float(np.count_nonzero(~anew)) * sample_time
        if self.turned_in >= SPEED_TIME:
            self.speed = max(self.turned / self.turned_in, 0.0)
            self.turned, self.turned_in = 0.0, 0.0
        self.degrees = float(degrees[-1])
        returns = Returns(
            angles=-np.radians(degrees),
            ranges=np.where(words[:, 1] > 0, words[:, 1] * 0.25e-3, np.nan).astype(np.float32),
            intensities=(nodes[:, 0] >> 2).astype(np.float32),
            times=times,
            sent=times,
            ages=np.asarray((after + nodes.shape[1]) * self.byte_time, np.float64),
        )
        return [returns]

    def _from_capsules(self, capsules: Uint8s, after: Int64s) -> list[Returns]:
        """The beams of the capsules before each: where the next one begins tells how far it turned meanwhile."""
        if not len(capsules):
            return []
        joined = capsules if self.before is None else np.concatenate([self.before, capsules])
        self.before = capsules[-1:]
        words = joined[:, 2].astype(np.int64) | joined[:, 3].astype(np.int64) << 8
        starts, anew = (words & 0x7FFF) / 64, words >> 15 > 0
        sample_time = self.sample_times[1]
        turned = np.diff(starts) % 360
        self.recent = (self.recent + turned.tolist())[-MOST_RECENT:]
        nominal = float(np.median(self.recent)) if len(self.recent) > MOST_RECENT // 2 else 0.0
        self.speed = nominal / 360 / (N_CAPSULE_BEAMS * sample_time) if nominal else self.speed
        passed = np.ones(len(turned))  # capsules from each to the next
        if nominal:
            passed = np.maximum(np.rint(turned / nominal), 1)
        n_capsules = np.concatenate([np.ones(len(capsules) - len(turned)), passed])
        ends = self.time + np.cumsum(n_capsules) * N_CAPSULE_BEAMS * sample_time
        self.time = float(ends[-1])
        whole = ~anew[1:] & (passed == 1) & (turned < WIDEST_CAPSULE) & (turned > 0)
        if not whole.any():
            return []
        cabins = joined[:-1][whole, 4:].reshape(-1, 16, 5).astype(np.int64)
        pairs = np.stack([cabins[:, :, 0] | cabins[:, :, 1] << 8, cabins[:, :, 2] | cabins[:, :, 3] << 8], axis=2)
        offsets = np.stack([cabins[:, :, 4] & 0xF, cabins[:, :, 4] >> 4], axis=2) | (pairs & 3) << 4
        mm = (pairs >> 2).reshape(-1, N_CAPSULE_BEAMS)
        place = np.arange(N_CAPSULE_BEAMS)
        degrees = starts[:-1][whole, None] + turned[whole, None] * (place / N_CAPSULE_BEAMS)
        degrees = degrees - offsets.reshape(-1, N_CAPSULE_BEAMS) / 8
        began = (ends[-len(turned) :] - N_CAPSULE_BEAMS * sample_time)[whole]  # when the next capsule began
        returns = Returns(
            angles=-np.radians(degrees).ravel(),
            ranges=np.where(mm > 0, mm * 1e-3, np.nan).ravel().astype(np.float32),
            intensities=None,
            times=(began[:, None] + (place + 1 - N_CAPSULE_BEAMS) * sample_time).ravel(),
            sent=ends,
            ages=np.asarray((after + CAPSULE) * self.byte_time, np.float64),
        )
        return [returns]
