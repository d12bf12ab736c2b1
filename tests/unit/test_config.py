# SPDX-License-Identifier: Apache-2.0
"""An error of a configuration names file, line, key and the nearest valid name."""

from pathlib import Path
from typing import ClassVar

import pytest
from pydantic import Field, ValidationError

from services.local_ctrl.footprint import footprint_of
from shared.config import Robot, Section, UserError, configured, load_robot
from shared.robot_files import ROBOTS_DIR

X80SV = ROBOTS_DIR / "x80sv.yaml"


class LimitsSection(Section):
    stop_margin: float = Field(0.1, ge=0.02, le=1, description="m free in front")


class GuardSection(Section):
    limits: LimitsSection = LimitsSection()


def robot_with(tmp_path: Path, old: str, new: str) -> Path:
    text = X80SV.read_text()
    assert old in text
    path = tmp_path / "robot.yaml"
    path.write_text(text.replace(old, new))
    return path


@pytest.mark.parametrize("name", ["x80sv", "jackal"])
def test_the_shipped_robots_are_valid(name):
    robot = load_robot(name).robot
    assert 0 < robot.inscribed_radius <= robot.circumscribed_radius


def test_a_typo_names_its_line_and_the_nearest_setting(tmp_path):
    path = tmp_path / "robot.yaml"
    path.write_text("guard:\n  limits:\n    stop_margn: 0.2\n")
    with pytest.raises(UserError, match=r"robot\.yaml:3: guard\.limits\.stop_margn is not a setting") as error:
        load_robot(str(path)).section("guard", GuardSection)
    assert "stop_margin" in error.value.hint


def test_a_typo_in_a_setting_that_must_be_there_is_told_as_a_typo(tmp_path):
    path = robot_with(tmp_path, "wheel_radius: 0.085", "wheel_raduis: 0.085")
    with pytest.raises(UserError, match=r"robot\.yaml:\d+: robot\.drive\.wheel_raduis is not a setting") as error:
        _ = load_robot(str(path)).robot
    assert "wheel_radius" in error.value.hint


def test_a_negative_radius_is_an_error_with_its_line(tmp_path):
    path = robot_with(tmp_path, "wheel_radius: 0.085", "wheel_radius: -0.085")
    with pytest.raises(UserError, match=r"robot\.yaml:\d+: robot\.drive\.wheel_radius: .*greater than 0"):
        _ = load_robot(str(path)).robot


@pytest.mark.parametrize(
    ("footprint", "inscribed"),
    [
        (((-0.6, -0.2), (0.4, -0.2), (0.4, 0.8), (0.1, 0.8), (0.1, 0.1), (-0.6, 0.1)), 0.1),
        (((-0.2, -0.2), (0.8, -0.2), (0.8, 0.2), (0.2, 0.2), (0.2, 0.8), (-0.2, 0.8)), 0.2),
        (((-0.7, -0.2), (0.3, -0.2), (0.3, 0.2), (-0.3, 0.2), (-0.3, 0.8), (-0.7, 0.8)), 0.2),
    ],
)
def test_an_outline_with_a_corner_inwards_has_its_base_inside(footprint, inscribed):
    robot = load_robot("x80sv").robot
    bent = Robot.model_validate({**robot.model_dump(), "footprint": footprint})
    assert bent.inscribed_radius == pytest.approx(inscribed)
    aside = [(x - 0.9, y) for x, y in footprint]
    with pytest.raises(ValidationError, match="must lie inside"):
        Robot.model_validate({**robot.model_dump(), "footprint": aside})


def test_a_clockwise_footprint_is_refused():
    robot = load_robot("x80sv").robot
    with pytest.raises(ValueError, match="counter-clockwise"):
        Robot.model_validate({**robot.model_dump(), "footprint": robot.footprint[::-1]})


def test_a_round_robot_is_a_polygon_that_hardly_reaches_beyond_its_circle():
    robot = load_robot("x80sv").robot
    round_one = Robot.model_validate({**robot.model_dump(), "footprint": (), "radius": 0.3})
    assert round_one.inscribed_radius == pytest.approx(0.3)
    assert 0.3 < round_one.circumscribed_radius < 0.3 * 1.005
    assert len(footprint_of(round_one, 0.03).circles) == 1


