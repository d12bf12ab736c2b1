# SPDX-License-Identifier: Apache-2.0
import difflib
from pathlib import Path

import pytest
from ruamel.yaml import YAML

from shared.config import UserError, load_robot
from shared.robot_files import ROBOTS_DIR
from zenav.calibrate.robot_file import values_of, write, yaml_snippet

VALUES = {
    "robot.drive.wheel_radius": 0.0851,
    "robot.drive.wheel_radius_ratio": 1.0052,
    "robot.drive.wheel_distance": 0.28572,
    "robot.laser.mount.yaw": -1.5701,
}
ROBOTS = sorted(path.stem for path in ROBOTS_DIR.glob("*.yaml"))


def copied(folder: Path, robot: str) -> Path:
    path = folder / f"{robot}.yaml"
    path.write_text((ROBOTS_DIR / f"{robot}.yaml").read_text())
    return path


@pytest.mark.parametrize("robot", ROBOTS)
def test_only_the_lines_of_the_settings_change_and_comments_stay(robot, tmp_path):
    path = copied(tmp_path, robot)
    before = path.read_text().splitlines()
    write(str(path), VALUES)
    after = path.read_text().splitlines()
    new = [line[2:].split("#")[0].strip() for line in difflib.ndiff(before, after) if line.startswith("+ ")]
    assert len(new) == 4
    assert new[:3] == ["wheel_radius: 0.0851", "wheel_radius_ratio: 1.0052", "wheel_distance: 0.28572"]
    assert "yaw: -1.5701" in new[3]
    assert [line for line in before if "#" in line and "wheel" not in line.split("#")[0]] == [
        line for line in after if "#" in line and "wheel" not in line.split("#")[0]
    ]
    drive = load_robot(str(path)).robot.drive
    assert (drive.wheel_radius, drive.wheel_radius_ratio, drive.wheel_distance) == (0.0851, 1.0052, 0.28572)


def test_what_is_pasted_reads_as_what_is_written(tmp_path):
    robot = load_robot("x80sv").robot
    text = yaml_snippet(VALUES, values_of({"robot": robot}, VALUES))
    assert YAML(typ="safe").load(text) == {
        "robot": {
            "drive": {"wheel_radius": 0.0851, "wheel_radius_ratio": 1.0052, "wheel_distance": 0.28572},
            "laser": {"mount": {"yaw": -1.5701}},
        }
    }
    assert "wheel_distance: 0.28572  # was 0.283\n" in text


def test_the_own_name_of_a_robot_stays_out_of_the_file_of_its_kind(tmp_path):
    path = copied(tmp_path, "x80sv")
    write(f"red@{path}", VALUES)
    assert load_robot(str(path)).robot.name == load_robot("x80sv").robot.name
    assert load_robot(str(path)).robot.drive.wheel_radius == 0.0851


def test_a_section_that_is_missing_is_made(tmp_path):
    path = copied(tmp_path, "x80sv")
    path.write_text(path.read_text().replace("    mount: {x: 0.13, y: 0.0, yaw: -1.5707963267948966}\n", ""))
    write(str(path), {"robot.laser.mount.x": 0.2})
    assert load_robot(str(path)).robot.laser.mount.x == 0.2


@pytest.mark.parametrize("key", ["robot.drive.wheel_radius_ratio", "odometry.base_turn_scale"])
def test_a_value_out_of_bounds_is_refused_and_the_file_stays(tmp_path, key):
    path = copied(tmp_path, "x80sv")
    before = path.read_bytes()
    with pytest.raises(UserError, match=key):
        write(str(path), {key: 3.0})
    assert path.read_bytes() == before


def test_a_disk_that_takes_nothing_leaves_the_file_as_it_was(tmp_path, monkeypatch):
    path = copied(tmp_path, "x80sv")
    before = path.read_bytes()

    def full(*_: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("os.fsync", full)
    with pytest.raises(UserError, match="No space left"):
        write(str(path), VALUES)
    assert path.read_bytes() == before
    assert [p.name for p in tmp_path.iterdir()] == [path.name]


def test_a_link_to_the_file_stays_a_link(tmp_path):
    path = copied(tmp_path, "x80sv")
    link = tmp_path / "mine.yaml"
    link.symlink_to(path)
    write(str(link), VALUES)
    assert link.is_symlink()
    assert load_robot(str(path)).robot.drive.wheel_radius == 0.0851


def test_the_lines_of_a_laser_of_a_list_are_its_entry():
    robot = load_robot("delivery").robot
    values = {"robot.laser_2.mount.x": -0.37, "robot.laser_2.mount.yaw": -2.35, "robot.drive.wheel_radius": 0.08}
    names = tuple(laser.name for laser in robot.lasers)
    pasted = YAML(typ="safe").load(yaml_snippet(values, dict.fromkeys(values, 1.0), names))
    entry = {"name": "rear", "mount": {"x": -0.37, "yaw": -2.35}}
    assert pasted == {"robot": {"lasers": [entry], "drive": {"wheel_radius": 0.08}}}
