# SPDX-License-Identifier: Apache-2.0
"""Bytes of each protocol as its public document has them."""

import re
from math import nan

import pytest

from services.base_driver.boards.create2 import drive_direct
from services.base_driver.boards.kobuki import control_packet
from services.base_driver.boards.odrive import answer_values, request_line
from services.base_driver.boards.velocity import VelocityBoard
from shared.board_framing import LineCounts, LineFramer, PacketReader, crc16, xor
from shared.velocity_board import framed_line, is_newer, line_fields
from tests.unit.services.base_driver.boards.wired import WiredBoard
from zenav.stack.launch import ROOT


def test_the_crc_is_xmodem_s_check_value():
    assert crc16(b"123456789") == 0x31C3  # catalogue of CRC algorithms, CRC-16/XMODEM
    assert crc16(b"456789", crc16(b"123")) == 0x31C3


def test_a_kobuki_s_base_control():
    """Straight at 200 mm/s: speed 00C8, radius 0. Identifier 1, length 4, little-endian."""
    assert control_packet(0.2, 0.0) == bytes.fromhex("AA55 06 01 04 C800 0000 CB")
    on_the_spot = control_packet(0.0, 1.0)
    assert on_the_spot[5:9] == bytes.fromhex("7300 0100")  # 115 mm/s, radius 1
    left_arc, right_arc = control_packet(0.2, 0.5), control_packet(0.2, -0.5)
    assert left_arc[5:9] == (258).to_bytes(2, "little") + (400).to_bytes(2, "little")
    assert right_arc[5:9] == (258).to_bytes(2, "little") + (-400).to_bytes(2, "little", signed=True)
    assert xor(left_arc[2:]) == 0


def test_a_create2_s_drive_direct_has_the_right_wheel_first():
    assert drive_direct(-0.2, 0.5) == bytes((145, 0x01, 0xF4, 0xFF, 0x38))
    assert drive_direct(9.0, -9.0) == bytes((145, 0xFE, 0x0C, 0x01, 0xF4))


def test_the_stream_of_the_open_interface_s_document():
    """Its example: packets 29 and 13, with the values 25 and 0; the checksum is 163."""
    frame = bytes((19, 5, 29, 2, 25, 13, 0, 163))
    reader = PacketReader(b"\x13", range(5, 6), lambda packet: sum(packet) % 256 == 0, LineCounts())
    assert reader.packets(b"\x13\x07" + frame + frame[:3]) == [bytes((29, 2, 25, 13, 0))]


def test_an_odrive_s_checksum_is_the_gcode_s():
    assert request_line(b"N3 T0") == b"N3 T0*57\n"  # the RepRap wiki's example of this checksum
    assert answer_values(b"1.5 -2*%d" % xor(b"1.5 -2")) == (1.5, -2.0)
    for wrong in (b"1.5 -2", b"1.5 -2*1", b"unknown command*%d" % xor(b"unknown command"), b"nan*%d" % xor(b"nan")):
        assert answer_values(wrong) is None


def test_a_roboclaw_s_drive_command():
    wired = WiredBoard("roboclaw")
    device = wired.service.serial.device
    device.forget()
    device._must_start = False
    left, right = 1000.0, -2000.0
    data = device.command(-left, right, 0)
    assert data[:10] == bytes((0x80, 37)) + (1000).to_bytes(4, "big") + (-2000).to_bytes(4, "big", signed=True)
    assert crc16(data) == 0


def test_the_bridge_s_letters():
    wired = WiredBoard("ros_arduino_bridge")
    assert wired.service.serial.device.command(-300.0, 600.0, 0) == b"m 10 20\re\r"


def test_the_velocity_board_s_lines():
    assert framed_line(b"V", 7, 250, -500) == b"$V,7,250,-500*%04X\n" % crc16(b"V,7,250,-500")
    assert line_fields(b"noise$V,7,250,-500*%04X" % crc16(b"V,7,250,-500")) == [b"V", b"7", b"250", b"-500"]
    for wrong in (b"", b"$*", b"$V,7*0000", b"V,7*1234", b"$V,7*12345"):
        assert line_fields(wrong) is None
    assert is_newer(0, 65535)
    assert not is_newer(5, 5)
    assert not is_newer(65535, 0)


