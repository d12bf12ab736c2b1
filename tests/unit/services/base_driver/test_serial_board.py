# SPDX-License-Identifier: Apache-2.0
"""A base driver on a serial board: what it makes of the board's bytes, and what it writes."""

from math import isnan, nan

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from services.base_driver.config import BaseDriverConfig
from services.base_driver.service import BaseDriverService
from services.sim.hardware import drrobot as board
from shared import topics
from shared.config import UserError, configured, load_robot
from shared.drrobot import BOARD, Deframer
from shared.messages import BoardReport, EmergencyStop, PortState, SerialData, Velocity
from tests.strategies import faults
from tests.unit.services.base_driver.boards.wired import WiredBoard

ROBOT = load_robot("x80sv").robot
MS = 1_000_000
T0 = 1_000_000 * MS
CONFIG = BaseDriverConfig.model_validate({"port": {"device": "/dev/ttyUSB0"}, "battery": {"empty": 6.0}})


class Wired:
    """A base driver and the far end of its port: a board whose wheels stand, or turn as commanded."""

    def __init__(self, config=CONFIG):
        self.service = BaseDriverService(config, ROBOT)
        self.service.now = T0
        self.out, self.deframer = [], Deframer(BOARD)
        self.counts = [1000.0, 32000.0]
        self.orders, self.acknowledged, self.raw = [], 0, b""
        self.speeds = (0, 0)

    def take(self, outputs):
        for publication in outputs:
            assert not list(faults(publication.message))
            self.out.append((publication.topic.key, publication.message))
            if publication.topic is topics.TX:
                assert publication.message.port == "board"
                self.raw += publication.message.data
                for packet in self.deframer.packets(publication.message.data):
                    order = board.decode_command(packet)
                    self.acknowledged += order is None
                    self.orders.append(order)
                    if isinstance(order, board.VelocityCommand):
                        self.speeds = order.channels[0], order.channels[1]

    def port(self, open_=True, detail=""):
        self.take(self.service.port(PortState(self.service.now, "board", open_, detail)))
        return self

    def says(self, *packets, stamp=None):
        data = b"".join(packets)
        stamp = self.service.now if stamp is None else stamp
        if data:
            self.take(self.service.receive_bytes(SerialData(stamp, "board", data)))

    def motors(self):
        left, right = (round(count) % 32768 for count in self.counts)
        return board.motor_sensor((left, right), self.speeds, (0.5, 0.25))

    def sensors(self, ultrasonic=(50, 60, 70, 255, 255, 255), battery=7.4):
        return board.standard_sensor(ultrasonic, 0.3, battery, 30.0) + board.custom_sensor((0.2,) * 5 + (nan,))

    def run(self, seconds, v=None, w=0.0, says=lambda wired, k: (wired.motors(), wired.sensors())):
        for k in range(round(seconds * 50)):
            if v is not None:
                self.take(self.service.command(Velocity(self.service.now, v, w, "")))
            self.take(self.service.drive())
            self.service.now += 20 * MS
            self.counts = [count + speed * 0.02 for count, speed in zip(self.counts, self.speeds)]
            self.says(*says(self, k))
        return self

    def last(self, topic):
        return next(message for key, message in reversed(self.out) if key == topic.key)

    def status(self):
        self.take(self.service.publish_status())
        return self.last(topics.BASE_STATUS)


def test_a_report_holds_what_the_packets_said():
    wired = Wired().port()
    wired.says(wired.sensors(), wired.motors())
    report = wired.last(topics.REPORT)
    assert (report.left_counts, report.right_counts) == (1000, 32000)
    np.testing.assert_allclose(report.ultrasonic, [0.5, 0.6, 0.7], rtol=1e-6)
    np.testing.assert_allclose(report.infrared, [0.3, *[0.2] * 5, 0.81], rtol=0.01)
    assert report.battery == pytest.approx(7.4, abs=0.006)
    assert report.currents.tolist() == [0.5, 0.25]
    assert report.stamp == wired.service.now
    wheels = wired.last(topics.WHEELS)
    assert (wheels.left, wheels.right) == (0.0, 0.0)


