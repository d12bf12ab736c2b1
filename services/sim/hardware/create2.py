# SPDX-License-Identifier: Apache-2.0
"""The emulated Create 2: reads opcodes, streams the packets that were asked for. In passive mode its wheels stand.

It has no watchdog: a command stands until the next one. In safe mode a cliff makes it passive, as the real one.
"""

from struct import pack, unpack

from services.sim.hardware.electronics import BodyTruth, WheelElectronics
from shared.config import Robot
from shared.messages import BoardReport

OFF, PASSIVE, SAFE = range(3)  # modes
ARGUMENTS = {128: 0, 131: 0, 132: 0, 145: 4, 150: 1, 173: 0}  # bytes after an opcode; of 148 the first is their number
CLIFFS = ("left", "front_left", "front_right", "right")


class Create2Electronics(WheelElectronics):
    """State of the interface. Unknown opcodes are skipped."""

    HAS_CONTACTS = True
    WRAP = 65536

    def __init__(self, robot: Robot) -> None:
        super().__init__(robot)
        self.mode = OFF
        self._received = b""
        self._streamed: tuple[int, ...] = ()

    def restart(self) -> None:
        super().restart()
        self.mode, self._received, self._streamed = OFF, b"", ()

    def receive(self, data: bytes, now: int) -> bytes:
        self._received += data
        while self._received:
            opcode = self._received[0]
            known = 1 + self._received[1] if opcode == 148 and len(self._received) > 1 else ARGUMENTS.get(opcode, 0)
            length = 2 if opcode == 148 and len(self._received) < 2 else 1 + known
            if len(self._received) < length:
                break
            arguments, self._received = self._received[1:length], self._received[length:]
            self._obey(opcode, arguments, now)
        return b""

    def packets(self, truth: BoardReport, body: BodyTruth, now: int) -> list[bytes]:
        if self.mode == SAFE and body.cliffs:
            self.mode = PASSIVE
            self.turn_wheels(0.0, 0.0, now)
        if self.mode == OFF or not self._streamed:
            return []
        left, right = self.counters(truth)
        volts = round(truth.battery * 1e3) if truth.battery >= 0 else 0
        data = {
            7: pack("B", ("right" in body.bumpers) | ("left" in body.bumpers) << 1),
            **{9 + i: pack("B", name in body.cliffs) for i, name in enumerate(CLIFFS)},
            14: b"\0",
            22: pack(">H", min(volts, 65535)),
            35: bytes((self.mode,)),
            43: pack(">H", left),
            44: pack(">H", right),
            54: pack(">h", round(float(truth.currents[0]) * 1e3)),
            55: pack(">h", round(float(truth.currents[1]) * 1e3)),
        }
        content = b"".join(bytes((packet,)) + data[packet] for packet in self._streamed if packet in data)
        stream = bytes((19, len(content))) + content
        return [stream + bytes((-sum(stream) % 256,))]

    def _obey(self, opcode: int, arguments: bytes, now: int) -> None:
        if opcode == 128:
            self.mode = PASSIVE
            self.turn_wheels(0.0, 0.0, now)
        elif self.mode == OFF:
            return
        elif opcode in (131, 132):
            self.mode = SAFE
        elif opcode == 145 and self.mode == SAFE:
            right, left = unpack(">hh", arguments)
            self.drive_wheels(left * 1e-3, right * 1e-3, now)
        elif opcode == 148:
            self._streamed = tuple(arguments[1:])
        elif opcode == 150 and arguments == b"\0":
            self._streamed = ()
        elif opcode == 173:
            self.restart()
