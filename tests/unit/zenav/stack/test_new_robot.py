# SPDX-License-Identifier: Apache-2.0
"""`zenav robot new` copies a robot's file with its comments, and `zenav robots` lists what a name finds."""

import pytest

from shared.config import UserError, load_robot
from shared.robot_files import ROBOTS_DIR
from zenav.__main__ import _status
from zenav.stack.new_robot import description, new_robot

BUILT_IN = sorted(path.stem for path in ROBOTS_DIR.glob("*.yaml"))


@pytest.mark.parametrize("source", BUILT_IN)
def test_a_new_robot_is_a_copy_under_its_own_name(source, tmp_path):
    made = load_robot(str(new_robot("rover", source, tmp_path)))
    origin = load_robot(source)
    assert made.robot == origin.robot.model_copy(update={"name": "rover"})
    assert {k: v for k, v in made.tree.items() if k != "robot"} == {
        k: v for k, v in origin.tree.items() if k != "robot"
    }
    changed = set(origin.path.read_text().splitlines()) - set(made.path.read_text().splitlines())
    assert changed == {f"  name: {origin.robot.name}"}  # comments stay


def test_the_header_says_what_to_do_with_the_file(tmp_path):
    header = new_robot("rover", "x80sv", tmp_path).read_text().partition("robot:\n")[0]
    assert "zenav config check --robot rover" in header
    assert "zenav up --robot rover" in header


def test_a_file_that_exists_is_left_as_it_is(tmp_path):
    (tmp_path / "rover.yaml").write_text("mine")
    with pytest.raises(UserError, match="exists"):
        new_robot("rover", "x80sv", tmp_path)
    assert (tmp_path / "rover.yaml").read_text() == "mine"


@pytest.mark.parametrize("name", ["Rover", "my robot", "../x", "", "9", "rover.yaml"])
def test_an_invalid_name_writes_nothing(name, tmp_path):
    with pytest.raises(UserError, match="invalid robot name"):
        new_robot(name, "x80sv", tmp_path)
    assert not list(tmp_path.iterdir())


def test_a_faulty_robot_is_not_copied(tmp_path):
    (tmp_path / "bad.yaml").write_text("robot:\n  name: bad\n")
    with pytest.raises(UserError, match=r"bad\.yaml"):
        new_robot("rover", str(tmp_path / "bad.yaml"), tmp_path)
    assert not (tmp_path / "rover.yaml").exists()


def test_robots_lists_name_description_and_place(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    assert _status(["robot", "new", "rover", "--from", "jackal"]) == 0
    capsys.readouterr()
    assert _status(["robots"]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert [line.split()[0] for line in lines] == [
        "arduino", "create2", "delivery", "jackal", "rover", "turtlebot2", "turtlebot3_burger", "turtlebot3_ros2",
        "turtlebot4", "x80sv", "x80sv_xv11",
    ]  # fmt: skip
    places = {line.split()[0]: line.rpartition("  ")[2] for line in lines}
    assert places == dict.fromkeys(places, "built in") | {"rover": "here: rover.yaml"}
    assert "Clearpath Jackal" in lines[3]


def test_a_robot_without_a_comment_is_described_by_its_name(tmp_path):
    path = tmp_path / "a.yaml"
    path.write_text("robot:\n  name: rover # mine\n")
    assert description(path) == "rover"
