# SPDX-License-Identifier: Apache-2.0
"""Values for late subscribers on their way to ROS: what is known is not sent again, and what is newer is."""

import threading
from contextlib import contextmanager
from dataclasses import replace

from services.ros2 import stack_feed
from services.ros2.config import Ros2Config
from services.ros2.ros_types import ros_types
from services.ros2.stack_feed import StackFeed
from shared import topics
from shared.codec import Envelope, encode
from shared.messages import BaseStatus
from shared.runners.transport import StackAddress

S = 10**9
NAME, KEY = "/battery_state", topics.BASE_STATUS.key


class FakeStack:
    """A fake of the client and of the reader of kept values. It keeps the callbacks of both."""

    def __init__(self, monkeypatch):
        self.hear, self.hear_kept, self.is_listened_to = {}, {}, threading.Event()
        self.session = self
        monkeypatch.setattr(stack_feed, "Client", lambda *_: self)
        monkeypatch.setattr(stack_feed, "LatchedReader", self._read)

    def __enter__(self):
        return self

    def __exit__(self, *_):
        pass

    def now(self):
        return 3000 * S

    def listen_raw(self, key, callback):
        self.hear[key] = callback
        return lambda: None

    def _read(self, _, full_key, callback):
        self.hear_kept[full_key] = callback
        self.is_listened_to.set()
        return self

    def close(self):
        pass


def status(battery, session, sequence, sent):
    message = replace(BaseStatus(sent, 0.0, 0.0, 0.0, True, "", ""), battery=battery)
    return encode(message, Envelope("base_driver", session, sequence, sent))


@contextmanager
def fed(stack):
    """A feed of /battery_state from a fake stack: voltages that went to ROS, waits for one and for a rejection."""
    config = Ros2Config()
    types, voltages, changed, is_rejected = ros_types(config.distro), [], threading.Condition(), threading.Event()

    def publish(name, data):
        with changed:
            voltages.append(round(types.decode(data, "sensor_msgs/msg/BatteryState").voltage, 1))
            changed.notify_all()

    def wait_for(voltage):
        with changed:
            assert changed.wait_for(lambda: voltages[-1:] == [voltage], 20.0), voltages

    def reject(name, text):
        assert name == NAME
        is_rejected.set()

    def wait_rejected():
        assert is_rejected.wait(20.0)

    feed = StackFeed(config, "red", StackAddress(), publish=publish, on_teleop=lambda: None, on_rejected=reject)
    feed.start()
    try:
        feed.want(NAME, True)
        assert stack.is_listened_to.wait(20.0)
        yield voltages, wait_for, wait_rejected
    finally:
        feed.close()


def test_a_kept_value_that_is_newer_goes_to_ros_and_one_that_is_known_does_not(monkeypatch):
    stack = FakeStack(monkeypatch)
    with fed(stack) as (voltages, wait_for, _):
        hear, hear_kept = stack.hear[KEY], stack.hear_kept[f"red/{KEY}"]
        hear(KEY, status(11.0, "a", 3, 1000 * S))
        wait_for(11.0)
        hear_kept(status(11.0, "a", 3, 1000 * S))
        hear_kept(status(12.0, "a", 2, 999 * S))
        hear_kept(status(13.0, "z", 9, 999 * S))
        hear_kept(status(14.0, "b", 0, 2000 * S))
        wait_for(14.0)
    assert voltages == [11.0, 14.0]


def test_a_stamp_that_ros_cannot_hold_costs_one_message(monkeypatch):
    stack = FakeStack(monkeypatch)
    with fed(stack) as (voltages, wait_for, wait_rejected):
        hear = stack.hear[KEY]
        hear(KEY, status(11.0, "a", 1, 1000 * S))
        wait_for(11.0)
        hear(KEY, status(12.0, "a", 2, 2**31 * S))
        wait_rejected()
        hear(KEY, status(13.0, "a", 3, 1001 * S))
        wait_for(13.0)
    assert voltages == [11.0, 13.0]