def test_speeds_carry_the_board_s_signs():
    wired = Wired().port()
    wired.speeds = (-50, 60)
    wired.says(wired.motors())
    report = wired.last(topics.REPORT)
    assert (report.left_speed, report.right_speed) == (-50.0, 60.0)
    assert wired.last(topics.WHEELS).left_speed > 0


def test_what_has_not_been_measured_is_not_made_up():
    wired = Wired().port()
    wired.says(wired.motors())
    report = wired.last(topics.REPORT)
    assert np.isnan(report.ultrasonic).all()
    assert np.isnan(report.infrared).all()
    assert isnan(report.battery)
    assert isnan(wired.last(topics.BASE_STATUS).battery)
    assert "battery" not in wired.last(topics.BASE_STATUS).detail


def test_old_ranges_are_forgotten():
    wired = Wired().port().run(0.5)
    assert not np.isnan(wired.last(topics.REPORT).ultrasonic).any()
    wired.run(0.56, says=lambda wired, k: (wired.motors(),))
    report = wired.last(topics.REPORT)
    assert np.isnan(report.ultrasonic).all()
    assert np.isnan(report.infrared).all()


def test_the_latency_is_taken_off_the_stamp():
    config = CONFIG.model_copy(update={"board": CONFIG.board.model_copy(update={"latency": 0.004})})
    wired = Wired(config).port()
    wired.says(wired.motors())
    assert wired.last(topics.REPORT).stamp == T0 - 4 * MS
    wired.says(wired.motors(), stamp=0)
    assert wired.last(topics.REPORT).stamp == 0


def test_a_latency_that_leaves_no_report_young_enough_is_refused_with_both_numbers():
    settings = ["base_driver.board.latency=0.16"]
    with pytest.raises(UserError, match=r"board\.latency: 0\.16 s is too near to board_age, 0\.2 s"):
        configured("x80sv", settings).section("base_driver", BaseDriverConfig)
    config = configured("x80sv", [*settings, "base_driver.board_age=0.3"]).section("base_driver", BaseDriverConfig)
    assert config.board.latency == 0.16
    config = configured("x80sv", ["base_driver.board_age=0.04"]).section("base_driver", BaseDriverConfig)
    assert config.board_age == 0.04, "without a latency any age is a choice"


def test_of_several_reports_at_once_the_last_counts():
    wired = Wired().port()
    wired.says(board.motor_sensor((7, 7), (0, 0), (0, 0)), board.motor_sensor((9, 9), (0, 0), (0, 0)))
    assert [m.left_counts for key, m in wired.out if key == topics.REPORT.key] == [9]


def test_a_command_goes_to_the_board_with_its_time_limit_and_as_a_message():
    wired = Wired().port().run(0.1, 0.0).run(0.1, 0.4)
    message, order = wired.last(topics.MOTORS), wired.orders[-1]
    expected = 0.4 / 0.085 * 756 / (2 * np.pi)
    assert (message.left, message.right) == pytest.approx((-expected, expected))
    assert order.channels == {0: -round(expected), 1: round(expected), **dict.fromkeys(range(2, 6), board.NO_CHANGE)}
    assert order.life == 0.2


def test_gains_and_zero_are_the_first_words_after_each_connection():
    wired = Wired().port()
    gains = [board.GainsCommand(channel, kp=15, kd=0, ki=0) for channel in (0, 1)]
    assert wired.orders[:2] == gains
    assert wired.speeds == (0, 0)
    wired.run(0.5, 0.4).port(False, "unplugged")
    wired.orders.clear()
    wired.run(0.5, 0.4, says=lambda wired, k: ())
    assert wired.orders == [], "nothing is said to a port that is away"
    wired.port()
    assert wired.orders[:2] == gains
    assert wired.orders[2].channels[0] == wired.orders[2].channels[1] == 0
    wired.run(0.6, 0.4)
    assert wired.speeds == (0, 0), "the commander has not asked for zero yet"
    wired.run(0.1, 0.0).run(0.1, 0.4)
    assert wired.speeds[1] > 0


