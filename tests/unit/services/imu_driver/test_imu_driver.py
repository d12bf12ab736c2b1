# SPDX-License-Identifier: Apache-2.0
"""The driver of inertial sensors with the emulators of both, on a clock of the test."""

import subprocess
import sys
from math import pi, radians

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from services.imu_driver.bno055 import READ, START, Bno055
from services.imu_driver.bno085 import LENGTH, Bno085
from services.imu_driver.service import NO_BYTES, NO_SENSE, ImuDriverConfig, ImuDriverService
from services.sim.hardware.imus import make_imu_emulator
from shared import topics
from shared.config import UserError, load_robot
from shared.messages import Imu, PortState, SerialData
from shared.robot import ImuMount
from shared.service import Log
from tests.held_bytes import held_bytes

MODELS = "bno055", "bno085"
MAX_HELD_BYTES = 10_000
TICK = 20_000_000  # ns
MOUNTS = ImuMount(), ImuMount(yaw=pi / 2), ImuMount(yaw=-2.0, upside_down=True)


class Bench:
    """A driver and an emulated sensor on a line, which `damage` may change."""

    def __init__(self, model, mount=MOUNTS[0], **config):
        robot = load_robot("x80sv").robot.model_copy(update={"imu": mount})
        self.driver = ImuDriverService(ImuDriverConfig(model=model, port={"device": "wired"}, **config), robot)
        self.sensor = make_imu_emulator(model, mount)
        self.now, self.heard, self.log, self.sent = 10**12, [], [], b""
        self.damage = lambda data: data
        self.driver.now = self.now
        self.take(self.driver.plugged(PortState(self.now, "imu", True, "")))

    def take(self, out):
        for item in out:
            if isinstance(item, Log):
                self.log.append(item.text)
            elif item.topic is topics.IMU:
                self.heard.append(item.message)
            elif item.topic is topics.TX:
                self.sent += item.message.data

    def run(self, seconds, rate=0.0, x=0.0, y=0.0, z=9.81):
        for _ in range(round(seconds * 50)):
            self.now += TICK
            self.driver.now = self.now
            streamed = self.sensor.measure(Imu(self.now, rate, x, y, z))
            self.take(self.driver.watch())
            asked, self.sent = self.sent, b""
            data = self.damage(streamed + self.sensor.receive(asked))
            if data:
                self.driver.now = self.now + 3_000_000
                self.take(self.driver.receive(SerialData(self.driver.now, "imu", data)))
        return self


@pytest.mark.parametrize("model", MODELS)
@pytest.mark.parametrize("mount", MOUNTS, ids=["as base", "turned", "upside down"])
def test_what_the_sensor_measures_arrives_in_base(model, mount):
    bench = Bench(model, mount).run(1.0).run(2.0, 0.5, 0.3, -0.2, 9.7)
    last = bench.heard[-1]
    assert last.yaw_rate == pytest.approx(0.5, abs=0.01)
    assert (last.acceleration_x, last.acceleration_y) == pytest.approx((0.3, -0.2), abs=0.02)
    assert last.acceleration_z == pytest.approx(9.7, abs=0.02)
    assert bench.driver.fault() == ""
    assert len(bench.heard) > 0.9 * 3 * 50 - 15


@pytest.mark.parametrize("model", MODELS)
def test_the_readings_add_up_to_the_turn_and_their_stamps_rise(model):
    bench = Bench(model).run(1.0)
    bench.heard.clear()
    bench.run(4.0, 1.0).run(2.0, -2.0).run(0.5)
    stamps = np.array([message.stamp for message in bench.heard])
    assert (np.diff(stamps) > 0).all()
    turn = sum(m.yaw_rate * dt * 1e-9 for m, dt in zip(bench.heard[1:], np.diff(stamps), strict=True))
    assert turn == pytest.approx(0.0, abs=0.05)


def test_an_angle_that_wraps_is_no_jump():
    bench = Bench("bno085").run(30.0, 0.7)
    assert max(abs(message.yaw_rate - 0.7) for message in bench.heard[10:]) < 0.05


@pytest.mark.parametrize("model", MODELS)
def test_without_a_port_it_says_so_and_sends_nothing(model):
    driver = ImuDriverService(ImuDriverConfig(model=model), load_robot("x80sv").robot)
    assert driver.state() == "no port: set imu_driver.port.device"
    assert [item for item in driver.watch() if not isinstance(item, Log)] == []


@pytest.mark.parametrize("model", MODELS)
@pytest.mark.parametrize(("damage", "words"), [("silence", NO_BYTES), ("noise", NO_SENSE)])
def test_a_broken_line_is_told_once_gives_no_reading_and_heals(model, damage, words):
    bench, noise = Bench(model).run(1.0), np.random.default_rng(1)
    n = len(bench.heard)
    bench.damage = (lambda data: b"") if damage == "silence" else (lambda data: noise.bytes(len(data)))
    bench.run(3.0, 0.3)
    assert len(bench.heard) == n
    assert bench.log == [f"imu: {words}"]
    bench.damage = lambda data: data
    bench.run(2.0, 0.3)
    assert bench.heard[-1].yaw_rate == pytest.approx(0.3, abs=0.01)
    assert bench.log[-1] == "imu: in order again"


def test_a_bno055_that_lost_its_power_for_a_moment_is_started_again():
    bench = Bench("bno055").run(1.0, 0.2)
    bench.sensor = make_imu_emulator("bno055", MOUNTS[0])  # in mode CONFIG, its registers 0
    bench.run(0.9, 0.2)
    bench.damage = lambda data: b""
    bench.run(0.7, 0.2)
    bench.damage = lambda data: data
    bench.run(1.0, 0.2)
    assert bench.heard[-1].yaw_rate == pytest.approx(0.2, abs=0.01)
    assert bench.heard[-1].stamp > bench.now - 2 * TICK


