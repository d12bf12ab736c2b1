# SPDX-License-Identifier: Apache-2.0
"""A gamepad drives only while its dead-man button is held, and a lost one holds nothing."""

import os
import threading
import time

import pytest
from hypothesis import given
from hypothesis import strategies as st

from zenav.client.gamepad import (
    DEAD_MAN_BUTTONS,
    DEAD_ZONE,
    EV_ABS,
    EV_KEY,
    EV_SYN,
    EVENT,
    FORWARD_AXIS,
    STEADY_S,
    STOP_BUTTON,
    SYN_DROPPED,
    TURN_AXIS,
    AxisRange,
    Gamepad,
)
from zenav.client.gamepad_device import GamepadDevice

LEFT_SHOULDER, RIGHT_SHOULDER = sorted(DEAD_MAN_BUTTONS)
RANGES = {FORWARD_AXIS: AxisRange(-32768, 32767), TURN_AXIS: AxisRange(0, 255)}
LIMIT_S = 10.0
KERNEL = bytes.fromhex(
    # struct input_event as a 64-bit kernel lays it out: BTN_TL down, ABS_Y -32768, SYN_REPORT
    "1b2c5e6500000000a1b2030000000000" "0100" "3601" "01000000"
    "1b2c5e6500000000a1b2030000000000" "0300" "0100" "0080ffff"
    "1b2c5e6500000000a1b2030000000000" "0000" "0000" "00000000"
)  # fmt: skip


def event(kind: int, code: int, value: int) -> bytes:
    return EVENT.pack(1_700_000_000, 5, kind, code, value)


def key(code: int, value: int) -> bytes:
    return event(EV_KEY, code, value)


def axis(code: int, value: int) -> bytes:
    return event(EV_ABS, code, value)


@pytest.mark.skipif(EVENT.size != 24, reason="the events are those of a 64-bit computer")
def test_events_as_the_kernel_lays_them_out_drive_forward():
    pad = Gamepad(RANGES)
    pad.take(KERNEL, 0.0)
    assert pad.direction(0.0) == (1.0, 0.0)


@given(st.lists(st.tuples(st.sampled_from((FORWARD_AXIS, TURN_AXIS)), st.integers(-40_000, 40_000)), max_size=9))
def test_without_the_dead_man_button_no_stick_drives(moves):
    pad = Gamepad(RANGES)
    for code, value in moves:
        pad.take(axis(code, value), 0.0)
    assert pad.direction(0.0) == (0.0, 0.0)
    pad.take(key(RIGHT_SHOULDER, 1), 0.0)
    assert all(-1 <= share <= 1 for share in pad.direction(0.0))
    pad.take(key(RIGHT_SHOULDER, 0), 0.0)
    assert pad.direction(0.0) == (0.0, 0.0)


@given(st.integers(0, 255), st.integers(0, 255))
def test_a_stick_is_steady_and_odd_around_its_middle(first, second):
    turn = RANGES[TURN_AXIS]
    assert (turn.share(first) - turn.share(second)) * (first - second) >= 0
    assert abs(turn.share(first) - turn.share(second)) <= abs(first - second) / 127.5 / (1 - DEAD_ZONE) + 1e-9
    assert turn.share(255 - first) == pytest.approx(-turn.share(first))


def test_the_sticks_have_the_signs_of_rep_103():
    pad = Gamepad(RANGES)
    pad.take(key(LEFT_SHOULDER, 1) + axis(FORWARD_AXIS, -32768) + axis(TURN_AXIS, 0), 0.0)
    assert pad.direction(0.0) == (1.0, 1.0), "up is forward, left is counter-clockwise"


def test_lost_events_release_all_until_a_button_is_pressed_again():
    pad = Gamepad(RANGES)
    pad.take(key(LEFT_SHOULDER, 1) + axis(FORWARD_AXIS, -32768) + event(EV_SYN, SYN_DROPPED, 0), 0.0)
    assert pad.direction(0.0) == (0.0, 0.0)
    pad.take(axis(FORWARD_AXIS, -32768) + key(LEFT_SHOULDER, 2), 0.0)  # it repeats: it was held before
    assert pad.direction(0.0) == (0.0, 0.0)
    pad.take(key(LEFT_SHOULDER, 1), 0.0)
    assert pad.direction(0.0) == (1.0, 0.0)


def test_a_gamepad_that_is_silent_for_long_holds_nothing():
    pad = Gamepad(RANGES)
    pad.take(key(LEFT_SHOULDER, 1) + axis(FORWARD_AXIS, -32768), 10.0)
    assert pad.direction(10.0 + STEADY_S) == (1.0, 0.0)
    assert pad.direction(10.1 + STEADY_S) == (0.0, 0.0)
    pad.take(axis(FORWARD_AXIS, -32768), 20.0)
    assert pad.direction(20.0) == (0.0, 0.0), "until the button is pressed again"


@given(st.integers(1, 40))
def test_events_in_pieces_are_the_same_events(n):
    data = key(LEFT_SHOULDER, 1) + axis(FORWARD_AXIS, 32767) + key(STOP_BUTTON, 1) + key(STOP_BUTTON, 0)
    pad = Gamepad(RANGES)
    for i in range(0, len(data), n):
        pad.take(data[i : i + n], 0.0)
    assert pad.direction(0.0) == (-1.0, 0.0)
    assert pad.take_stop()
    assert not pad.take_stop(), "STOP is one press"


@given(st.binary(max_size=200))
def test_no_bytes_raise(data):
    Gamepad(RANGES).take(data, 0.0)


def test_a_gamepad_that_comes_goes_and_comes_again_holds_nothing(tmp_path, monkeypatch):
    monkeypatch.setattr("zenav.client.gamepad_device.LOOK_EVERY_S", 0.0)
    path = tmp_path / "event7"
    with GamepadDevice(str(path)) as device:
        assert not device.open()
        assert "no gamepad" in device.detail
        for _ in range(2):
            os.mkfifo(path)
            assert device.open()
            assert device.gamepad.direction(0.0) == (0.0, 0.0)
            with open(path, "wb", buffering=0) as sender:
                sender.write(key(LEFT_SHOULDER, 1))
                until(device, lambda: device.gamepad.drives(time.monotonic()))
            path.unlink()
            until(device, lambda: device.descriptor is None)
            assert not device.gamepad.drives(time.monotonic())
            assert "gone" in device.detail
            assert not device.open()


def until(device: GamepadDevice, holds) -> None:
    for _ in range(round(LIMIT_S / 0.01)):
        device.read()
        if holds():
            return
        threading.Event().wait(0.01)
    raise AssertionError(device.detail)
