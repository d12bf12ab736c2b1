# SPDX-License-Identifier: Apache-2.0
"""Every decoder on documented bytes, on any bytes, and on good packets with anything between them."""

from collections.abc import Callable
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.testing import assert_allclose

from services.lidar_driver import ld06, rplidar, rplidar_capsules, scip, xv11, ydlidar, ydlidar_packets
from services.lidar_driver.device import LaserDevice, PacketCounts, Returns
from services.lidar_driver.packet_framing import PacketFramer
from services.sim.hardware import ld06 as said_by_ld06
from services.sim.hardware import rplidar as said_by_rplidar
from services.sim.hardware import scip as said_by_scip
from services.sim.hardware import xv11 as said_by_xv11
from services.sim.hardware import ydlidar as said_by_ydlidar
from tests.unit.services.lidar_driver.bench import MODELS, laser_of, line_of, made_driver, random_sweeps

LD19_MANUAL = bytes.fromhex(
    "54 2C 68 08 AB 7E E0 00 E4 DC 00 E2 D9 00 E5 D5 00 E3 D3 00 E4 D0 00 E9 CD 00 E4 CA 00 E2 C7 00 E9 C5 00 E5"
    "C2 00 E5 C0 00 E5 BE 82 3A 1A 50"
)
"""The packet that the LD19's development manual explains."""
LD06_HEARD = bytes.fromhex(
    "54 2C 74 08 B0 86 00 00 D4 00 00 D4 00 00 D4 00 00 D4 00 00 D4 00 00 D5 00 00 D5 00 00 49 00 00 5F 00 00 B0"
    "00 00 D2 00 00 D4 02 89 1E 09 1F"
)
"""One that somebody published from a real LD06: nothing but empty beams."""
URG_PARAMETERS = (
    b"PP\n00P\nMODL:URG-04LX(Hokuyo Automatic Co., Ltd.);n\nDMIN:20;4\nDMAX:5600;_\nARES:1024;\\\nAMIN:44;7\n"
    b"AMAX:725;o\nAFRT:384;6\nSCAN:600;e\n\n"
)
"""An URG-04LX, from the protocol's specification (its ARES and MODL lines are printed there with other sums)."""


def decoder(model: str) -> LaserDevice:
    return made_driver(model).lasers["laser"].device


def single(returns: list[Returns]) -> Returns:
    assert len(returns) == 1
    return returns[0]


# --- documented bytes -----------------------------------------------------------------------------------------------


def test_an_ld19s_documented_packet_reads_as_its_manual_says():
    device = ld06.Ld06(230400, 4500)
    heard = single(device.receive(LD19_MANUAL, 0))
    assert device.speed == pytest.approx(2152 / 360)
    assert_allclose(heard.ranges[:3], [0.224, 0.220, 0.217], atol=1e-6)
    assert heard.intensities is not None
    assert heard.intensities[0] == 228
    assert_allclose(np.degrees(-heard.angles[[0, 11]]), [324.27, 334.70], atol=1e-9)
    assert_allclose(heard.times[-1] - heard.times[0], (334.70 - 324.27) / 2152, rtol=1e-9)
    assert heard.ages[0] == pytest.approx(47 * 10 / 230400)


def test_an_ld06s_published_packet_of_empty_beams_is_whole_and_measures_nothing():
    heard = single(ld06.Ld06(230400, 4500).receive(LD06_HEARD, 0))
    assert np.isnan(heard.ranges).all()