@pytest.mark.parametrize(
    ("footprint", "radius", "words"),
    [((), None, "either"), (((1, 0), (0, 1), (-1, -1)), 0.3, "either"), (((1, 0), (0, 1)), None, "three corners")],
)
def test_a_robot_has_one_outline(footprint, radius, words):
    robot = load_robot("x80sv").robot
    with pytest.raises(ValueError, match=words):
        Robot.model_validate({**robot.model_dump(), "footprint": footprint, "radius": radius})


DELIVERY = load_robot("delivery").robot
FRONT, REAR = (laser.model_dump() for laser in DELIVERY.lasers)


def test_the_first_of_two_lasers_is_the_robots_laser_and_a_single_one_is_all():
    assert [laser.name for laser in DELIVERY.all_lasers] == ["front", "rear"]
    assert DELIVERY.laser == DELIVERY.lasers[0]
    x80 = load_robot("x80sv").robot
    assert (x80.lasers, x80.all_lasers) == ((), (x80.laser,))
    assert Robot.model_validate(DELIVERY.model_dump()) == DELIVERY


def test_the_mapper_uses_the_first_laser_and_the_other_one_unless_its_mapping_is_off():
    assert DELIVERY.mapping_lasers == DELIVERY.all_lasers
    front_only = Robot.model_validate(DELIVERY.model_dump() | {"lasers": [FRONT, {**REAR, "mapping": False}]})
    assert [laser.name for laser in front_only.mapping_lasers] == ["front"]
    x80 = load_robot("x80sv").robot
    assert x80.mapping_lasers == (x80.laser,)


@pytest.mark.parametrize(
    ("lasers", "words"),
    [
        ([FRONT, {**REAR, "name": "front"}], "each has a name of its own"),
        ([FRONT, {**REAR, "name": ""}], "each has a name of its own"),
        ([{**FRONT, "mapping": False}, REAR], "the mapper always uses the first laser"),
        ([FRONT, REAR, {**REAR, "name": "top"}], "at most 2 items"),
        ([{**FRONT, "n_beams": 1100}, REAR], "more than a full turn"),
        ([{**FRONT, "angle_increment": 0.0}, REAR], "angle_increment is not 0"),
        ([{**FRONT, "range_min": 6.0}, REAR], "range_min is under range_max"),
        ([{**FRONT, "name": "Front!"}, REAR], "match pattern"),
        ([], "required"),
    ],
)
def test_lasers_that_make_no_sense_are_refused(lasers, words):
    values = DELIVERY.model_dump(exclude={"laser"})
    with pytest.raises(ValidationError, match=words):
        Robot.model_validate({**values, "lasers": lasers})


def test_a_robot_has_laser_or_lasers_and_the_error_names_file_and_line(tmp_path):
    path = tmp_path / "robot.yaml"
    text = load_robot("delivery").text
    laser = "{angle_min: 0, angle_increment: 0.1, n_beams: 9, scan_time: 0.1, rate: 10, range_min: 0.1, range_max: 5}"
    path.write_text(text.replace("  lasers:", f"  laser: {laser}\n  lasers:"))
    with pytest.raises(UserError, match="give either laser or lasers"):
        _ = load_robot(str(path)).robot
    path.write_text(text.replace("n_beams: 681", "n_beams: 1", 1))
    with pytest.raises(UserError) as error:
        _ = load_robot(str(path)).robot
    line = 1 + next(i for i, row in enumerate(path.read_text().splitlines()) if "n_beams" in row)
    assert error.value.what.startswith(f"{path}:{line}: robot.lasers.0.n_beams")


def test_a_setting_of_the_laser_is_one_of_the_first_laser():
    file = load_robot("delivery")
    file.override("robot.laser.range_max=4.0")
    assert [laser.range_max for laser in file.robot.all_lasers] == [4.0, 5.6]


def test_an_unknown_section_names_the_nearest(tmp_path):
    path = tmp_path / "robot.yaml"
    path.write_text("gaurd:\n  limits: {}\n")
    with pytest.raises(UserError, match="gaurd") as error:
        load_robot(str(path)).unknown_sections(("robot", "guard"))
    assert "`guard`" in error.value.hint