def test_it_says_that_it_waits_for_zero_until_it_has_it():
    wired = Wired().run(0.1).port().run(0.1, 0.4)
    assert wired.last(topics.BASE_STATUS).waits
    assert wired.last(topics.BASE_STATUS).fault == ""
    wired.run(0.1, 0.0)
    assert not wired.last(topics.BASE_STATUS).waits


def test_a_board_that_comes_back_from_silence_gets_its_gains_again():
    wired = Wired().port().run(1.0)
    wired.run(0.6, says=lambda wired, k: ())
    wired.orders.clear()
    wired.run(0.1)
    assert sum(isinstance(order, board.GainsCommand) for order in wired.orders) == 2


def test_a_board_whose_first_bytes_after_silence_end_with_a_ping_gets_its_gains_too():
    wired = Wired().port().run(1.0).run(0.6, says=lambda wired, k: ())
    wired.orders.clear()
    wired.says(wired.motors(), board.system(board.PING))
    wired.run(0.1)
    assert sum(isinstance(order, board.GainsCommand) for order in wired.orders) == 2


def test_every_word_of_the_board_is_acknowledged_once_a_read():
    wired = Wired().port()
    for code in (0, 1, 2, 3):
        wired.acknowledged = 0
        wired.says(board.system(code))
        assert wired.acknowledged == 1
    wired.acknowledged = 0
    wired.says(*[board.system(0)] * 50)
    assert wired.acknowledged == 1


def test_the_last_words_stop_both_wheels_and_take_their_power():
    wired = Wired().port().run(0.1, 0.0).run(0.2, 0.3)
    wired.take(wired.service.on_shutdown())
    assert wired.speeds == (0, 0)
    assert wired.orders[-2:] == [board.DisableCommand(0), board.DisableCommand(1)]
    message = wired.last(topics.MOTORS)
    assert (message.left, message.right) == (0, 0)


def test_without_a_port_the_last_words_are_a_message_and_bytes_say_nothing():
    service = BaseDriverService(BaseDriverConfig(), ROBOT)
    service.now = T0
    assert [p.topic for p in service.on_shutdown()] == [topics.MOTORS]
    motors = board.motor_sensor((1, 1), (0, 0), (0, 0))
    assert list(service.receive_bytes(SerialData(T0, "board", motors))) == []
    assert list(service.port(PortState(T0, "board", True, ""))) == []


def test_with_a_port_reports_of_others_and_other_ports_say_nothing():
    wired = Wired().port()
    nothing = np.empty(0, np.float32)
    report = BoardReport(T0, 1, 2, 0.0, 0.0, nothing, nothing, 7.0, np.zeros(2, np.float32))
    assert list(wired.service.board(report)) == []
    assert list(wired.service.receive_bytes(SerialData(T0, "laser", wired.motors()))) == []
    assert list(wired.service.port(PortState(T0, "laser", False, ""))) == []
    assert wired.service.serial.open


# --- published status -----------------------------------------------------------------------------------------------


def test_counters_rate_supplies_and_temperatures_are_published():
    wired = Wired().port().run(1.0)
    wired.status()
    wired.run(2.0)
    wired.says(b"\x01\x02\x03")
    bad = bytearray(wired.motors())
    bad[10] ^= 1
    wired.says(bytes(bad), wired.motors())
    wired.service.now += 500 * MS
    wired.status()
    status = wired.last(topics.BOARD_IS)
    assert status.good == 3 * 150 + 1
    assert (status.bad_crc, status.resyncs, status.skipped) == (1, 1, 3 + 42)
    assert status.rate == pytest.approx(101 / 2.5)
    assert status.last_heard == pytest.approx(0.5)
    supplies = status.board_supply, status.motor_supply, status.servo_supply
    assert supplies == pytest.approx((7.2, 7.4, 5.0), abs=0.006)
    assert (status.left_temperature, status.right_temperature) == pytest.approx((30, 30), abs=0.1)
    assert status.temperature == pytest.approx(30, abs=0.1)


def test_before_anything_was_heard_the_status_says_so():
    wired = Wired()
    wired.status()
    status = wired.last(topics.BOARD_IS)
    assert (status.good, status.rate) == (0, 0.0)
    assert isnan(status.last_heard)
    assert isnan(status.motor_supply)