def test_an_xv11s_packet_reads_as_its_reference_says():
    # 300 rpm, degrees 8 to 11: 1000 mm, an invalid reading with code 0x35, 2000 mm weak, 16383 mm; sum by hand
    body = "FA A2 00 4B  E8 03 C8 00  35 80 00 00  D0 47 10 00  FF 3F 01 00"
    words = np.frombuffer(bytes.fromhex(body), "<u2").astype(int).tolist()
    total = sum(word << 9 - i for i, word in enumerate(words))
    check = (total % 32768 + total // 32768) % 32768
    device = xv11.Xv11(115200)
    heard = single(device.receive(bytes.fromhex(body) + check.to_bytes(2, "little"), 0))
    assert device.speed == pytest.approx(5.0)
    assert_allclose(np.degrees(heard.angles), [8, 9, 10, 11])
    assert_allclose(heard.ranges, [1.0, np.nan, 2.0, 16.383], rtol=1e-6)
    assert_allclose(heard.times[-1] - heard.times[0], 3 / 360 / 5)


def test_scip_sums_are_those_of_the_specification():
    for line in (b"DMIN:20;4", b"DMAX:5600;_", b"AMIN:44;7", b"SCAN:600;e"):
        assert scip.checksum(line[:-2]) == line[-1]
    assert scip.checksum(b"00") == ord("P")
    assert scip.checksum(b"99") == ord("b")


def test_scip_characters_are_the_specifications():
    # section 6: 1234 is `CB`, 5432 is `1Dh`, 16000000 is `m2@0`
    for text, value in ((b"CB", 1234), (b"1Dh", 5432), (b"m2@0", 16_000_000)):
        assert scip.decode_characters(np.frombuffer(text, np.uint8), len(text)).tolist() == [value]


def test_a_hokuyo_is_ordered_the_steps_that_the_grid_asks_of_it():
    device = scip.Scip(laser_of("scip"), False, False)
    said = [device.next_command(0)]
    for answer in (b"SCIP2.0\n0Ee\n\n", b"QT\n00P\n\n", URG_PARAMETERS, b"TM0\n00P\n\n", b"TM1\n00P\n00003\n\n"):
        device.receive(answer, 0)
        said.append(device.next_command(0))
    for answer in (b"TM2\n00P\n\n", b"BM\n00P\n\n"):
        device.receive(answer, 0)
        said.append(device.next_command(0))
    assert said == [b"SCIP2.0\n", b"QT\n", b"PP\n", b"TM0\n", b"TM1\n", b"TM2\n", b"BM\n", b"MD0044072501000\n"]
    device.receive(b"MD0044072501000\n00P\n\n", 0)
    assert device.scanning
    assert device.speed == 10


def ordered(device: scip.Scip) -> bytes:
    """Through the start sequence, up to the order to scan."""
    said = device.next_command(0)
    while said[:2] not in (b"ME", b"MD"):
        device.receive(URG_PARAMETERS if said == b"PP\n" else said + b"00P\n\n", 0)
        said = device.next_command(0)
    return said


def test_a_hokuyo_that_knows_no_intensities_is_asked_for_distances():
    device = scip.Scip(laser_of("scip"), False, True)
    order = ordered(device)
    assert order == b"ME0044072501000\n"
    device.receive(order + b"0Ee\n\n", 0)
    assert device.next_command(0) == b"MD0044072501000\n"
    assert device.fault == ""


def test_a_hokuyos_intensities_follow_each_distance():
    device = scip.Scip(laser_of("scip"), False, True)
    order = ordered(device)
    device.receive(order + b"00P\n\n", 0)
    text = b"".join(said_by_scip.encoded(1000 + i, 3) + said_by_scip.encoded(2000 + i, 3) for i in range(682))
    blocks = [said_by_scip.encoded(5, 4), *(text[i : i + 64] for i in range(0, len(text), 64))]
    heard = single(device.receive(said_by_scip.answer(order[:-1], b"99", blocks), 0))
    assert_allclose(heard.ranges, 1 + 1e-3 * np.arange(682), atol=1e-6)
    assert heard.intensities is not None
    assert_allclose(heard.intensities, 2000 + np.arange(682))
    assert_allclose(heard.angles[[0, 340]], [-340 * 2 * np.pi / 1024, 0], atol=1e-12)


YDLIDAR_ZERO = bytes.fromhex("AA 55 01 01 53 AE 53 AE AB 54 00 00")
"""The example of 'YDLidar-SDK Communication Protocol': a zero packet without a measurement."""


def test_a_ydlidars_documented_zero_packet_is_whole_and_measures_nothing():
    heard = single(ydlidar.Ydlidar(115200, ydlidar.MODELS["ydlidar_x2"]).receive(YDLIDAR_ZERO, 0))
    assert np.isnan(heard.ranges).all()
    far = np.degrees(np.arctan(-21.8 / 155.3))  # of the formula, for a distance without end
    assert_allclose(-np.degrees(heard.angles), (0xAE53 >> 1) / 64 + far)


def test_a_ydlidars_angles_are_corrected_as_its_protocols_example():
    # the packet of the example has 40 samples from 223.78 to 243.47 degrees, the first of 1 m, the last of 8 m
    samples = [(1000.0, 0)] + [(4000.0, 0)] * 38 + [(8000.0, 0)]
    data = said_by_ydlidar.packet((0x6FE5 >> 1) / 64, (0x79BD >> 1) / 64, samples, None, False)
    heard = single(ydlidar.Ydlidar(115200, ydlidar.MODELS["ydlidar_x2"]).receive(data, 0))
    assert_allclose(-np.degrees(heard.angles[[0, 39]]), [217.0178, 235.6326], atol=0.01)
    assert_allclose(heard.ranges[[0, 39]], [1, 8])
    assert_allclose(np.diff(heard.times), 1 / 3000)


def test_a_ydlidars_sample_with_intensity_reads_as_its_protocol_says():
    # 1F E5 6F is an intensity of 287 and 7161 mm; the same word without intensity 7161.25 mm
    body = bytes.fromhex("AA 55 00 01 01 00 01 00")
    words = [0x55AA, 0x0100, 1, 1, 0x1F, 0x6FE5]
    check = int(np.bitwise_xor.reduce(words)).to_bytes(2, "little")
    device = ydlidar.Ydlidar(230400, ydlidar.MODELS["ydlidar_g2"])
    device.scanning = True
    heard = single(device.receive(body + check + bytes.fromhex("1F E5 6F"), 0))
    assert heard.intensities is not None
    assert (float(heard.ranges[0]), float(heard.intensities[0])) == (pytest.approx(7.161), 287)


def test_a_ydlidars_speed_is_the_zero_packets_or_that_of_its_angles():
    device = ydlidar.Ydlidar(128000, ydlidar.MODELS["ydlidar_x4"])
    device.scanning = True
    device.receive(said_by_ydlidar.packet(10, 29.5, [(1000.0, 0)] * 40, None, False), 0)
    assert device.speed == pytest.approx(0.5 * 5000 / 360)
    device.receive(said_by_ydlidar.packet(30, 30, [(1000.0, 0)], 7.3, False), 0)
    assert device.speed == pytest.approx(7.3)


def test_a_ydlidar_x4_is_asked_for_its_health_before_it_scans_and_an_x2_nothing():
    assert ydlidar.Ydlidar(115200, ydlidar.MODELS["ydlidar_x2"]).start(0) == b""
    device = ydlidar.Ydlidar(128000, ydlidar.MODELS["ydlidar_x4"])
    now = 10**9
    assert device.start(now) == b"\xa5\x65"
    now += 200_000_000
    for request, answer in (
        ("a5 90", "a5 5a 14 00 00 00 04 06" + "00" * 19),
        ("a5 91", "a5 5a 03 00 00 00 06 00 00 00"),
        ("a5 60", "a5 5a 05 00 00 40 81"),
    ):
        assert device.next_command(now) == bytes.fromhex(request)
        assert device.next_command(now) == b""
        device.receive(bytes.fromhex(answer), now)
    assert device.scanning


def test_rplidar_requests_with_a_payload_are_slamtecs():
    assert rplidar.request_with_payload(0x82, bytes(5)).hex(" ") == "a5 82 05 00 00 00 00 00 22"
    assert rplidar.request_with_payload(0xF0, b"\x94\x02").hex(" ") == "a5 f0 02 94 02 c1"


def test_an_rplidar_is_asked_in_order_and_its_answers_are_taken_in_any_pieces():
    device = rplidar.Rplidar(115200, None)
    now = 1_000_000_000
    assert device.start(now) == b"\xa5\x25"
    assert device.next_command(now) == b""
    now += 200_000_000
    dialogue = [
        (b"\xa5\x50", "a5 5a 14 00 00 00 04 18 18 01 00" + "00" * 16),
        (b"\xa5\x52", "a5 5a 03 00 00 00 06 00 00 00"),
        (b"\xa5\x59", "a5 5a 04 00 00 00 15 f8 01 fc 00"),
        (b"\xa5\x20", "a5 5a 05 00 00 40 81"),
    ]
    for request, answer in dialogue:
        assert device.next_command(now) == request
        for byte in bytes.fromhex("00 ff" + answer):
            assert device.next_command(now) == b""
            device.receive(bytes([byte]), now)
    assert device.scanning
    assert device.sample_times == pytest.approx((504e-6, 252e-6))


def test_an_rplidar_that_reports_ill_health_is_reset_and_its_code_told():
    device = rplidar.Rplidar(115200, None)
    device.start(0)
    now = 200_000_000
    device.next_command(now)
    device.receive(bytes.fromhex("a5 5a 14 00 00 00 04 18") + bytes(19), now)
    assert device.next_command(now) == b"\xa5\x52"
    device.receive(bytes.fromhex("a5 5a 03 00 00 00 06 02 2a 01"), now)
    assert device.next_command(now) == b"\xa5\x40"
    assert "298" in device.fault


def test_a_standard_node_reads_as_the_protocol_says():
    # quality 15, not first; 90 degrees; 1 m, in quarters of a mm
    node = bytes([15 << 2 | 2]) + (90 * 64 << 1 | 1).to_bytes(2, "little") + (4000).to_bytes(2, "little")
    device = scanning_rplidar(0x81)
    heard = single(device.receive(node * 8, 0))
    assert_allclose(np.degrees(heard.angles), -90)
    assert_allclose(heard.ranges, 1.0)
    assert heard.intensities is not None
    assert (heard.intensities == 15).all()


def test_a_capsule_is_read_between_its_angle_and_the_next_ones():
    # SLAMTEC's own driver: angle_q6 = start + i (next - start) / 32 - offset_q3 / 8; distance in mm above two bits
    cabins = b"".join(
        ((500 + i) << 2 | 1).to_bytes(2, "little") + ((700 + i) << 2).to_bytes(2, "little") + bytes([0x21])
        for i in range(16)
    )
    capsules = capsule_of(350, cabins) + capsule_of(350 + 32, cabins)
    heard = single(scanning_rplidar(0x82).receive(capsules, 0))
    assert len(heard.ranges) == 32
    assert_allclose(heard.ranges[:4], [0.5, 0.7, 0.501, 0.701], atol=1e-6)
    offsets = np.tile([(0x1 | 1 << 4) / 8, 0x2 / 8], 16)
    assert_allclose(-np.degrees(heard.angles), 350 + np.arange(32) - offsets, atol=1e-9)


def test_a_dense_capsule_is_read_evenly():
    capsules = b"".join(
        capsule_of(start, b"".join((1000 + i).to_bytes(2, "little") for i in range(40))) for start in (0, 36)
    )
    heard = single(scanning_rplidar(0x85).receive(capsules, 0))
    assert_allclose(heard.ranges, 1 + 1e-3 * np.arange(40), atol=1e-6)
    assert_allclose(-np.degrees(heard.angles), 0.9 * np.arange(40), atol=1e-9)


def test_an_extended_capsules_distances_are_predicted_from_both_sides():
    # major 1000 mm: over 512, steps of 2 mm, code 512 + (1000 - 512) / 2 = 756; next major 3000: code 1280 + 952 / 4
    majors = [756, 1280 + 238] * 16
    words = [major | (5 & 0x3FF) << 12 | (-7 & 0x3FF) << 22 for major in majors]
    words[2] = majors[2] | 0x1FF << 12 | 0x200 << 22  # no prediction, either way
    words[4] = 0 | 3 << 12 | 4 << 22  # nothing seen first: both from the next
    body = b"".join(word.to_bytes(4, "little") for word in words)
    heard = single(scanning_rplidar(0x84).receive(capsule_of(10, body) + capsule_of(82, body), 0))
    mm = heard.ranges.reshape(32, 3) * 1000
    assert_allclose(mm[0], [1000, 1000 + 5 * 2, 3000 - 7 * 4], atol=1e-3)
    assert_allclose(mm[1], [3000, 3000 + 5 * 4, 1000 - 7 * 2], atol=1e-3)
    assert_allclose(mm[2], [1000, np.nan, np.nan], atol=1e-3)
    assert_allclose(mm[4], [np.nan, 3000 + 3 * 4, 3000 + 4 * 4], atol=1e-3)
    assert_allclose(mm[31, 2], 1000 - 7 * 2, atol=1e-3)  # from the first of the following capsule
    degrees = -np.degrees(heard.angles)
    k = 98361 // 4000
    parallax = 8 - np.degrees((k * 64 + k**3 // 98304) / 65536)
    assert_allclose(degrees[0], 10 - parallax, atol=1e-9)
    assert_allclose(degrees[14], 10 + 14 * 0.75 - 7.5, atol=0.3)


def test_scaled_distances_rise_without_a_gap():
    mm, levels = rplidar_capsules.decode_scaled(np.arange(4096))
    steps = np.diff(mm)
    assert (steps == 2 ** levels[:-1]).all()
    assert mm[0] == 0
    assert [int(mm[code]) for code in (512, 1280, 1792, 3328)] == [512, 2048, 4096, 16384]


def test_an_a3_is_asked_for_the_mode_that_it_is_made_for():
    device = rplidar.Rplidar(256000, None)
    device.start(0)
    now = 200_000_000
    dialogue = [
        ("a5 50", "a5 5a 14 00 00 00 04 31" + "00" * 19),
        ("a5 52", "a5 5a 03 00 00 00 06 00 00 00"),
        ("a5 59", "a5 5a 04 00 00 00 15 fc 00 7d 00"),
        ("a5 84 04 7c 00 00 00", "a5 5a 06 00 00 00 20 7c 00 00 00 03 00"),
        ("a5 84 06 75 00 00 00 03 00", "a5 5a 05 00 00 00 20 75 00 00 00 84"),
        ("a5 84 06 71 00 00 00 03 00", "a5 5a 08 00 00 00 20 71 00 00 00 80 3e 00 00"),
        ("a5 f0 02 94 02 c1 a5 82 05 03 00 00 00 00", "a5 5a 84 00 00 40 84"),
    ]
    for request, answer in dialogue:
        assert device.next_command(now).startswith(bytes.fromhex(request))
        device.receive(bytes.fromhex(answer), now)
    assert device.scanning
    assert device.sample_times[1] == pytest.approx(62.5e-6)


def test_a_c1_whose_typical_mode_has_an_unknown_format_scans_in_standard_mode():
    device = rplidar.Rplidar(460800, None, rate=8.0)
    device.start(0)
    now = 200_000_000
    for request, answer in (
        ("a5 50", "a5 5a 14 00 00 00 04 41" + "00" * 19),
        ("a5 52", "a5 5a 03 00 00 00 06 00 00 00"),
        ("a5 59", "a5 5a 04 00 00 00 15 c8 00 c8 00"),
        ("a5 84 04 7c", "a5 5a 06 00 00 00 20 7c 00 00 00 02 00"),
        ("a5 84 06 75 00 00 00 02 00", "a5 5a 05 00 00 00 20 75 00 00 00 83"),
        ("a5 84 06 71", "a5 5a 08 00 00 00 20 71 00 00 00 00 64 00 00"),
        ("a5 a8 02 e0 01 ee a5 20", "a5 5a 05 00 00 40 81"),
    ):
        assert device.next_command(now).startswith(bytes.fromhex(request))
        device.receive(bytes.fromhex(answer), now)
    assert device.scanning
    assert device.sample_times[0] == pytest.approx(200e-6)


def test_an_ultra_dense_capsule_has_four_scales():
    # rplidar_sdk: 2 mm a step, from 2046 mm on 3, from 8187 mm on 4, from 24567 mm on 5; quality above the distance
    words = [5 << 12 | 500 << 2, 3 << 13 | 1000 << 2 | 1, 2 << 14 | 2000 << 2 | 2, 1 << 15 | 1000 << 2 | 3]
    cabins = b""
    for a, b in ((words[0], words[1]), (words[2], words[3])) * 16:
        cabins += (
            (a & 0xFFFF).to_bytes(2, "little") + (b & 0xFFFF).to_bytes(2, "little") + bytes([a >> 16 | b >> 16 << 4])
        )
    capsules = b""
    for start in (10, 74):
        body = bytes(6) + (start * 64).to_bytes(2, "little") + cabins
        total = int(np.bitwise_xor.reduce(np.frombuffer(body, np.uint8)))
        capsules += bytes([0xA0 | total & 15, 0x50 | total >> 4]) + body
    heard = single(scanning_rplidar(0x86).receive(capsules, 0))
    assert_allclose(heard.ranges[:4], [1.0, 2.046 + 3.0, 8.187 + 8.0, 24.567 + 5.0], atol=1e-6)
    assert_allclose(-np.degrees(heard.angles), 10 + np.arange(64), atol=1e-9)


def capsule_of(degrees: float, cabins: bytes) -> bytes:
    body = round(degrees % 360 * 64).to_bytes(2, "little") + cabins
    total = int(np.bitwise_xor.reduce(np.frombuffer(body, np.uint8)))
    return bytes([0xA0 | total & 15, 0x50 | total >> 4]) + body


def scanning_rplidar(kind: int) -> rplidar.Rplidar:
    """One whose scan of a type of answers has begun."""
    device = rplidar.Rplidar(115200, kind != 0x81)
    device.start(0)
    device.last_request = rplidar.SCAN if kind == 0x81 else rplidar.request_with_payload(rplidar.EXPRESS, bytes(5))
    length = 5 if kind == 0x81 else rplidar_capsules.FORMATS[kind].length
    device.receive(said_by_rplidar.descriptor(length | 1 << 30, kind), 0)
    assert device.scanning
    return device


# --- any bytes ------------------------------------------------------------------------------------------------------

LEADS = st.sampled_from(
    [b"\x54\x2c", b"\xfa\xa0", b"\xa5\x5a", b"\xa1\x5b", b"MD0044072501000\n99b\n", b"\n\n", b"PP\n00P\nARES:9999999;"]
)
NOISE = st.lists(st.binary(max_size=90) | LEADS, max_size=12)
MAX_HELD_BYTES = 1 << 17


def kept(device: LaserDevice) -> int:
    """Bytes that a decoder holds back."""
    scan = getattr(device, "scan", None)
    parts = [device, *(getattr(owner, name, None) for owner in (device, scan) for name in ("framing", "nodes"))]
    return sum(len(getattr(part, "buffer", b"")) for part in parts if part is not None)


@pytest.mark.parametrize("model", MODELS)
@settings(max_examples=40)
@given(noise=NOISE, scans=st.booleans())
def test_any_bytes_are_survived_and_none_are_hoarded(model, noise, scans):
    line = line_of(model)
    if scans:
        line.run(random_sweeps(line.driver.robot.laser, 0.5), 0.7)
    for i, piece in enumerate(noise):
        line.driver.now += i * 7_000_000
        line.hear(piece)
        line.take(line.driver.watch())
    assert kept(line.driver.lasers["laser"].device) < MAX_HELD_BYTES
    for scan in line.scans:
        assert scan.problem() is None
        assert 0 < scan.scan_time <= 2


@pytest.mark.parametrize("model", MODELS)
def test_a_megabyte_of_noise_leaves_no_megabyte_behind(model):
    device = decoder(model)
    rng = np.random.default_rng(0)
    device.next_command(10**9)
    for _ in range(250):
        device.receive(rng.bytes(4096), 10**9)
        assert kept(device) < MAX_HELD_BYTES


# --- good packets among others --------------------------------------------------------------------------------------


def ld06_packets(n: int, rng: np.random.Generator) -> list[bytes]:
    first = np.cumsum(rng.uniform(5, 12, n + 1)) % 360
    return [
        said_by_ld06.packet(3600, first[i], first[i + 1], rng.integers(0, 65536, 12).tolist(), 3 * i) for i in range(n)
    ]


def xv11_packets(n: int, rng: np.random.Generator) -> list[bytes]:
    return [said_by_xv11.packet(i % 90, 300.0, rng.integers(0, 16384, 4).tolist()) for i in range(n)]


def capsules(n: int, rng: np.random.Generator) -> list[bytes]:
    return [said_by_rplidar.capsule(i * 20 % 360, rng.integers(0, 16384, 32).tolist(), False) for i in range(n)]


def ydlidar_packets_of(n: int, rng: np.random.Generator, intensity: bool) -> list[bytes]:
    return [
        said_by_ydlidar.packet(
            20 * i, 20 * i + 19.5, [(mm, mm % 1024) for mm in rng.integers(0, 16384, 40).tolist()], None, intensity
        )
        for i in range(n)
    ]


Framer = PacketFramer | ydlidar_packets.YdlidarFramer
PACKETS: dict[str, tuple[Callable[[int, np.random.Generator], list[bytes]], Callable[[], Framer]]] = {
    "ld06": (ld06_packets, lambda: PacketFramer(47, ld06.is_header, ld06.is_checksum_valid, PacketCounts())),
    "xv11": (xv11_packets, lambda: PacketFramer(22, xv11.is_header, xv11.is_checksum_valid, PacketCounts())),
    "ydlidar_x4": (
        lambda n, rng: ydlidar_packets_of(n, rng, False),
        lambda: ydlidar_packets.YdlidarFramer(ydlidar_packets.PLAIN, PacketCounts()),
    ),
    "ydlidar_g2": (
        lambda n, rng: ydlidar_packets_of(n, rng, True),
        lambda: ydlidar_packets.YdlidarFramer(ydlidar_packets.WITH_INTENSITY, PacketCounts()),
    ),
    "rplidar_a2": (
        capsules,
        lambda: PacketFramer(84, rplidar_capsules.is_header, rplidar_capsules.is_checksum_valid, PacketCounts()),
    ),
}


@pytest.mark.parametrize("model", PACKETS)
@given(
    seed=st.integers(0, 10**6),
    between=st.lists(st.binary(max_size=30), min_size=6, max_size=6),
    cuts=st.lists(st.integers(0, 700), max_size=10),
)
def test_every_good_packet_is_found_whatever_lies_between_and_however_it_is_cut(model, seed, between, cuts):
    make, made = PACKETS[model]
    packets = make(6, np.random.default_rng(seed))
    stream = b"".join(noise + packet for noise, packet in zip(between, packets))
    whole = made()
    alone, _ = whole.extract(stream)
    found = [bytes(row) for row in alone]
    # noise may hold a packet of its own by accident, and swallow one: then the sum must be right there
    assert all(packet in found for packet in packets) or len(found) >= len(packets)
    pieces = made()
    edges = [0, *sorted(cut % (len(stream) + 1) for cut in cuts), len(stream)]
    in_pieces = [bytes(row) for a, b in pairwise(edges) for row in pieces.extract(stream[a:b])[0]]
    assert in_pieces == found
    assert pieces.counts.n_good == whole.counts.n_good == len(found)
    assert len(pieces.buffer) < pieces.length


@pytest.mark.parametrize("model", PACKETS)
def test_resyncs_and_bad_sums_are_counted_once_each(model):
    make, made = PACKETS[model]
    first, second, third, fourth = make(4, np.random.default_rng(3))
    spoiled = third[:-1] + bytes([third[-1] ^ 4])
    framing = made()
    for piece in (first, b"\x00\x01", second, spoiled[:10], spoiled[10:], fourth):
        framing.extract(piece)
    assert (framing.counts.n_good, framing.counts.n_bad, framing.counts.n_resyncs) == (3, 1, 2)


@pytest.mark.parametrize("model", PACKETS)
@given(n=st.integers(1, 30))
def test_bytes_after_a_packet_are_counted_to_the_newest_byte(model, n):
    make, made = PACKETS[model]
    packets = make(n, np.random.default_rng(n))
    framing = made()
    _, after = framing.extract(b"".join(packets) + b"\x01\x02")
    assert_allclose(after, (n - 1 - np.arange(n)) * len(packets[0]) + 2)


@given(noise=st.binary(max_size=60), seed=st.integers(0, 1000), cuts=st.lists(st.integers(0, 600), max_size=8))
def test_nodes_are_found_again_after_noise_and_never_invented_from_it(noise, seed, cuts):
    rng = np.random.default_rng(seed)
    angles = (np.arange(120) * 0.9 + rng.uniform(0, 0.5, 120)) % 360
    nodes = [said_by_rplidar.node(False, angle, mm) for angle, mm in zip(angles, rng.integers(1, 10000, 120))]
    stream = b"".join(nodes[:60]) + noise + b"".join(nodes[60:])
    device = scanning_rplidar(0x81)
    edges = [0, *sorted(cut % (len(stream) + 1) for cut in cuts), len(stream)]
    found = [r for a, b in pairwise(edges) for r in device.receive(stream[a:b], 0)]
    degrees = -np.degrees(np.concatenate([r.angles for r in found]))
    quantised = np.round(angles * 64) / 64
    hits = np.isclose(degrees[:, None], quantised[None, :], atol=1e-6).any(axis=0)
    assert hits[:60].all()
    assert hits[-30:].all()
    assert len(degrees) <= 120 + len(noise) // 5 + 8


@settings(max_examples=40)
@given(noise=st.binary(max_size=60), seed=st.integers(0, 1000), cut=st.integers(0, 4000))
def test_a_hokuyos_next_sweep_is_found_after_half_a_one_and_noise(noise, seed, cut):
    line = line_of("scip")
    laser = line.driver.robot.laser
    line.run(random_sweeps(laser, 0.6), 0.6)
    before = len(line.scans)
    sweeps = random_sweeps(laser, 0.2, seed, line.now)
    (_, first), (_, second) = (line.laser.sweep_chunks(sweep, line.now)[0] for sweep in sweeps)
    line.driver.now = line.now + 200_000_000
    for piece in (first[: cut % len(first)], noise, second[:1000], second[1000:]):
        line.hear(piece)
    assert len(line.scans) > before
    assert_allclose(line.scans[-1].ranges, sweeps[-1].ranges, atol=6e-4)


@pytest.mark.parametrize("model", ["rplidar", "scip", "ydlidar_x4"])
def test_a_clock_that_is_set_back_does_not_hold_the_requests_up(model):
    """The laser is off, so that it is asked again and again."""
    device, now = decoder(model), 10_000 * 10**9
    device.start(now)
    for _ in range(40):
        now += 50 * 10**6
        device.next_command(now)
    now -= 3600 * 10**9
    assert any(device.next_command(now + k * 10**9) for k in range(6))
