# SPDX-License-Identifier: Apache-2.0
"""The commands, on a minute's recording of a simulated robot that is not what its file says."""

import re
from pathlib import Path
from typing import Any

import pytest
from PIL import Image
from ruamel.yaml import YAML

from shared.config import Robot, UserError, load_robot
from shared.recording import Recording, Writer, about, sink
from shared.robot_files import ROBOTS_DIR
from tests.unit.zenav.calibrate.drive import CalibrationBench
from zenav.__main__ import _status
from zenav.calibrate import odometry
from zenav.calibrate.log import TOPICS, CalibrationLog, read_calibration_log
from zenav.calibrate.manoeuvre import square, stand, turn_to
from zenav.calibrate.odometry import by_squares, drift, truth
from zenav.calibrate.rolling import WheelGeometry

HALL = """
start: {x: 3.0, y: 3.0}
walls:
  - {points: [[0, 0], [6, 0], [6, 6], [0, 6]], closed: true}
boxes:
  - {x: 5.6, y: 5.2, size: [0.6, 1.0]}
  - {x: 0.4, y: 0.9, size: [0.5, 1.2]}
  - {x: 1.3, y: 5.7, size: [1.5, 0.4]}
"""
RATIO, DISTANCE = 1.02 / 0.98, 0.283 * 1.05
MOUNT = {"x": 0.10, "y": 0.03, "yaw": -1.48}
ERRORS = ("sim.drive.radius_error=0.04", "sim.drive.distance_error=0.05", "sim.drive.slip=0.005")


@pytest.fixture(scope="module")
def drive_of_squares(tmp_path_factory) -> Path:
    """A square each way round, in a hall."""
    folder = tmp_path_factory.mktemp("calibrate")
    (folder / "hall.yaml").write_text(HALL)
    path = folder / "squares.mcap"
    with Writer(path, about("x80")) as writer:
        bench = CalibrationBench(*ERRORS, world=str(folder / "hall.yaml"), truth=MOUNT, record=sink(writer))
        for clockwise in (True, False):
            bench.perform(stand(1.5))
            bench.perform(square(1.2, clockwise, 0.4, 1.2, bench.robot.drive))
            bench.perform(stand(1.5))
    return path


@pytest.fixture(scope="module")
def solutions() -> dict[Any, Any]:
    """What `by_scans` said, by all that it is made from."""
    return {}


@pytest.fixture(autouse=True)
def solved_once(solutions, monkeypatch) -> None:
    """Two commands place the same scans of the same robot: the second takes what the first one found."""

    def by_scans(log: CalibrationLog, robot: Robot) -> Any:
        scans = tuple((scan.stamp, scan.ranges.tobytes()) for scan in log.scans)
        rolled = tuple(column.tobytes() for column in log.rolled)
        key = scans, rolled, robot.model_dump_json()
        if key not in solutions:
            solutions[key] = computed(log, robot)
        return solutions[key]

    computed = odometry.by_scans
    monkeypatch.setattr(odometry, "by_scans", by_scans)


@pytest.fixture
def robot(tmp_path, monkeypatch) -> Path:
    """A copy of the robot's file, in a folder of its own where plots may land."""
    monkeypatch.chdir(tmp_path)
    path = tmp_path / "mine.yaml"
    path.write_text((ROBOTS_DIR / "x80sv.yaml").read_text())
    return path


def told(capsys, *arguments: object) -> tuple[str, dict]:
    """The report and the YAML of a command that ends well."""
    assert _status(["calibrate", *map(str, arguments)]) == 0
    out = capsys.readouterr().out
    return out, YAML(typ="safe").load(out)


def complaint(capsys, *arguments: object) -> list[str]:
    assert _status(["calibrate", *map(str, arguments)]) == 2
    out, err = capsys.readouterr()
    lines = err.splitlines()
    assert len(lines) == 2, err
    assert lines[1].startswith("hint: ")
    assert out == ""
    return lines


