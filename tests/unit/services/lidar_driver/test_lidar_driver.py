# SPDX-License-Identifier: Apache-2.0
"""The driver at an emulated laser's line: the scan is the simulated one, and what is wrong is named."""

from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose

from services.lidar_driver.laser_unit import NO_BYTES, NO_SENSE, STOPPED
from services.sim.hardware.lasers import make_emulator
from services.sim.hardware.rplidar import RplidarEmulator
from services.sim.hardware.xv11 import packet
from shared import topics
from shared.config import UserError
from shared.messages import LaserScan, PortState, SerialData
from shared.types import NS_PER_S
from tests.unit.services.lidar_driver.bench import (
    BAUD,
    CLOCK_ERROR,
    MODELS,
    MS,
    START,
    DeviceLine,
    Faulty,
    laser_of,
    line_of,
    made_driver,
    random_sweeps,
    truth_of,
)

RESOLUTION = {
    "ld06": 5e-4,
    "ld14": 5e-4,
    "stl27l": 5e-4,
    "xv11": 5e-4,
    "scip": 5e-4,
    "rplidar": 1.3e-4,
    "rplidar_a2": 5e-4,
    "rplidar_c1": 5e-4,
    "rplidar_s1": 5e-4,
    "rplidar_s2": 5e-4,
    "ydlidar_x2": 1.3e-4,
    "ydlidar_x4": 1.3e-4,
    "ydlidar_g2": 5e-4,
}  # m, half a step
STARTUP = {"scip": 0.4, "ydlidar_x4": 0.4, "ydlidar_g2": 0.4}
STARTUP |= {model: 0.6 for model in MODELS if model.startswith("rplidar")}  # s
TRANSMITTING = ("ld06", "ld14", "stl27l", "xv11", "ydlidar_x2")


def close(scan: LaserScan, true: LaserScan, resolution: float) -> None:
    np.testing.assert_array_equal(np.isnan(scan.ranges), np.isnan(true.ranges))
    assert_allclose(scan.ranges, true.ranges, atol=resolution + 1e-6)
    assert (scan.angle_min, scan.angle_increment) == pytest.approx((true.angle_min, true.angle_increment))
    assert scan.scan_time == pytest.approx(true.scan_time, rel=2e-3)


@pytest.mark.parametrize("model", MODELS)
def test_what_comes_out_is_what_was_measured(model):
    line, sweeps = line_of(model), random_sweeps(laser_of(model), 4)
    line.run(sweeps, 4.5)
    assert len(line.scans) >= len(sweeps) - 2 - STARTUP.get(model, 0) * laser_of(model).rate
    told = [truth_of(scan, sweeps) for scan in line.scans]
    assert len({scan.stamp for scan in told}) == len(told)  # none twice
    for scan, true in zip(line.scans, told):
        close(scan, true, RESOLUTION[model])
    assert line.lines == []
    assert "scanning" in line.driver.state()


@pytest.mark.parametrize("model", MODELS)
@pytest.mark.parametrize("drift", [0.0, 2e-4, -2e-4])
def test_stamps_are_the_first_beams_while_clocks_drift_and_the_port_dawdles(model, drift):
    """Chunks are read as they leave, up to some ms late; the stack's clock runs off the device's."""
    line, sweeps = line_of(model), random_sweeps(laser_of(model), 14)
    rng = np.random.default_rng(3)
    line.run(sweeps[:0], 1.0)  # the start sequence
    chunks = sorted(
        (chunk for sweep in sweeps for chunk in line.laser.sweep_chunks(sweep, line.now)), key=lambda c: c[0]
    )

    def clock(true: int) -> int:
        return START + round((true - START) * (1 + drift))

    newest = 0
    for i in range(0, len(chunks), 3):
        some = chunks[i : i + 3]
        newest = max(newest, clock(some[-1][0] + round(rng.exponential(1.5) * MS)))
        line.driver.now = newest
        line.hear(b"".join(data for _, data in some))
    late = [scan for scan in line.scans if scan.stamp > START + 6 * NS_PER_S]
    assert len(late) > 20
    stamps = [clock(sweep.stamp) for sweep in sweeps]
    errors = [min((scan.stamp - stamp for stamp in stamps), key=abs) for scan in late]
    assert np.abs(errors).max() < 3 * MS  # a Hokuyo's clock was asked over the 20 ms of a step
    assert np.std(errors) < 0.6 * MS


