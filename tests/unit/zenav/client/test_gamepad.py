# SPDX-License-Identifier: Apache-2.0
"""A gamepad's events as the kernel writes them, its dead-man button, and a device that comes and goes."""

import os
import signal
import struct
from pathlib import Path
from typing import ClassVar

import pytest
from hypothesis import given
from hypothesis import strategies as st

from shared.config import UserError
from zenav.client import teleop
from zenav.client.gamepad import RELEASE_S, STEADY_S, Gamepad
from zenav.client.gamepad_device import GamepadDevice

OPENED = bytes.fromhex(
    "e8030000 0000 81 00 e8030000 0000 81 01 e8030000 0000 81 04"  # buttons up
    "e8030000 0000 82 00 e8030000 0000 82 01 e8030000 0180 82 02 e8030000 0000 82 03 e8030000 0000 82 04"
)
"""What an Xbox gamepad sends at opening: its buttons, and its axes with the left trigger at rest."""


def event(kind, number, value):
    return struct.pack("<IhBB", 1000, value, kind, number)


def button(number, down):
    return event(1, number, int(down))


def axis(number, value):
    return event(2, number, value)


def held(*events, at=0.0):
    pad = Gamepad()
    pad.feed(OPENED + button(4, True) + b"".join(events), at)
    return pad


def test_sticks_without_the_dead_man_button_send_nothing():
    pad = Gamepad()
    pad.feed(OPENED + axis(1, -32767) + axis(3, 32767), 0.0)
    assert pad.direction(0.0) is None
    assert "L1" in pad.words(0.0)


def test_up_drives_forward_and_left_turns_left():
    assert held(axis(1, -32767)).direction(0.0) == (1.0, 0.0)
    assert held(axis(1, 32767)).direction(0.0) == (-1.0, 0.0)
    assert held(axis(3, -32767)).direction(0.0) == (0.0, 1.0)
    forward, turn = held(axis(1, -16384), axis(3, 16384)).direction(0.0)
    assert 0.4 < forward < 0.5
    assert -0.5 < turn < -0.4


def test_a_stick_that_rests_a_little_off_its_middle_stands():
    assert held(axis(1, 2000), axis(3, -2000)).direction(0.0) == (0.0, 0.0)


def test_a_release_sends_zero_for_a_while_and_then_leaves_the_robot():
    pad = held(axis(1, -32767))
    assert pad.direction(0.0) == (1.0, 0.0)
    pad.feed(button(4, False), 0.1)
    assert pad.direction(0.1) == (0.0, 0.0)
    assert pad.direction(RELEASE_S) == (0.0, 0.0)
    assert pad.direction(RELEASE_S + 0.1) is None


def test_a_button_that_is_held_at_the_opening_counts_from_its_next_press():
    pad = Gamepad()
    pad.feed(event(0x81, 4, 1) + event(0x82, 1, -32767), 0.0)
    assert pad.direction(0.0) is None
    pad.feed(button(4, False) + button(4, True), 1.0)
    assert pad.direction(1.0) == (1.0, 0.0)


def test_a_gamepad_that_is_pulled_out_while_driving_stands_and_does_not_go_on_by_itself():
    pad = held(axis(1, -32767))
    pad.direction(0.0)
    pad.unplug()
    assert pad.direction(0.05) == (0.0, 0.0)
    pad.feed(event(0x81, 4, 1) + event(0x82, 1, -32767), 0.1)
    assert pad.direction(0.1) == (0.0, 0.0)
    assert pad.direction(2.0) is None


def test_a_radio_link_that_is_silent_lets_the_robot_stand():
    pad = held(axis(1, -32767))
    assert pad.direction(STEADY_S) == (1.0, 0.0)
    assert pad.direction(STEADY_S + 0.1) == (0.0, 0.0)
    assert "move a stick" in pad.words(STEADY_S + 0.1)
    pad.feed(axis(1, -32766), STEADY_S + 1)
    assert pad.direction(STEADY_S + 1)[0] > 0.99


def test_the_stop_button_needs_no_dead_man_and_is_no_state_at_the_opening():
    pad = Gamepad()
    pad.feed(event(0x81, 1, 1), 0.0)
    assert not pad.stop_pressed
    pad.feed(button(1, True), 0.0)
    assert pad.stop_pressed


@given(st.lists(st.binary(max_size=30), max_size=20))
def test_events_in_any_pieces_and_any_bytes_stay_within_bounds(chunks):
    pad = Gamepad()
    for k, chunk in enumerate(chunks):
        pad.feed(chunk, float(k))
        forward, turn = pad.direction(float(k)) or (0.0, 0.0)
        assert -1 <= forward <= 1
        assert -1 <= turn <= 1


def test_events_that_come_in_pieces_are_whole():
    data, pad = OPENED + button(4, True) + axis(1, -32767), Gamepad()
    for k in range(len(data)):
        pad.feed(data[k : k + 1], 0.0)
    assert pad.direction(0.0) == (1.0, 0.0)


def test_a_device_is_found_read_lost_and_found_again(tmp_path, monkeypatch):
    monkeypatch.setattr("zenav.client.gamepad_device.AGAIN_S", 0.0)
    with GamepadDevice(folder=tmp_path) as device:
        assert device.read(0.0) is None
        for _ in range(2):
            path = tmp_path / "js0"
            os.mkfifo(path)
            writer = os.open(path, os.O_RDWR)  # a reader of its own, so that opening does not wait
            os.write(writer, OPENED)
            assert device.read(1.0) == OPENED
            assert device.is_open
            assert device.read(0.0) == b""
            os.close(writer)
            path.unlink()
            assert device.read(1.0) is None
            assert not device.is_open


def test_a_device_that_may_not_be_opened_says_what_to_do(tmp_path, monkeypatch):
    path = tmp_path / "js0"
    path.touch()

    def refuse(*_):
        raise PermissionError

    monkeypatch.setattr(os, "open", refuse)
    with pytest.raises(UserError) as error, GamepadDevice(folder=Path(tmp_path)) as device:
        device.read(0.0)
    assert "js0 may not be opened" in error.value.what
    assert "input" in error.value.hint


class FakeClient:
    """Hears what teleop publishes; after `last` commands it presses Ctrl-C. At the third one the gamepad is lost."""

    sent: ClassVar[list] = []
    lose: ClassVar = None
    last = 12

    def __init__(self, *_):
        pass

    def __enter__(self):
        return self

    def __exit__(self, *_):
        pass

    def follow(self, *_):
        pass

    def latest(self, _):
        return None

    def now(self):
        return 10**18

    def publish(self, publication):
        self.sent.append((publication.message.v, publication.message.w))
        if len(self.sent) == 3:
            self.lose()
        if len(self.sent) == self.last:
            os.kill(os.getpid(), signal.SIGINT)


def test_teleop_drives_while_the_gamepad_is_there_and_ends_with_zero(tmp_path, monkeypatch):
    path = tmp_path / "js0"
    os.mkfifo(path)
    writer = os.open(path, os.O_RDWR)
    os.write(writer, OPENED + button(4, True) + axis(1, -32767))
    monkeypatch.setattr(FakeClient, "sent", [])
    monkeypatch.setattr(FakeClient, "lose", staticmethod(lambda: (os.close(writer), path.unlink())))
    monkeypatch.setattr(teleop, "Client", FakeClient)
    teleop.teleop_gamepad("x80sv", "0", 0.4, 45.0, False, str(path))
    assert FakeClient.sent[:3] == [(0.4, 0.0)] * 3
    assert set(FakeClient.sent[4:]) == {(0.0, 0.0)}
