# SPDX-License-Identifier: Apache-2.0
"""The board's framing against its published examples, and against whatever may come over a line."""

from itertools import pairwise

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from shared.drrobot import ADC_FULL, BOARD, PC, Deframer, Packet, Type, framed

MAX_PACKET_BYTES = 264  # bytes of a packet

EXAMPLES = {
    "acknowledge": "5e 02 01 00 ff 01 01 85 5e 0d",
    "forward": "5e 02 01 00 1b 0c 38 ff c8 00 00 80 00 80 00 80 00 80 76 5e 0d",
    "stop": "5e 02 01 00 1b 0c 00 00 00 00 00 80 00 80 00 80 00 80 2a 5e 0d",
    "gains": "5e 02 01 00 07 0b 08 00 01 0f 00 02 00 00 03 00 00 27 5e 0d",
    "disable": "5e 02 01 00 1e 02 00 01 0b 5e 0d",
    "motors": "5e 02 00 00 7b 21 00 00 00 00 00 00 00 00 00 00 00 00 d8 02 6c 01 00 00 00 00 00 00 00 00 "
    "e8 03 32 00 00 7d 3c 00 02 12 5e 0d",
}
"""As the protocol's description gives them."""

packets = st.builds(Packet, st.integers(0, 255), st.binary(max_size=255))
noise = st.binary(max_size=400) | st.lists(
    st.sampled_from([b"\x5e", b"\x02", b"\x5e\x02\x00", b"\x5e\x02\x00\x00\x7b\xff", b"\x5e\x0d", b"\xff", b"\x00"]),
    max_size=60,
).map(b"".join)


def pieces(data, cuts):
    at = sorted({min(cut, len(data)) for cut in cuts} | {0, len(data)})
    return [data[a:b] for a, b in pairwise(at)]


def crc_bit_by_bit(data):
    """Dallas/Maxim CRC-8 as its description has it: reflected polynomial 0x8C, initial value 0."""
    crc = 0
    for byte in data:
        crc ^= byte
        for _ in range(8):
            crc = (crc >> 1) ^ 0x8C if crc & 1 else crc >> 1
    return crc


@pytest.mark.parametrize("name", EXAMPLES)
def test_the_published_examples_are_framed_and_found(name):
    data = bytes.fromhex(EXAMPLES[name])
    deframer = Deframer(data[2])
    (packet,) = deframer.packets(data)
    assert packet == Packet(data[4], data[6:-3])
    assert framed(data[2], *packet) == data
    assert Deframer(1 - data[2]).packets(data) == []


def test_the_numbers_of_the_ends_and_the_converter_s_full_scale():
    assert framed(BOARD, 0xFF, b"\x01") == bytes.fromhex(EXAMPLES["acknowledge"])
    assert framed(PC, 0x7B, bytes(33))[2] == 0
    assert ADC_FULL == 4095


def test_every_type_has_the_number_of_the_protocol():
    by_number = "03 04 05 06 07 16 1a 1b 1c 1d 1e 1f 7b 7c 7d ff"
    names = (
        "POSITION_ONE POSITION_ALL PWM_ONE PWM_ALL GAINS OUTPUTS VELOCITY_ONE VELOCITY_ALL SERVO_ONE SERVO_ALL DISABLE "
        "FRICTION MOTOR_SENSOR CUSTOM_SENSOR STANDARD_SENSOR SYSTEM"
    )
    assert {kind.name: kind.value for kind in Type} == dict(zip(names.split(), bytes.fromhex(by_number)))


@given(packets)
def test_the_crc_is_the_one_that_is_described(packet):
    data = framed(PC, *packet)
    assert data[:2] == b"\x5e\x02"
    assert data[2:6] == bytes((PC, 0, packet.type, len(packet.data)))
    assert data[-3] == crc_bit_by_bit(data[2:-3])
    assert data[-2:] == b"\x5e\x0d"


def test_the_crc_of_the_check_string_is_a1():
    assert crc_bit_by_bit(b"123456789") == 0xA1  # CRC-8/MAXIM-DOW


@settings(max_examples=60, deadline=None)
@given(st.lists(packets, max_size=8), st.lists(st.integers(0, 2000), max_size=12))
def test_packets_arrive_however_the_stream_is_cut(sent, cuts):
    deframer = Deframer(PC)
    stream = b"".join(framed(PC, *packet) for packet in sent)
    found = [packet for piece in pieces(stream, cuts) for packet in deframer.packets(piece)]
    assert found == sent
    assert deframer.n_good == len(sent)
    assert deframer.n_bytes == len(stream)
    assert (deframer.n_bad_crc, deframer.n_resyncs, deframer.n_skipped, deframer.n_kept) == (0, 0, 0, 0)