@pytest.mark.parametrize("model", ["ld06", "scip"])
def test_a_clock_that_wraps_is_not_noticed(model):
    wrap = {"ld06": 30_000, "scip": 1 << 24}[model] * MS
    start = START // wrap * wrap + wrap - 1500 * MS
    laser = laser_of(model)
    line = DeviceLine(made_driver(model), make_emulator(model, laser))
    line.now = start
    line.driver.now = start
    line.take(line.driver.plugged(PortState(start, "laser", True, "")))
    sweeps = random_sweeps(laser, 4, start=start)
    line.run(sweeps, 4)
    assert len(line.scans) >= 34
    for scan in line.scans:
        close(scan, truth_of(scan, sweeps), RESOLUTION[model])
        assert abs(scan.stamp - truth_of(scan, sweeps).stamp) < 5 * MS
    assert line.driver.lasers["laser"].clock.n_restarts == 0


@pytest.mark.parametrize("model", MODELS)
@pytest.mark.parametrize("jump", [3600.0, -3600.0])
def test_scans_go_on_when_the_stacks_clock_jumps(model, jump):
    line, sweeps = line_of(model), random_sweeps(laser_of(model), 8)
    line.run(sweeps, 3)
    line.stack_time = lambda true: true + round(jump * NS_PER_S)
    line.run(sweeps, 5)
    moved = [scan.stamp - round(jump * NS_PER_S) for scan in line.scans[-5:]]
    for stamp in moved:
        assert min(abs(stamp - sweep.stamp) for sweep in sweeps) < CLOCK_ERROR.get(model, 5 * MS)


@pytest.mark.parametrize("model", MODELS)
@pytest.mark.parametrize("faults", [{"garbage": 0.2}, {"half": 0.1}, {"bad_sum": 0.1}, {"garbage": 0.1, "half": 0.1}])
def test_a_bad_line_costs_beams_and_invents_none(model, faults):
    laser = laser_of(model)
    if model == "rplidar":  # a chunk is a node there
        faults = {name: share / 5 for name, share in faults.items()}
    line = DeviceLine(made_driver(model), Faulty(make_emulator(model, laser), seed=1, **faults))
    sweeps = random_sweeps(laser, 6)
    line.run(sweeps, 6)
    wrong = heard = 0
    for scan in line.scans:
        true = truth_of(scan, sweeps)
        both = ~np.isnan(scan.ranges)
        heard += int(both.sum())
        wrong += int((~(np.abs(scan.ranges - true.ranges) < RESOLUTION[model] + 1e-6) & both).sum())
    assert heard > 0.2 * len(sweeps) * laser.n_beams
    allowed = {"rplidar": 0.03}.get(model, 0.002)  # its nodes carry no sum
    assert wrong <= allowed * heard, wrong / heard


@pytest.mark.parametrize("model", MODELS)
def test_a_masked_angle_is_empty_and_no_other(model):
    line = line_of(model, masks=((0.5, 1.0),))
    sweeps = random_sweeps(laser_of(model), 2)
    line.run(sweeps, 2.2)
    scan = line.scans[-1]
    true = truth_of(scan, sweeps)
    angles = scan.angle_min + scan.angle_increment * np.arange(len(scan.ranges))
    masked = (angles - 0.5) % (2 * np.pi) <= 0.5
    assert np.isnan(scan.ranges[masked]).all()
    assert masked.sum() > 10
    np.testing.assert_array_equal(np.isnan(scan.ranges[~masked]), np.isnan(true.ranges[~masked]))


def test_beams_that_end_in_the_footprint_are_empty():
    line = line_of("ld06", mask_footprint=True, footprint_margin=0.02)
    laser = laser_of("ld06")
    near = random_sweeps(laser, 1)
    for sweep in near:
        sweep.ranges[:] = 0.05
    line.run(near, 1)
    assert line.scans
    assert np.isnan(line.scans[-1].ranges).mean() > 0.3