def test_overrides_are_checked_like_the_file():
    file = load_robot("x80sv")
    file.override("guard.limits.stop_margin=0.3")
    assert file.section("guard", GuardSection).limits.stop_margin == 0.3
    file.override("guard.limits.stop_margin=-1")
    with pytest.raises(UserError, match=r"^--set: guard\.limits\.stop_margin"):
        file.section("guard", GuardSection)


@pytest.mark.parametrize("assignment", ["", "guard", "guard=1", "a.b", ".=1", "a.=2", "a.b=[", "robot.name.x=1"])
def test_a_malformed_override_is_told(assignment):
    with pytest.raises(UserError):
        load_robot("x80sv").override(assignment)


@pytest.mark.parametrize("text", ["a: [", "- 1\n- 2\n", "", "\x00", "a: 1\na: 2\n"])
def test_a_file_that_is_no_configuration_is_told(tmp_path, text):
    path = tmp_path / "robot.yaml"
    path.write_text(text)
    with pytest.raises(UserError):
        _ = load_robot(str(path)).robot


def test_a_robot_that_does_not_exist_names_the_nearest():
    with pytest.raises(UserError) as error:
        load_robot("x80s")
    assert "x80sv" in error.value.hint


def test_a_robot_that_may_not_turn_on_the_spot_needs_a_turning_radius():
    with pytest.raises(UserError, match="needs a min_turning_radius"):
        assert configured("x80sv", ["robot.drive.turns_in_place=false"]).robot
    drive = configured("x80sv", ["robot.drive.turns_in_place=false", "robot.drive.min_turning_radius=0.5"]).robot.drive
    assert drive.clamped(0.0, 1.0) == (0.0, 0.0)
    assert drive.clamped(0.2, -1.0) == pytest.approx((0.2, -0.4))
    spins = drive.model_copy(update={"turns_in_place": True})
    assert spins.clamped(0.0, 1.0) == (0.0, 1.0)
    assert spins.clamped(0.2, 1.0) == pytest.approx((0.2, 0.4))


class Renamed(Section):
    RENAMED: ClassVar[dict[str, str]] = {"least": "min_speed"}
    min_speed: float = Field(1.0, gt=0)


class Outer(Section):
    RENAMED: ClassVar[dict[str, str]] = {"old_part": "part"}
    part: Renamed = Renamed()
    parts: tuple[Renamed, ...] = ()


def section_of(tmp_path: Path, text: str) -> Outer:
    path = tmp_path / "robot.yaml"
    path.write_text(text)
    return load_robot(str(path)).section("outer", Outer)


def test_a_former_name_of_a_setting_works_with_a_warning_that_gives_the_present_one(tmp_path, caplog):
    text = "outer:\n  old_part:\n    least: 2.0\n  parts:\n    - {least: 3.0}\n"
    outer = section_of(tmp_path, text)
    assert (outer.part.min_speed, outer.parts[0].min_speed) == (2.0, 3.0)
    assert [record.getMessage().split("robot.yaml:")[1] for record in caplog.records] == [
        "2: outer.old_part is now `part`",
        "3: outer.old_part.least is now `min_speed`",
        "5: outer.parts.0.least is now `min_speed`",
    ]


def test_the_present_name_of_a_setting_gives_no_warning(tmp_path, caplog):
    assert section_of(tmp_path, "outer: {part: {min_speed: 2.0}}").part.min_speed == 2.0
    assert not caplog.records


def test_both_names_of_a_setting_are_an_error_with_its_line(tmp_path):
    with pytest.raises(UserError, match=r"robot\.yaml:2: outer\.part: .*`least` and `min_speed`"):
        section_of(tmp_path, "outer:\n  part: {least: 2.0, min_speed: 3.0}\n")


def test_a_fault_under_a_former_name_is_an_error(tmp_path):
    with pytest.raises(UserError, match=r"robot\.yaml:\d: outer\.part\.min_speed: .*greater than 0"):
        section_of(tmp_path, "outer:\n  old_part: {least: -2.0}\n")