def silent(wired, says):
    """The base status after the board has been so for 0.7 s."""
    wired.run(0.7, 0.3, says=says)
    assert wired.speeds == (0, 0)
    return wired.status()


@pytest.mark.parametrize(
    ("says", "words"),
    [
        (lambda wired, k: (), "no byte arrives"),
        (
            lambda wired, k: (b"\x55\xaa" * 20,),
            "bytes arrive, none make sense: check base_driver.port.baud and .device, and .board.model",
        ),
        (lambda wired, k: (wired.motors()[:-3] + b"\x99\x5e\x0d",), "packets arrive, but their checksums are wrong"),
        (lambda wired, k: (wired.sensors(),), "packets arrive, but none of the motors"),
    ],
)
def test_a_silent_board_says_how_it_is_silent(says, words):
    status = silent(Wired().port().run(0.1, 0.0).run(0.3, 0.3), says)
    assert (status.fault, status.link) == ("board_silent", False)
    assert status.detail == words
    assert silent(Wired().port(), says).detail == words


def test_a_port_that_is_away_says_why_at_once():
    wired = Wired().port().run(0.1, 0.0).run(0.3, 0.3)
    assert wired.speeds[1] > 0
    wired.port(False, "/dev/ttyUSB0 is away: plug it in")
    status = wired.last(topics.BASE_STATUS)
    assert (status.fault, status.detail) == ("port_closed", "/dev/ttyUSB0 is away: plug it in")
    message = wired.last(topics.MOTORS)
    assert (message.left, message.right) == (0, 0)
    wired.port(False, "permission denied")
    assert wired.status().detail == "permission denied"
    wired.service.now += 100 * MS
    wired.port()
    wired.run(0.04)
    assert wired.last(topics.BASE_STATUS).fault == ""


def test_what_the_board_reported_before_it_went_is_no_fault_now():
    wired = WiredBoard("kobuki").run(0.5, 0.0)
    wired.service.serial.device.fault = "the board reports too much current of the left wheel"
    wired.service.now += MS
    list(wired.service.port(PortState(wired.service.now, "board", False, "/dev/ttyUSB0 is away")))
    status = wired.status()
    assert (status.fault, status.detail) == ("port_closed", "/dev/ttyUSB0 is away")


def test_a_port_that_never_opened_says_why():
    wired = Wired()
    wired.run(0.3, says=lambda wired, k: ())
    assert wired.status().fault == ""
    wired.port(False, "no such device: /dev/ttyUSB0")
    wired.run(0.3, says=lambda wired, k: ())
    assert (wired.status().fault, wired.status().detail) == ("port_closed", "no such device: /dev/ttyUSB0")


def test_a_half_packet_of_before_the_unplugging_is_forgotten():
    wired = Wired().port().run(0.1)
    wired.says(wired.motors()[:20])
    wired.port(False, "")
    wired.port()
    wired.out.clear()
    wired.says(wired.motors())
    assert wired.last(topics.REPORT).left_counts == 1000


@pytest.mark.parametrize("sonar", [0, 2])
def test_a_sonar_that_reads_zero_twice_is_dead_and_its_return_moves_nothing(sonar):
    def dead(wired, k):
        readings = [50] * 6
        readings[sonar] = 0
        return wired.sensors(tuple(readings)), wired.motors()

    wired = Wired().port().run(0.1, 0.0).run(0.3, 0.3)
    wired.run(0.02, 0.3, says=dead)
    assert wired.last(topics.BASE_STATUS).fault == ""
    wired.run(0.02, 0.3, says=dead)
    status = wired.last(topics.BASE_STATUS)
    assert (status.fault, status.detail) == ("sensor_dead", f"ultrasonic {sonar} does not answer")
    wired.run(0.1, 0.3, says=dead)
    assert wired.speeds == (0, 0)
    wired.run(0.3, 0.3)
    assert wired.last(topics.BASE_STATUS).fault == ""
    assert wired.speeds == (0, 0)
    wired.run(0.1, 0.0).run(0.1, 0.3)
    assert wired.speeds[1] > 0