@pytest.mark.parametrize("model", MODELS)
def test_a_laser_upside_down_gives_its_beams_mirrored_in_the_order_of_time(model):
    """In a world that stands still, what hangs sees at an angle what stands sees at its opposite."""
    sweeps = random_sweeps(laser_of(model), 3)
    sweeps = [replace(sweep, ranges=sweeps[0].ranges) for sweep in sweeps]
    by_angle = []
    for inverted in (False, True):
        line = line_of(model, inverted=inverted)
        line.run(sweeps, 3)
        scan = line.scans[-1]
        assert (scan.angle_increment > 0) == ((laser_of(model).angle_increment > 0) != inverted)
        angles = scan.angle_min + scan.angle_increment * np.arange(len(scan.ranges))
        steps = np.rint((-angles if inverted else angles) / abs(scan.angle_increment)).astype(int)
        turn = round(2 * np.pi / abs(scan.angle_increment))
        by_angle.append(dict(zip((steps % turn).tolist(), scan.ranges.tolist())))
    upright, hanging = by_angle
    common = sorted(upright.keys() & hanging.keys())
    assert len(common) >= laser_of(model).n_beams - 2  # a Hokuyo's field of view is one step off its middle
    np.testing.assert_array_equal([upright[angle] for angle in common], [hanging[angle] for angle in common])


def test_intensities_come_where_the_laser_has_them_and_can_be_left_out():
    without = ("rplidar_a2", "rplidar_c1", "rplidar_s1", "rplidar_s2", "scip", "ydlidar_x2", "ydlidar_x4")
    for model, has in ((model, model not in without) for model in MODELS):
        for wanted in (True, False):
            line = line_of(model, intensities=wanted)
            line.run(random_sweeps(laser_of(model), 2), 2.2)
            scan = line.scans[-1]
            assert len(scan.intensities) == (len(scan.ranges) if has and wanted else 0)
            if len(scan.intensities):
                np.testing.assert_array_equal(scan.intensities > 0, ~np.isnan(scan.ranges))


# --- what is wrong --------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("model", MODELS)
def test_silence_is_named_and_the_laser_started_again(model):
    line = line_of(model)
    line.run(random_sweeps(laser_of(model), 3), 3.5)
    n, line.written = len(line.scans), []
    said: list[bytes] = []
    for _ in range(100):
        line.step([])
        said += line.written
        line.written = []
    assert line.driver.state() == NO_BYTES
    assert line.lines[-1].endswith(NO_BYTES)
    if model not in TRANSMITTING:
        assert said  # it was asked again
    later = random_sweeps(laser_of(model), 4, start=line.now)
    line.run(later, 4.2)
    assert len(line.scans) > n + 8
    assert line.lines[-1] == "laser: in order again"


def test_bytes_without_sense_are_named():
    for model in MODELS:
        line = line_of(model)
        rng = np.random.default_rng(2)
        for _ in range(200):
            line.now += 20 * MS
            line.driver.now = line.now
            line.hear(rng.bytes(200))
            line.take(line.driver.watch())
        assert line.driver.state() == NO_SENSE.format("lidar_driver"), model
        assert line.scans == []


@pytest.mark.parametrize(
    ("model", "named"),
    [
        ("ld06", STOPPED),
        ("xv11", NO_BYTES),
        ("rplidar", "health error"),
        ("scip", "fault of its hardware"),
        ("ydlidar_x2", NO_BYTES),
        ("ydlidar_x4", "health error"),
    ],
)
def test_a_laser_that_stops_turning_is_named_and_recovers(model, named):
    line = line_of(model)
    sweeps = random_sweeps(laser_of(model), 16)
    line.run(sweeps, 3)
    line.laser.turning = False
    line.run(sweeps, 5)
    n = len(line.scans)
    assert named in line.driver.state()
    assert any(named in text for text in line.lines)
    line.laser.turning = True
    line.run(sweeps, 7)
    assert len(line.scans) > n + 10
    assert "scanning" in line.driver.state()


def test_an_xv11_that_turns_too_slowly_is_named():
    line = line_of("xv11")
    line.hear(b"".join(packet(i, 120.0, [1000] * 4) for i in range(90)))
    assert "too slowly: 120 rpm" in line.driver.state()