def test_the_manual_s_line_is_a_report():
    text = (ROOT / "docs" / "velocity_board.md").read_text()
    (line,) = re.findall(r"^ +(\$T,.+\*[0-9A-F]{4})$", text, re.M)
    wired = WiredBoard("velocity")
    received = wired.service.serial.device.receive(line.encode() + b"\n", 1, 1)
    assert received.report.battery == 7.4
    assert received.n_reports == 1


@pytest.mark.parametrize(
    "fields",
    [
        (b"T", 1, 20, 0, 0, 7400, "", 1),
        (b"T", 1, 20, 0, "G", 7400, "", 1, 2),
        (b"T", 1, 20, 0, 0, 7400, "", 1, ""),
        (b"X", 1, 20, 0, 0, 7400, "", 1, 2),
        (b"T",),
    ],
)
def test_a_line_with_other_fields_is_no_report(fields):
    wired = WiredBoard("velocity")
    device: VelocityBoard = wired.service.serial.device
    received = device.receive(framed_line(*fields), 1, 1)
    assert (received.report, received.n_reports, device.counts.n_good) == (None, 0, 0)
    assert (device.counts.n_bad, device.counts.n_unreadable) == (0, 1)


def test_a_velocity_board_with_other_fields_is_not_said_to_have_wrong_checksums():
    wired = WiredBoard("velocity").run(0.2, 0.0)
    wired.is_connected = False
    for k in range(40):
        wired.say(framed_line(b"T", k, 20 * k, 0, 0, 7400, "", 1, 2, 3))
        wired.run(0.02)
    status = wired.status()
    assert status.fault == "board_silent"
    assert "right checksums, but their fields are wrong" in status.detail
    wired.say(b"$T,1,20,0,0,7400,,1,2*0000\n")
    assert wired.service.serial.device.counts.n_bad == 1


def velocity_board_takes(*lines):
    """Of lines (seq, ms, counts, s when they come): the counts of those that are reports, and the restarts."""
    device = WiredBoard("velocity").service.serial.device
    counts, n_restarts = [], 0
    for sequence, ms, count, seconds in lines:
        now = round(seconds * 1e9)
        received = device.receive(framed_line(b"T", sequence, ms, 0, 0, "", "", count, count), now, now)
        counts += [received.report.right_counts] if received.report else []
        n_restarts += received.restarted
    assert device.counts.n_bad == 0
    return counts, n_restarts


@pytest.mark.parametrize("minutes", [1, 12, 15, 20])
def test_the_velocity_board_s_first_line_after_any_silence_counts(minutes):
    n, ms = 10 + minutes * 3000, 200 + minutes * 60_000
    after = (n % 65536, ms, 7, 1 + minutes * 60)
    assert velocity_board_takes((10, 200, 5, 1), after) == ([5, 7], 0)
    assert velocity_board_takes((10, 200_000, 5, 1), (9, 180, 1, 2.1)) == ([5, 1], 1)


def test_exchanged_and_repeated_lines_of_the_velocity_board_are_dropped_and_a_restart_is_none_of_them():
    first = (10, 2000, 5, 1.0)
    exchanged = (12, 2040, 7, 1.04), (11, 2020, 6, 1.05), (12, 2040, 7, 1.06), (13, 2060, 8, 1.07)
    assert velocity_board_takes(first, *exchanged) == ([5, 7, 8], 0)
    assert velocity_board_takes((0, 2020, 5, 1.0), (65535, 2000, 4, 1.02), (1, 2040, 6, 1.04)) == ([5, 6], 0)
    assert velocity_board_takes(first, (1, 20, 0, 1.5), (2, 40, 1, 1.52)) == ([5, 0, 1], 1)


def test_unknown_measurements_of_the_velocity_board_stay_unknown():
    wired = WiredBoard("velocity")
    received = wired.service.serial.device.receive(framed_line(b"T", 1, 20, 0, 0, "", "", 1, 2), 1, 1)
    assert received.report.battery != received.report.battery, nan
    assert received.yaw_rate is None


def test_a_line_reader_keeps_little_of_noise():
    framer = LineFramer()
    assert framer.lines(b"x" * 10_000) == []
    assert framer.lines(b"\r\n\r\nab\rcd\n") == [b"x" * 120, b"ab", b"cd"]
