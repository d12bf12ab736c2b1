# SPDX-License-Identifier: Apache-2.0
"""Robots are found in the current folder and in the package; pages of the manual in a checkout and installed."""

import pytest

from shared import robot_files as module
from shared.config import UserError, configured, load_robot, robot_path
from shared.robot_files import ROBOTS_DIR, is_installed, manual_page, robot_files


def test_a_robot_of_the_current_folder_is_found_by_name_and_comes_before_the_built_in_one(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert robot_path("x80sv") == ROBOTS_DIR / "x80sv.yaml"
    text = (ROBOTS_DIR / "jackal.yaml").read_text()
    (tmp_path / "x80sv.yaml").write_text(text)
    (tmp_path / "rover.yaml").write_text(text)
    assert load_robot("x80sv").robot.name == "jackal"
    assert load_robot("rover").robot.name == "jackal"
    assert load_robot(str(ROBOTS_DIR / "x80sv.yaml")).robot.name == "x80"


def test_robot_files_are_the_built_in_ones_and_those_of_the_folder_with_a_section_robot(tmp_path):
    (tmp_path / "rover.yaml").write_text("# mine\nrobot:\n  name: rover\n")
    (tmp_path / "world.yaml").write_text("about: a robot:\nwalls: []\n")
    (tmp_path / "broken.yaml").write_bytes(b"\xff\xfe")
    found = robot_files(tmp_path)
    built_in = {path.stem for path in ROBOTS_DIR.glob("*.yaml")}
    assert set(found) == {*built_in, "rover"}
    assert built_in >= {"x80sv", "jackal", "turtlebot2", "turtlebot3_burger", "create2", "arduino"}
    assert found["rover"] == tmp_path / "rover.yaml"


def test_a_mistyped_robot_of_the_current_folder_is_hinted_at(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "rover.yaml").write_text("robot:\n  name: rover\n")
    with pytest.raises(UserError, match="there is no robot rovr") as error:
        robot_path("rovr")
    assert "rover" in error.value.hint


def test_a_page_of_the_manual_is_named_as_it_lies(tmp_path, monkeypatch):
    assert manual_page("configuration.md") == "docs/configuration.md"
    monkeypatch.setattr(module, "DOCS_DIR", tmp_path)
    monkeypatch.setattr(module, "files", lambda name: None)
    assert manual_page("configuration.md") == "configuration.md of zenav's manual"


def test_a_built_in_robot_belongs_to_the_package_where_there_is_no_checkout(tmp_path, monkeypatch):
    built_in = ROBOTS_DIR / "x80sv.yaml"
    assert not is_installed(built_in)
    monkeypatch.setattr(module, "DOCS_DIR", tmp_path / "docs")
    assert is_installed(built_in)
    assert not is_installed(tmp_path / "x80sv.yaml")


def test_what_stands_before_an_at_is_the_robots_own_name(tmp_path, monkeypatch):
    assert load_robot("red@x80sv").robot.name == "red"
    assert load_robot("x80sv").robot.name == "x80"
    folder = tmp_path / "user@host"
    folder.mkdir()
    (folder / "mine.yaml").write_text(load_robot("x80sv").text)
    assert load_robot(str(folder / "mine.yaml")).robot.name == "x80"
    assert load_robot(f"red@{folder}/mine.yaml").robot.name == "red"
    monkeypatch.chdir(folder)
    assert load_robot("red@mine.yaml").robot.name == "red"


def test_a_wrong_name_is_told_with_its_option():
    with pytest.raises(UserError, match=r"^--name: robot\.name"):
        _ = load_robot("Red!@x80sv").robot


def test_a_wheel_that_makes_more_counts_a_second_than_a_command_can_hold_is_refused():
    settings = ["robot.drive.counts_per_turn=200000"]
    with pytest.raises(UserError, match="counts_per_turn: at its maximum speeds a wheel makes 1015993 counts a second"):
        _ = configured("jackal", settings).robot
    assert configured("turtlebot4", settings).robot.drive.kind == "velocity", "it gets no counts"