def plotted(folder: Path, name: str) -> None:
    (plot,) = folder.glob(f"out/calibrate-*/{name}.png")
    with Image.open(plot) as image:
        assert len(image.getcolors(1 << 20) or ()) > 10


def test_the_wheels_are_found_and_written(drive_of_squares, robot, capsys, tmp_path):
    report, _ = told(capsys, "odometry", "--recording", drive_of_squares, "--robot", robot, "--write")
    drive = load_robot(str(robot)).robot.drive
    assert drive.wheel_radius_ratio == pytest.approx(RATIO, abs=0.005)
    assert drive.wheel_distance == pytest.approx(DISTANCE, rel=0.005)
    assert drive.wheel_radius == pytest.approx(0.085, rel=0.005)
    assert "1 squares clockwise, 1 counter-clockwise" in report
    plotted(tmp_path, "odometry")


def test_umbmark_alone_leaves_the_mean_radius(drive_of_squares, robot, capsys):
    _, tree = told(
        capsys, "odometry", "--recording", drive_of_squares, "--robot", robot, "--method", "umbmark", "--truth", "sim"
    )
    assert set(tree["robot"]["drive"]) == {"wheel_radius_ratio", "wheel_distance"}
    assert tree["robot"]["drive"]["wheel_radius_ratio"] == pytest.approx(RATIO, abs=0.006)
    assert tree["robot"]["drive"]["wheel_distance"] == pytest.approx(DISTANCE, rel=0.01)
    assert load_robot(str(robot)).robot.drive.wheel_radius_ratio == 1.0


def test_the_error_that_is_left_is_a_fraction_of_the_first_one(drive_of_squares, robot):
    configured = load_robot(str(robot)).robot
    log = read_calibration_log(drive_of_squares, configured)
    known = truth(log, configured, "sim", None)
    squares = by_squares(log, configured, known)
    before, after = (drift(log.rolled, known, w) for w in (WheelGeometry.of(configured.drive), squares.result.wheels))
    assert before is not None
    assert after is not None
    assert after[1] < before[1] / 3


def test_ends_that_were_measured_with_a_tape_tell_the_same(drive_of_squares, robot):
    configured = load_robot(str(robot)).robot
    log = read_calibration_log(drive_of_squares, configured)
    by_truth = by_squares(log, configured, truth(log, configured, "sim", None))
    by_tape = by_squares(log, configured, None, by_truth.true[:, :2].round(3))
    assert tuple(by_tape.result.wheels) == pytest.approx(tuple(by_truth.result.wheels), rel=1e-3)
    with pytest.raises(UserError, match="2 squares were driven, 1 measured"):
        by_squares(log, configured, None, by_truth.true[:1, :2])


def test_the_laser_s_mount_is_found_and_written(drive_of_squares, robot, capsys, tmp_path):
    told(capsys, "laser", drive_of_squares, "--robot", robot, "--write")
    mount = load_robot(str(robot)).robot.laser.mount
    assert (mount.x, mount.y) == pytest.approx((MOUNT["x"], MOUNT["y"]), abs=0.005)
    assert mount.yaw == pytest.approx(MOUNT["yaw"], abs=0.01)
    plotted(tmp_path, "laser")


