# SPDX-License-Identifier: Apache-2.0
"""The reference firmware of the velocity board, compiled for this computer, with the base driver at its other end."""

import shutil
import subprocess
from pathlib import Path

import pytest

from services.base_driver.config import BaseDriverConfig
from services.base_driver.service import BaseDriverService
from shared import topics
from shared.config import load_robot
from shared.messages import PortState, SerialData, Velocity
from shared.velocity_board import TICK_WRAP, BoardFlags, framed_line, line_fields

ROOT = Path(__file__).resolve().parent.parent.parent
FIRMWARE = ROOT / "firmware" / "velocity_board"
COMPILER = shutil.which("g++")
MS = 1_000_000
T0 = 10**12
CONFIG = BaseDriverConfig.model_validate({"port": {"device": "/dev/ttyACM0"}, "board": {"model": "velocity"}})

pytestmark = pytest.mark.skipif(COMPILER is None, reason="no g++ on this computer")


def robot():
    """The robot that the firmware's constants describe."""
    file = load_robot("x80sv").robot
    sizes = {"wheel_radius": 0.0325, "wheel_distance": 0.15, "counts_per_turn": 1320, "encoder_wrap": TICK_WRAP}
    return file.model_copy(update={"ranges": (), "drive": file.drive.model_copy(update=sizes)})


@pytest.fixture(scope="module")
def program(tmp_path_factory):
    path = tmp_path_factory.mktemp("firmware") / "host_board"
    source = Path(__file__).with_name("host_board.cpp")
    options = ["-std=c++11", "-O1", "-Wall", "-Wextra", "-Werror", "-I", str(FIRMWARE)]
    subprocess.run([COMPILER, *options, str(source), "-o", str(path)], check=True, timeout=120)
    return path


class FirmwareBench:
    """The firmware and a base driver, in periods of 20 ms."""

    def __init__(self, program, first=0):
        pipes = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE}
        self.board = subprocess.Popen([str(program), str(first)], text=True, bufsize=1, **pipes)
        self.driver = BaseDriverService(CONFIG, robot())
        self.driver.now = T0
        self.out, self.to_board, self.lines = [], b"", []
        self.is_pressed, self.passed_ms = False, 0
        self.take(self.driver.port(PortState(T0, "board", True, "")))

    def take(self, outputs):
        for publication in outputs:
            self.out.append((publication.topic.key, publication.message))
            if publication.topic is topics.TX:
                self.to_board += publication.message.data

    def exchange(self):
        """One period of the firmware: the bytes for it go in, its line comes out."""
        self.board.stdin.write(f"{self.to_board.hex()} {int(self.is_pressed)} {self.passed_ms}\n")
        self.board.stdin.flush()
        self.to_board, self.passed_ms = b"", 0
        self.lines.append(self.board.stdout.readline().encode())
        return self.lines[-1]

    def run(self, seconds, v=None, w=0.0, driver=True):
        for _ in range(round(seconds * 50)):
            if v is not None:
                self.take(self.driver.command(Velocity(self.driver.now, v, w, "")))
            if driver:
                self.take(self.driver.drive())
            else:
                self.to_board = b""
            line = self.exchange()
            self.driver.now += 20 * MS
            self.take(self.driver.receive_bytes(SerialData(self.driver.now, "board", line)))
        return self

    def last(self, topic):
        return next(message for key, message in reversed(self.out) if key == topic.key)

    @property
    def fields(self):
        return line_fields(self.lines[-1].rstrip())

    @property
    def flags(self):
        return BoardFlags(int(self.fields[4], 16))

    def close(self):
        self.board.stdin.close()
        self.board.stdout.close()
        assert self.board.wait(timeout=10) == 0


@pytest.fixture
def bench(program):
    made = FirmwareBench(program)
    yield made
    made.close()


def test_the_firmware_drives_the_velocity_that_it_is_given(bench):
    bench.run(0.2, 0.0).run(2.0, 0.3, 0.5)
    wheels = bench.last(topics.WHEELS)
    assert wheels.left_speed * 0.0325 == pytest.approx(0.3 - 0.5 * 0.075, abs=0.01)
    assert wheels.right_speed * 0.0325 == pytest.approx(0.3 + 0.5 * 0.075, abs=0.01)
    assert bench.driver.fault == ""
    assert bench.driver.serial.device.counts.n_bad == 0
    bench.run(1.0, 0.0)
    assert bench.last(topics.WHEELS).left_speed == pytest.approx(0, abs=0.1)


def test_the_driver_s_last_sequence_is_acknowledged_and_the_battery_is_sent(bench):
    bench.run(0.5, 0.2)
    assert int(bench.fields[3]) == bench.driver.serial.device._sequence
    assert bench.last(topics.REPORT).battery == pytest.approx(7.4)


def test_without_commands_the_firmware_stops_after_200_ms(bench):
    bench.run(0.2, 0.0).run(1.0, 0.3).run(0.16, driver=False)
    assert BoardFlags.WATCHDOG not in bench.flags
    bench.run(0.06, driver=False)
    assert BoardFlags.WATCHDOG in bench.flags
    bench.run(0.5, driver=False)
    before = bench.fields[7:]
    bench.run(0.5, driver=False)
    assert bench.fields[7:] == before


def test_a_command_does_not_count_again_when_the_clock_of_32_bits_comes_round(bench):
    bench.run(0.2, 0.0).run(1.0, 0.3).run(1.0, driver=False)
    stood = bench.fields[7:]
    bench.passed_ms = 2**32 - 1100  # 49.7 days of silence
    bench.run(1.0, driver=False)
    assert bench.fields[7:] == stood


def test_the_emergency_stop_stops_and_its_release_alone_moves_nothing(bench):
    bench.run(0.2, 0.0).run(1.0, 0.3)
    bench.is_pressed = True
    bench.run(0.6, 0.0)
    assert BoardFlags.ESTOP in bench.flags
    stood = bench.fields[7:]
    bench.to_board = framed_line(b"V", 60000, 300, 0)
    bench.exchange()
    assert bench.fields[7:] == stood
    bench.is_pressed = False
    bench.run(0.5, driver=False)
    assert bench.fields[7:] == stood


@pytest.mark.parametrize(
    "data",
    [
        b"$V,900,300,0*0000\n",
        framed_line(b"V", 900, 300, 0)[:-3] + b"\n",
        framed_line(b"V", 900, 300),
        framed_line(b"V", 900, 300, 0, 0),
        framed_line(b"V", 900, "", 0),
        framed_line(b"W", 900, 300, 0),
        b"$" * 500 + b"\n",
        bytes(range(256)) * 3,
    ],
)
def test_a_damaged_or_unknown_line_moves_nothing(bench, data):
    bench.to_board = data
    bench.exchange()
    bench.run(0.3, driver=False)
    assert bench.fields[7:] == [b"0", b"0"]
    assert bench.fields[3] == b"0"


def test_an_old_or_repeated_command_is_dropped(bench):
    for sequence, v in ((65535, 0), (1, 100), (65530, 300), (1, 300), (2, 100)):
        bench.to_board = framed_line(b"V", sequence, v, 0)
        bench.exchange()
    assert bench.fields[3] == b"2"


@pytest.mark.parametrize("first", [2**31 - 300, -300])
def test_the_firmware_s_counters_overflow_without_a_jump(program, first):
    bench = FirmwareBench(program, first).run(0.2, 0.0).run(2.0, 0.3)
    angle = bench.last(topics.WHEELS).left
    assert 15 < angle < 19
    assert bench.driver.encoders.n_jumps == 0
    bench.close()