@pytest.mark.parametrize("model", MODELS)
def test_a_closed_port_is_named_and_scans_return_with_it(model):
    line, sweeps = line_of(model), random_sweeps(laser_of(model), 8)
    line.run(sweeps, 2)
    line.take(line.driver.plugged(PortState(line.now, "laser", False, "/dev/laser went away: plug it in again")))
    assert line.driver.state() == "/dev/laser went away: plug it in again"
    assert "plug it in again" in line.lines[-1]
    line.now += NS_PER_S
    line.driver.now = line.now
    assert [out for out in line.driver.watch() if getattr(out, "topic", None) is topics.TX] == []
    line.take(line.driver.plugged(PortState(line.now, "laser", True, "")))
    n = len(line.scans)
    line.run(sweeps, 4)
    assert len(line.scans) > n + 8


def test_the_laser_is_stopped_at_the_end():
    stops = {"scip": b"QT\n", "rplidar": b"\xa5\x25", "rplidar_a2": b"\xa5\x25" + bytes.fromhex("a5 f0 02 00 00 57")}
    stops |= dict.fromkeys(("rplidar_c1", "rplidar_s1", "rplidar_s2"), b"\xa5\x25")
    stops |= {"ydlidar_x4": b"\xa5\x65", "ydlidar_g2": b"\xa5\x65"}
    for model in MODELS:
        line = line_of(model)
        line.run(random_sweeps(laser_of(model), 1.5), 2)
        line.written = []
        line.take(line.driver.on_shutdown())
        assert b"".join(line.written) == stops.get(model, b"")


def test_a_port_of_another_name_is_not_the_lasers():
    driver = made_driver("ld06")
    assert list(driver.receive(SerialData(START, "other", b"\x54\x2c"))) == []
    assert list(driver.plugged(PortState(START, "other", True, ""))) == []
    assert not driver.lasers["laser"].line.open
    assert driver.ports["laser"].baud == BAUD["ld06"]


def test_an_rplidar_of_the_s_and_c_series_is_told_the_speed_of_the_robots_laser():
    line = line_of("rplidar_c1")
    line.run(random_sweeps(laser_of("rplidar_c1"), 1), 1.5)
    assert isinstance(line.laser, RplidarEmulator)
    assert line.laser.rpm == 600


def test_an_rplidar_c1_scans_in_standard_mode_if_asked_to():
    line = line_of("rplidar_c1", express=False)
    sweeps = random_sweeps(laser_of("rplidar_c1"), 2)
    line.run(sweeps, 2.2)
    close(line.scans[-1], truth_of(line.scans[-1], sweeps), 5e-4)
    assert len(line.scans[-1].intensities)  # only standard nodes have a quality


def test_an_rplidars_port_keeps_dtr_low_for_the_motor_of_an_a1():
    assert {model: made_driver(model).ports["laser"].dtr for model in ("ld06", "rplidar")} == {
        "ld06": True,
        "rplidar": False,
    }


def test_without_a_port_the_state_says_what_to_set():
    assert made_driver("ld06", port={}).state() == "no port: set lidar_driver.port.device"


def test_a_scan_is_never_from_the_future():
    line, sweeps = line_of("ld06"), random_sweeps(laser_of("ld06"), 4)
    ends = []
    for sweep in sweeps:
        before = len(line.scans)
        line.run([sweep], 0.1)
        ends += [line.driver.now - scan.stamp - round(scan.scan_time * NS_PER_S) for scan in line.scans[before:]]
    assert ends
    assert min(ends) >= 0


def test_the_latency_sets_the_stamps_back():
    latency = 0.0123
    sweeps = random_sweeps(laser_of("xv11"), 1)
    plain, back = line_of("xv11"), line_of("xv11", latency=latency)
    for line in (plain, back):
        line.run(sweeps, 1.2)
    assert back.scans[-1].stamp == plain.scans[-1].stamp - round(latency * NS_PER_S)


def test_an_unknown_model_is_refused_with_the_nearest_name():
    with pytest.raises(UserError) as refused:
        make_emulator("ld66", laser_of("ld06"))
    assert "ld06" in refused.value.hint
