# SPDX-License-Identifier: Apache-2.0
"""An emulated laser on its line: its bytes, late as they are sent, and spoiled by faults."""

import numpy as np

from services.sim.hardware.faults import ActiveFaults
from services.sim.hardware.lasers import LaserEmulator
from shared.messages import LaserScan
from shared.topics import Publication, Topic

MAX_QUEUED_NS = 1_000_000_000  # ahead; bytes farther ahead are of a clock that was set back


class LaserLine:
    """One laser. Without an emulator its scans stay messages. Times are ns.

    name: of its port, with which its faults begin.
    """

    def __init__(
        self, name: str, topic: Topic[LaserScan], emulator: LaserEmulator | None, faults: ActiveFaults, noise: list[int]
    ) -> None:
        """noise: seed of the bytes under the fault `garbage`."""
        self.name, self.topic, self.emulator, self.faults = name, topic, emulator, faults
        self._noise = np.random.default_rng(noise)
        self._queue: list[tuple[int, bytes]] = []  # bytes that the laser sends later, and when

    def receive(self, data: bytes, now: int) -> bytes:
        """The laser's answer to a driver's bytes, as it arrives."""
        if self.emulator is None:
            return b""
        return self._arriving(self.emulator.receive(b"" if self._has("stalled") else data, now))

    def sweep_bytes(self, scans: list[LaserScan], now: int) -> bytes:
        """Queues the bytes of these sweeps. Returns those that are due, as they arrive."""
        if self.emulator is None:
            return b""
        self.emulator.turning = not self._has("stopped")
        self._queue += [chunk for scan in scans for chunk in self.emulator.sweep_chunks(scan, now)]
        due = [data for when, data in self._queue if when <= now]
        self._queue = [(when, data) for when, data in self._queue if now < when <= now + MAX_QUEUED_NS]
        return self._arriving(b"".join(due))

    def messages(self, scans: list[LaserScan]) -> list[Publication]:
        """The scans of a laser without an emulator, unless a fault holds."""
        is_broken = any(map(self._has, ("stopped", "garbage", "stalled", "unplugged")))
        return [] if self.emulator is not None or is_broken else [self.topic(scan) for scan in scans]

    def _arriving(self, data: bytes) -> bytes:
        """What arrives of what the laser says."""
        if self._has("stalled"):
            return b""
        return self._noise.bytes(len(data)) if self._has("garbage") else data

    def _has(self, fault: str) -> bool:
        return f"{self.name}_{fault}" in self.faults
