# SPDX-License-Identifier: Apache-2.0
"""Bumpers, cliff sensors and the hardware e-stop at the guard."""

from math import pi

import pytest

from services.guard.config import GuardConfig
from shared.messages import Contacts, GuardState
from shared.robot import Bumper, CliffSensor
from tests.unit.services.guard.test_guard import MS, ROBOT, GuardDrive

TOUCHING = ROBOT.model_copy(
    update={
        "bumpers": (Bumper(name="front", bearing=0.0, width=pi / 2), Bumper(name="back", bearing=pi, width=pi / 2)),
        "cliffs": (CliffSensor(name="ahead", x=0.19, y=0.0),),
        "estop_input": True,
    }
)


class TouchDrive(GuardDrive):
    """As GuardDrive, with a board that reports contacts at 20 Hz."""

    def __init__(self, **settings):
        super().__init__(robot=TOUCHING, **settings)
        self.bumpers: tuple[str, ...] = ()
        self.cliffs: tuple[str, ...] = ()
        self.pressed = False
        self.silent = False

    def touch(self):
        return self.call(self.guard.touch(Contacts(self.now, self.bumpers, self.cliffs, self.pressed)))

    def odometry(self):
        if self.tick % 5 == 0 and not self.silent:
            self.touch()
        return super().odometry()


def driving(**settings):
    drive = TouchDrive(**settings)
    drive.nav = (0.5, 0.0)
    return drive.run(1.0)


def test_contacts_that_touch_nothing_change_nothing():
    drive = driving()
    assert drive.velocity == pytest.approx((0.5, 0.0))
    assert drive.decision == (GuardState.ACTIVE, "")


@pytest.mark.parametrize(("bumpers", "cliffs", "code"), [(("front",), (), "bumper"), ((), ("ahead",), "cliff")])
def test_a_contact_stops_at_once_and_names_its_sensor(bumpers, cliffs, code):
    drive = driving()
    drive.bumpers, drive.cliffs = bumpers, cliffs
    drive.touch()
    assert drive.velocity == (0.0, 0.0)
    assert drive.decision == (GuardState.HOLD, code)
    assert drive.status.detail == (*bumpers, *cliffs)[0]
    drive.run(3.0)
    assert drive.velocity == (0.0, 0.0)


def test_no_command_that_presses_on_is_obeyed_of_teleop_either():
    drive = driving()
    drive.bumpers, drive.nav = ("front",), None
    for command in ((0.3, 0.0), (0.05, 0.0), (0.0, 1.0), (0.1, 0.5)):
        drive.teleop = command
        drive.run(0.5)
        assert drive.velocity == (0.0, 0.0), command
        assert drive.decision == (GuardState.HOLD, "bumper")


@pytest.mark.parametrize("source", ["teleop", "nav"])
def test_a_command_that_leads_away_is_obeyed_at_creep_speed(source):
    drive = driving()
    drive.bumpers, drive.nav = ("front",), None
    drive.touch()
    setattr(drive, source, (-0.3, 0.0))
    drive.run(1.0)
    creep = GuardConfig().field.creep_speed
    assert drive.velocity == pytest.approx((-creep, 0.0))
    assert drive.decision == (GuardState.ACTIVE, "leaving_contact")


def test_nothing_moves_when_a_bumper_is_released():
    drive = driving()
    drive.bumpers, drive.nav = ("front",), None
    drive.touch()
    drive.run(1.0)
    drive.bumpers = ()
    drive.run(2.0)
    assert drive.velocity == (0.0, 0.0)
    assert drive.decision[1] != "bumper"


def test_what_was_touched_stays_an_obstacle_although_no_laser_sees_it():
    drive = driving()
    drive.bumpers = ("front",)
    drive.touch()
    at = drive.odom_from_base.x
    drive.nav = (-0.3, 0.0)
    drive.run(0.6)
    drive.bumpers = ()
    drive.run(2.0)
    drive.nav = (0.5, 0.0)
    drive.run(4.0)
    assert drive.decision == (GuardState.HOLD, "obstacle")
    assert drive.odom_from_base.x < at


def test_between_two_pressed_bumpers_it_stands_until_a_person_overrides():
    drive = driving()
    drive.bumpers, drive.nav = ("front", "back"), None
    for command in ((0.1, 0.0), (-0.1, 0.0)):
        drive.teleop = command
        drive.run(0.5)
        assert drive.velocity == (0.0, 0.0)
    assert drive.override(5.0).accepted
    drive.run(0.5)
    assert drive.velocity[0] == pytest.approx(-0.1)


def test_an_override_does_not_drive_over_a_cliff():
    drive = driving()
    drive.cliffs, drive.nav, drive.teleop = ("ahead",), None, (0.1, 0.0)
    drive.run(0.5)
    drive.override(5.0)
    drive.run(0.5)
    assert drive.velocity == (0.0, 0.0)
    assert drive.decision == (GuardState.HOLD, "cliff")


def test_silent_contacts_never_count_as_free():
    drive = driving()
    drive.silent = True
    drive.run(0.35)
    assert drive.velocity == (0.0, 0.0)
    assert drive.decision == (GuardState.HOLD, "contacts_old")
    never = TouchDrive()
    never.silent, never.nav = True, (0.5, 0.0)
    never.run(1.0)
    assert never.decision == (GuardState.HOLD, "contacts_old")


def test_a_board_that_reports_contacts_unasked_is_expected_to_go_on():
    drive = GuardDrive()
    drive.nav = (0.5, 0.0)
    drive.run(1.0)
    assert drive.velocity[0] == pytest.approx(0.5)
    drive.call(drive.guard.touch(Contacts(drive.now, (), (), False)))
    drive.run(0.5)
    assert drive.decision == (GuardState.HOLD, "contacts_old")


def test_the_button_latches_and_neither_its_release_nor_the_release_of_stop_moves_the_robot():
    drive = driving()
    drive.pressed = True
    drive.touch()
    assert drive.velocity == (0.0, 0.0)
    assert drive.decision == (GuardState.STOPPED, "estop_input")
    drive.run(1.0)
    drive.stop(False)
    drive.run(1.0)
    assert drive.decision == (GuardState.STOPPED, "estop_input")
    drive.pressed = False
    drive.run(2.0)
    assert drive.decision == (GuardState.STOPPED, "estop")
    drive.stop(False)
    drive.run(2.0)
    assert drive.velocity == (0.0, 0.0)
    assert drive.decision == (GuardState.HOLD, "estop_released")
    drive.nav = (0.0, 0.0)
    drive.run(0.2)
    drive.nav = (0.5, 0.0)
    drive.run(1.0)
    assert drive.velocity[0] == pytest.approx(0.5)


def test_a_pressed_button_refuses_an_override_and_its_silence_does_not_release_it():
    drive = driving()
    drive.pressed = True
    drive.touch()
    assert not drive.override(5.0).accepted
    drive.silent = True
    drive.run(2.0)
    drive.stop(False)
    drive.run(1.0)
    assert drive.decision == (GuardState.STOPPED, "estop_input")


def test_old_and_repeated_contacts_are_refused():
    drive = driving()
    stamp = drive.guard.contacts.stamp
    for age in (10_000 * MS, -10_000 * MS):
        drive.call(drive.guard.touch(Contacts(drive.now - age, ("front",), (), False)))
    drive.call(drive.guard.touch(Contacts(stamp, ("front",), (), False)))
    assert drive.guard.contacts.stamp == stamp
    assert drive.velocity[0] == pytest.approx(0.5)