def test_the_second_laser_is_calibrated_by_its_own_scans(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    path, mine = tmp_path / "squares.mcap", tmp_path / "mine.yaml"
    (tmp_path / "hall.yaml").write_text(HALL)
    with Writer(path, about("delivery")) as writer:
        bench = CalibrationBench(
            "sim.drive.slip=0.005", world=str(tmp_path / "hall.yaml"), robot="delivery", record=sink(writer)
        )
        for clockwise in (True, False):
            bench.perform(square(0.8, clockwise, 0.4, 1.2, bench.robot.drive))
    front, rear = load_robot("delivery").robot.lasers
    text = (ROBOTS_DIR / "delivery.yaml").read_text()
    mine.write_text(text.replace("{x: -0.38, y: -0.23, yaw: -2.35", "{x: -0.34, y: -0.20, yaw: -2.45"))
    assert load_robot(str(mine)).robot.laser_2.mount != rear.mount
    told(capsys, "laser", path, "--robot", mine, "--laser", "rear", "--write")
    found = load_robot(str(mine)).robot
    assert (found.laser_2.mount.x, found.laser_2.mount.y) == pytest.approx((rear.mount.x, rear.mount.y), abs=0.01)
    assert found.laser_2.mount.yaw == pytest.approx(rear.mount.yaw, abs=0.01)
    assert found.laser == front
    what, hint = complaint(capsys, "laser", path, "--robot", mine, "--laser", "raer")
    assert "robot.lasers has no laser 'raer'" in what
    assert "rear" in hint
    assert "one laser" in complaint(capsys, "laser", path, "--laser", "rear")[1]


class CalibrationDrive(CalibrationBench):
    """In the place of the operator at a running stack."""

    def __init__(self, robot: object, stack: str) -> None:
        super().__init__()

    def __enter__(self) -> "CalibrationDrive":
        return self

    def __exit__(self, *error: object) -> None: ...


def test_the_motors_are_tried_and_what_they_did_is_told_plotted_and_written(robot, capsys, tmp_path, monkeypatch):
    monkeypatch.setattr("zenav.calibrate.live.ManoeuvreRunner", CalibrationDrive)
    before = load_robot(str(robot)).robot.drive.max_braking
    report, tree = told(capsys, "motors", "--robot", robot, "--yes", "--write")
    braking = load_robot(str(robot)).robot.drive.max_braking
    assert tree["robot"]["drive"] == {"max_braking": braking}
    assert braking != before
    for words in ("directions: each wheel turns as asked", "dead band: the right wheel", "steps: the left wheel"):
        assert words in report
    stood, by_file, by_result = map(float, re.findall(r"(\d\.\d{3}) m", report.partition("the longest stop")[2])[:3])
    assert abs(by_result - stood) < 0.05 * stood < abs(by_file - stood)
    plotted(tmp_path, "motors")


def part_of(recording: Path, to: Path, keys: tuple[str, ...], seconds: float, robot: str = "x80") -> Path:
    """The first seconds of some topics of a recording."""
    with Writer(to, about(robot)) as writer:
        first = None
        for entry in Recording(recording).entries(keys):
            first = entry.sent if first is None else first
            if entry.sent - first < seconds * 1e9:
                writer.copy(entry)
    return to


EVERY = tuple(topic.key for topic in TOPICS)


@pytest.mark.parametrize(
    ("keys", "seconds", "name", "what"),
    [
        (EVERY, 6.0, "x80", "the drive turns by"),
        (EVERY, 1.5, "x80", "there are 1"),
        (("base/wheels",), 100.0, "x80", "there are 0 scans"),
        (("scan",), 100.0, "x80", "there is no motion of the base"),
        (("cmd/vel",), 100.0, "x80", "neither base/wheels, base/odometry nor scan"),
        (EVERY, 6.0, "jackal", "is a recording of jackal, not of x80"),
    ],
)
def test_a_recording_that_cannot_tell_is_refused_in_one_line(
    drive_of_squares, robot, tmp_path, capsys, keys, seconds, name, what
):
    path = part_of(drive_of_squares, tmp_path / "part.mcap", keys, seconds, name)
    assert what in complaint(capsys, "laser", path, "--robot", robot)[0]
    assert what in complaint(capsys, "odometry", "--recording", path, "--method", "scans", "--robot", robot)[0]


def test_a_drive_without_squares_is_refused_by_umbmark(drive_of_squares, robot, tmp_path, capsys):
    path = part_of(drive_of_squares, tmp_path / "part.mcap", EVERY, 12.0)
    lines = complaint(capsys, "odometry", "--recording", path, "--method", "umbmark", "--robot", robot)
    assert "there is no square in this drive" in lines[0]


def test_another_laser_s_scans_are_refused(drive_of_squares, tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert "another laser" in complaint(capsys, "laser", drive_of_squares, "--robot", "x80sv_xv11")[0]


@pytest.mark.parametrize("content", [b"", b"no recording"])
def test_what_is_no_recording_is_refused(content, tmp_path, capsys):
    path = tmp_path / "bad.mcap"
    path.write_bytes(content)
    assert str(path) in complaint(capsys, "laser", path)[0]


def test_turning_on_the_spot_alone_does_not_tell_the_laser_s_heading(robot, tmp_path, capsys):
    (tmp_path / "hall.yaml").write_text(HALL)
    path = tmp_path / "spin.mcap"
    with Writer(path, about("x80")) as writer:
        bench = CalibrationBench(*ERRORS, world=str(tmp_path / "hall.yaml"), record=sink(writer))
        for yaw in (2.0, -2.0) * 2:
            bench.perform(turn_to(yaw, 1.5, bench.robot.drive, bench.newest["odom"].odom_from_base))
    what, hint = complaint(capsys, "laser", path, "--robot", robot)
    assert "straight on for 0" in what
    assert "metres straight on" in hint


def test_late_and_repeated_messages_are_left_out(drive_of_squares, robot):
    log = read_calibration_log(drive_of_squares, load_robot(str(robot)).robot)
    again = CalibrationLog()
    for message in [*log.scans[:3], log.scans[1], *log.wheels[:5], log.wheels[0]]:
        again.add(message)
    assert (len(again.scans), len(again.wheels), again.n_late) == (3, 5, 2)


@pytest.mark.parametrize(
    ("command", "way_out"),
    [
        (("motors", "--yes"), "zenav calibrate laser"),
        (("odometry", "--yes", "--measured"), "leave out --measured"),
        (("odometry", "--yes", "--method", "umbmark"), "leave out --measured"),
    ],
)
def test_the_wheels_of_a_velocity_base_are_not_calibrated_here(command, way_out, capsys):
    what, hint = complaint(capsys, *command, "--robot", "turtlebot3_burger")
    assert "turtlebot3_burger is a velocity base" in what
    assert way_out in hint


def test_the_odometry_and_the_laser_of_a_velocity_base_are_calibrated_by_its_scans(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    path, robot = tmp_path / "squares.mcap", tmp_path / "mine.yaml"
    robot.write_text((ROBOTS_DIR / "turtlebot3_burger.yaml").read_text())
    (tmp_path / "hall.yaml").write_text(HALL)
    with Writer(path, about("turtlebot3")) as writer:
        bench = CalibrationBench(
            "sim.drive.slip=0.005",
            "sim.drive.radius_error=0",
            "sim.drive.size_error=0.03",
            "sim.drive.distance_error=0.05",
            world=str(tmp_path / "hall.yaml"),
            robot="turtlebot3_burger",
            truth={"x": -0.02, "y": 0.01},
            record=sink(writer),
        )
        for clockwise in (True, False):
            bench.perform(square(0.8, clockwise, 0.2, 1.2, bench.robot.drive))
    assert _status(["calibrate", "odometry", "--recording", str(path), "--robot", str(robot), "--write"]) == 0
    assert _status(["calibrate", "laser", str(path), "--robot", str(robot), "--write"]) == 0
    tree = YAML().load(robot.read_text())
    assert tree["odometry"]["base_distance_scale"] == pytest.approx(1.03, abs=0.005)
    assert tree["odometry"]["base_turn_scale"] == pytest.approx(1.03 / 1.05, abs=0.005)
    assert tree["robot"]["laser"]["mount"]["x"] == pytest.approx(-0.02, abs=0.005)
    assert tree["robot"]["laser"]["mount"]["y"] == pytest.approx(0.01, abs=0.005)