def test_a_bno055_that_was_reset_and_answers_zeros_is_started_again():
    bench = Bench("bno055").run(1.0, 0.2)
    bench.sensor = make_imu_emulator("bno055", MOUNTS[0])
    bench.run(2.0, 0.2)
    assert bench.heard[-1].yaw_rate == pytest.approx(0.2, abs=0.01)
    assert bench.heard[-1].stamp > bench.now - 2 * TICK


def test_a_port_that_is_plugged_out_and_in_starts_the_sensor_again():
    bench = Bench("bno055").run(1.0, 0.2)
    bench.take(bench.driver.plugged(PortState(bench.now, "imu", False, "unplugged")))
    assert bench.driver.fault() == "unplugged"
    bench.sent = b""
    bench.take(bench.driver.plugged(PortState(bench.now, "imu", True, "")))
    assert bench.sent == START[0]


def test_another_chip_and_a_refusing_one_are_named():
    device = Bno055(115200)
    device.start(0)
    for answer in (b"\xee\x01", b"\xee\x01"):
        device.receive(answer, 0)
        device.next_command(0)
    assert device.receive(b"\xbb\x01\xa1", 0) == []
    assert device.fault == "the chip is no BNO055: its id is 0xa1"
    device.start(0)
    device.receive(b"\xee\x04", 0)
    assert device.fault == "no such register"


def test_a_bus_overrun_is_tried_again_without_a_fault():
    device = Bno055(115200)
    device.start(0)
    device.receive(b"\xee\x07", 0)
    assert device.fault == ""
    assert device.next_command(200_000_000) == START[0]


def test_an_answer_counts_whole_and_alone():
    device = Bno055(115200)
    device.start(0)
    for k in range(len(START)):
        device.receive(b"\xbb\x01\xa0" if k == 2 else b"\xee\x01", 0)
        device.next_command(0)
    assert device.next_command(TICK) == READ
    still = bytes((0xBB, 18)) + bytes(4) + (981).to_bytes(2, "little") + bytes(12)
    assert device.receive(still[:7], 10**8) == []
    (reading,) = device.receive(still[7:], 10**8)
    assert (reading.yaw_rate, reading.z) == (0.0, 9.81)
    assert device.receive(still, 10**8) == []  # it was not asked for
    assert device.next_command(2 * 10**8) == READ
    assert device.receive(still + b"\x00", 2 * 10**8) == []
    device.next_command(4 * 10**8)
    assert device.receive(bytes((0xBB, 18)) + bytes(18), 4 * 10**8) == []  # no gravity: it does not measure
    assert device.counts.n_good == 1


def test_a_packet_of_the_data_sheet_s_form_is_read():
    """The example of section 1.3.5.2: index 0xDE, yaw 0.01 degree, pitch -1.10, roll 20.85; z 0.977 g."""
    example = bytes.fromhex("AA AA DE 01 00 92 FF 25 08 8D FE EC FF D1 03 00 00 00 E7")
    assert len(example) == LENGTH
    device = Bno085(115200)
    device.receive(example, 10**9)
    assert device.counts.n_good == 1
    second = bytearray(example)
    second[3] = 0x33  # half a degree later
    second[-1] = (second[-1] + 0x32) & 0xFF
    (reading,) = device.receive(bytes(second), 10**9 + TICK)
    assert reading.yaw_rate == pytest.approx(radians(0.5) / 0.02)
    assert reading.z == pytest.approx(0.977 * 9.80665, abs=1e-3)


@pytest.mark.parametrize("model", MODELS)
@settings(max_examples=60, deadline=None)
@given(chunks=st.lists(st.binary(max_size=60), max_size=20), at=st.integers(0, 10))
def test_any_bytes_are_survived_and_the_sensor_is_heard_again(model, chunks, at):
    bench = Bench(model).run(0.3)
    for k, chunk in enumerate(chunks):
        bench.damage = lambda data, chunk=chunk, k=k: data[:at] + chunk + data[at:] if k % 2 else chunk
        bench.run(0.02, 0.1)
    bench.damage = lambda data: data
    bench.run(2.5, 0.1)
    assert bench.heard[-1].yaw_rate == pytest.approx(0.1, abs=0.01)
    assert all(abs(message.yaw_rate) <= 50 for message in bench.heard)


@pytest.mark.parametrize("model", MODELS)
def test_a_megabyte_of_noise_leaves_no_megabyte_behind(model):
    bench, random = Bench(model).run(0.3), np.random.default_rng(0)
    for _ in range(250):
        bench.now += TICK
        bench.driver.now = bench.now
        bench.take(bench.driver.receive(SerialData(bench.now, "imu", random.bytes(4096))))
        bench.log.clear()
    assert held_bytes(bench.driver.device) < MAX_HELD_BYTES


def test_an_unknown_emulated_model_is_told_with_the_nearest():
    with pytest.raises(UserError) as error:
        make_imu_emulator("bno05x5", MOUNTS[0])
    assert "bno055" in error.value.hint


def test_the_driver_loads_no_kernels():
    code = "import sys, services.imu_driver.service; sys.stdout.write(str('numba' in sys.modules))"
    assert subprocess.run([sys.executable, "-c", code], capture_output=True, text=True).stdout.strip() == "False"