@settings(max_examples=150, deadline=None)
@given(noise, packets, noise, st.lists(st.integers(0, 1000), max_size=8))
@example(b"\x5e\x02\x00\x00\x7b\xff", Packet(0x7B, bytes(33)), b"", [])
@example(b"\x5e", Packet(0x7B, bytes(33)), b"", [1])
@example(b"\x5e\x02\x00\x00\xff\x01\x01", Packet(0x7B, bytes(33)), b"\x5e\x02", [7])
def test_a_packet_is_found_at_once_whatever_comes_before_and_after(before, packet, after, cuts):
    deframer = Deframer(PC)
    found = []
    for piece in pieces(before + framed(PC, *packet), cuts):
        found += deframer.packets(piece)
        assert deframer.n_kept < MAX_PACKET_BYTES
    assert packet in found
    for piece in pieces(after, cuts):
        deframer.packets(piece)
        assert deframer.n_kept < MAX_PACKET_BYTES
    assert deframer.n_bytes == len(before) + len(framed(PC, *packet)) + len(after)


@settings(max_examples=100, deadline=None)
@given(noise, st.lists(st.integers(0, 400), max_size=8))
def test_of_noise_every_byte_is_skipped_or_waits(data, cuts):
    deframer = Deframer(PC)
    lengths = [len(p.data) + 9 for piece in pieces(data, cuts) for p in deframer.packets(piece)]
    assert deframer.n_skipped + deframer.n_kept + sum(lengths) == len(data)


@pytest.mark.parametrize("i", range(len(bytes.fromhex(EXAMPLES["motors"]))))
@pytest.mark.parametrize("bit", [0, 3, 7])
def test_one_flipped_bit_spoils_a_packet_and_not_the_next(i, bit):
    good = bytes.fromhex(EXAMPLES["motors"])
    bad = bytearray(good)
    bad[i] ^= 1 << bit
    deframer = Deframer(PC)
    found = deframer.packets(bytes(bad) + good)
    assert found == [Packet(0x7B, good[6:-3])]
    assert deframer.n_resyncs == 1
    assert deframer.n_skipped == len(good)
    n = len(good)
    damaged_header_or_length_or_trailer = i in (0, 1, 2, 5, n - 2, n - 1)
    assert deframer.n_bad_crc == (not damaged_header_or_length_or_trailer)


def test_each_gap_between_packets_is_one_resync():
    good = framed(PC, 0x7B, bytes(33))
    deframer = Deframer(PC)
    for piece in (b"\x01\x02", b"\x03", good, good, b"\x5e", b"\x04", good, good[:20], good):
        deframer.packets(piece)
    assert deframer.n_good == 4
    assert deframer.n_resyncs == 3
    assert deframer.n_skipped == 3 + 2 + 20


def test_a_header_by_chance_between_packets_is_one_resync_too():
    good = framed(PC, 0x7B, bytes(33))
    deframer = Deframer(PC)
    assert len(deframer.packets(good + b"\x5e\x02\x00\x00\x7b\xff" + good)) == 2
    assert (deframer.n_resyncs, deframer.n_skipped, deframer.n_kept) == (1, 6, 0)


def test_packets_for_the_other_end_and_unknown_types():
    deframer = Deframer(PC)
    assert deframer.packets(framed(BOARD, 0x7B, bytes(33))) == []
    assert deframer.packets(framed(PC, 0x42, b"")) == [Packet(0x42, b"")]
    assert deframer.packets(b"") == []


def test_half_a_packet_is_forgotten_when_its_line_was_cut():
    good = framed(PC, 0x7B, bytes(33))
    deframer = Deframer(PC)
    deframer.packets(good[:30])
    deframer.forget()
    assert deframer.n_kept == 0
    assert deframer.n_skipped == 30
    assert deframer.packets(good[30:]) == []
    assert deframer.n_resyncs == 1
    assert len(deframer.packets(good)) == 1


@pytest.mark.parametrize(
    ("data", "kept"),
    [("5e", 1), ("5e02", 2), ("5e0200", 3), ("5e04", 0), ("5e01", 0), ("5e00", 0), ("5e0201", 0), ("5e025e", 1)],
)
def test_only_what_may_become_a_packet_waits(data, kept):
    deframer = Deframer(PC)
    deframer.packets(bytes.fromhex(data))
    assert deframer.n_kept == kept


def test_noise_in_megabytes_leaves_nothing_behind():
    noise = np.random.default_rng(1).bytes(2_000_000)
    deframer = Deframer(PC)
    for i in range(0, len(noise), 65536):
        deframer.packets(noise[i : i + 65536])
        assert deframer.n_kept < MAX_PACKET_BYTES
    assert deframer.n_good < 5
