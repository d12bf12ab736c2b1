# SPDX-License-Identifier: Apache-2.0
"""The link's shell: its queues are bounded, a session that breaks begins again, and recordings are held back."""

import threading
import time

import msgpack
import pytest

from services.uplink import site_device as shell
from services.uplink.config import UplinkConfig
from services.uplink.outgoing import Level
from services.uplink.service import PORT
from services.uplink.site_device import MAX_ASKS, MAX_INCOMING, SiteDevice
from shared import requests, topics
from shared.codec import Envelope, decode, encode
from shared.messages import GuardState, GuardStatus
from shared.ports import PortConfig
from shared.recording_requests import RecordingPart
from shared.requests import Cancel, Reply
from shared.runners.clock import clock_from
from shared.runners.devices import DeviceContext
from shared.runners.transport import StackAddress
from shared.secure_folder import MemberRole
from zenav.secure.members import add_member, init_folder

LIMIT_S = 20.0


class FakeStack:
    def __init__(self, robot, where, deliver):
        self.deliver, self.client, self.keys, self.replied = deliver, None, frozenset(), b""

    def connect(self):
        self.client = self

    def close(self):
        self.client = None

    def listen_to(self, keys):
        self.keys = keys

    def ask_raw(self, row, payload, limit):
        return self.replied


class FakeSite:
    """fails: how many of the first messages raise."""

    made, fails = [], 0

    def __init__(self, endpoint, credentials, robot, events):
        self.events, self.is_up, self.sent, self.is_closed = events, True, [], False
        FakeSite.made.append(self)

    def put(self, key, payload):
        if FakeSite.fails:
            FakeSite.fails -= 1
            raise RuntimeError("the session is broken")
        self.sent.append((key, payload))

    def close(self):
        self.is_closed = True


@pytest.fixture
def device(tmp_path, monkeypatch):
    init_folder("plant@x80sv", str(tmp_path / "secure"), [])
    add_member("red", MemberRole.ROBOT, str(tmp_path / "secure"), tmp_path / "red.pem", 2)
    monkeypatch.setattr(shell, "StackListener", FakeStack)
    monkeypatch.setattr(shell, "MIN_RETRY_S", 0.05)
    monkeypatch.setattr("services.uplink.site_session.SiteSession", FakeSite)
    FakeSite.made, FakeSite.fails = [], 0
    port = PortConfig(device="tls://127.0.0.1:1")
    section = UplinkConfig(port=port, credentials=str(tmp_path / "red.pem"), recording_rate=100)
    published = []
    context = DeviceContext(
        port=PORT, config=port, section=section, robot="red", where=StackAddress(), arguments=(),
        clock=clock_from(""), publish=published.append,
    )  # fmt: skip
    device = SiteDevice(context)
    device.published = published
    yield device
    device.close()


def until(holds):
    limit = time.monotonic() + LIMIT_S
    while not holds():
        assert time.monotonic() < limit
        threading.Event().wait(0.01)


def guard(n):
    return encode(GuardStatus(n, GuardState.IDLE, "", "", "", 1.0), Envelope("guard", "g", n, n))


def states(device):
    return [row.message.open for row in device.published if row.topic is topics.PORT]


def asks(device):
    events = [msgpack.unpackb(row.message.data) for row in device.published if row.topic is topics.RX]
    return [event["id"] for event in events if event["event"] == "ask"]


def test_a_session_that_breaks_begins_again_and_the_newest_message_goes(device):
    FakeSite.fails = 1
    device.start()
    until(lambda: FakeSite.made)
    device._stack.deliver("guard/status", guard(1), False)
    until(lambda: len(FakeSite.made) == 2)
    assert FakeSite.made[0].is_closed
    until(lambda: states(device) == [True, False, True])
    device._stack.deliver("guard/status", guard(2), False)
    until(lambda: FakeSite.made[1].sent)
    assert decode(GuardStatus, FakeSite.made[1].sent[-1][1])[0].stamp == 2


def test_while_nothing_is_sent_messages_of_the_stack_do_not_pile_up(device):
    for n in range(2 * MAX_INCOMING):
        device._stack.deliver("guard/status", guard(n), False)
    assert len(device._incoming) == MAX_INCOMING


def test_the_level_of_the_core_decides_what_is_listened_to(device):
    device.start()
    until(lambda: "pose" in device._stack.keys)
    assert "map" not in device._stack.keys
    device.write(msgpack.packb({"level": str(Level.WATCHED)}))
    until(lambda: {"map", "scan"} <= device._stack.keys)


def test_a_site_that_asks_too_much_is_refused_and_each_order_of_the_core_answers_one(device):
    device.start()
    until(lambda: FakeSite.made)
    replies = []
    payload = encode(Cancel(1), Envelope("operator", "s", 0, 1))
    for n in range(MAX_ASKS + 2):
        FakeSite.made[0].events.ask("request/cancel", payload, lambda data, n=n: replies.append((n, data)))
    assert [decode(Reply, data)[0].reason for _, data in replies] == ["busy", "busy"]
    assert len(asks(device)) == MAX_ASKS
    device._stack.replied = b"of the navigator"
    device.write(msgpack.packb({"ask": asks(device)[0], "key": "request/cancel"}))
    device.write(msgpack.packb({"reply": asks(device)[1], "data": b"of the core"}))
    until(lambda: len(replies) == 4)
    assert {data for _, data in replies[2:]} == {b"of the navigator", b"of the core"}
    device.write(msgpack.packb({"ask": asks(device)[0], "key": "request/cancel"}))  # it was answered
    assert len(device._replies) == MAX_ASKS - 2


def test_parts_of_recordings_take_their_share_of_the_link_and_no_more(device):
    device.start()
    until(lambda: FakeSite.made and device._stack.client)
    part = RecordingPart(1, accepted=True, reason="", detail="", size=10**6, data=bytes(60_000), sha256=b"")
    device._stack.replied = encode(part, Envelope("recorder", "r", 0, 1))
    arrived = []
    begun = time.monotonic()
    for _ in range(4):
        FakeSite.made[0].events.ask("request/fetch_recording", b"", lambda data: arrived.append(time.monotonic()))
    for id_ in asks(device):
        device.write(msgpack.packb({"ask": id_, "key": requests.FETCH_RECORDING.key}))
    until(lambda: len(arrived) == 4)
    assert arrived[-1] - begun >= (4 * 60_000 - 100_000) / 100_000, "a burst of 1 s, then 100 kB/s"