def test_channels_without_a_sonar_may_read_zero():
    wired = Wired().port().run(1.0, says=lambda wired, k: (wired.sensors((50, 60, 70, 0, 0, 0)), wired.motors()))
    assert wired.status().fault == ""


def test_more_sonars_than_the_board_has_are_a_wrong_number_of_ranges():
    sonar = next(sensor for sensor in ROBOT.ranges if sensor.kind == "ultrasonic")
    wired = Wired()
    wired.service = BaseDriverService(CONFIG, ROBOT.model_copy(update={"ranges": (sonar,) * 8}))
    wired.service.now = T0
    status = wired.port().run(1.0, 0.0).status()
    assert status.fault == "wrong_ranges"
    assert "the board sends 6 ultrasonic ranges, robot.ranges has 8" in status.detail


def test_sensors_that_the_board_does_not_send_are_dead_after_half_a_second():
    wired = Wired().port().run(0.48, says=lambda wired, k: (wired.motors(),))
    assert wired.status().fault == ""
    wired.run(0.08, says=lambda wired, k: (wired.motors(),))
    status = wired.status()
    assert status.fault == "sensor_dead"
    assert status.detail == "the board sends no ultrasonic ranges, the board sends no infrared ranges"
    blind = ROBOT.model_copy(update={"ranges": ()})
    wired = Wired()
    wired.service = BaseDriverService(CONFIG, blind)
    wired.service.now = T0
    wired.port().run(1.0, says=lambda wired, k: (wired.motors(),))
    assert wired.status().fault == ""


def test_an_empty_battery_stands_until_it_has_recovered():
    wired = Wired().port().run(0.1, 0.0).run(0.3, 0.3)
    wired.run(0.2, 0.3, says=lambda wired, k: (wired.sensors(battery=5.5), wired.motors()))
    status = wired.last(topics.BASE_STATUS)
    assert (status.fault, status.detail) == ("battery_empty", "battery low: 5.5 V")
    assert wired.speeds == (0, 0)
    wired.run(0.1, 0.0)
    assert wired.status().fault == ""
    wired.run(0.1, 0.3)
    assert wired.speeds[1] > 0


def test_stop_goes_to_the_board_at_once():
    wired = Wired().port().run(0.1, 0.0).run(0.2, 0.3)
    assert wired.speeds[1] > 0
    wired.take(wired.service.estop(EmergencyStop(wired.service.now, True, "test")))
    assert wired.speeds == (0, 0)


# --- whatever comes -------------------------------------------------------------------------------------------------

pieces = st.one_of(
    st.binary(max_size=60),
    st.sampled_from([b"\x5e\x02\x00\x00\x7b\xff", b"\x5e\x02", b"\x5e"]),
    st.tuples(st.integers(0, 65535), st.integers(0, 65535)).map(lambda c: board.motor_sensor(c, (0, 0), (0, 0))),
    st.builds(board.standard_sensor, st.just((0,) * 6), st.just(nan), st.floats(0, 30), st.floats(-50, 200)),
    st.just(board.custom_sensor((nan,) * 6)),
    st.integers(0, 255).map(board.system),
)
events = st.lists(st.tuples(st.integers(-500, 800), st.none() | st.booleans() | pieces), max_size=40)


@settings(max_examples=80, deadline=None, suppress_health_check=list(HealthCheck))
@given(events)
def test_any_bytes_at_any_time_are_survived_and_the_next_report_counts(sequence):
    wired = Wired()
    for wait, event in sequence:
        wired.service.now = max(0, wired.service.now + wait * MS)
        if event is None:
            wired.take(wired.service.drive())
            wired.status()
        elif isinstance(event, bool):
            wired.port(event)
        else:
            wired.says(event)
    wired.service.now += 10**9
    wired.out.clear()
    wired.says(board.motor_sensor((4711, 4712), (0, 0), (0, 0)))
    assert wired.last(topics.REPORT).left_counts == 4711
    assert wired.service.serial.device.deframer.n_kept < 264
