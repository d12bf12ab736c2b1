# SPDX-License-Identifier: Apache-2.0
"""Ports wired to each other in lockstep: a driver and an emulator that speak bytes, and the replay of the driver."""

from pathlib import Path

import pytest

from shared import topics
from shared.config import Section, load_robot
from shared.messages import PortState, SerialData
from shared.ports import PortConfig
from shared.recording import Channel, Entry
from shared.runners.host import Sent
from shared.runners.journal import Life, events_of
from shared.runners.lockstep import Lockstep
from shared.runners.replay import replay
from shared.service import Log, Out, Service, every, on

ROBOT = load_robot("x80sv").robot


class EchoingDriver(Service):
    """Counts aloud over its port, and says what it hears."""

    def __init__(self) -> None:
        super().__init__(Section(), ROBOT)
        self.n = 0

    @property
    def ports(self) -> dict[str, PortConfig]:
        return {"board": PortConfig(device="wired")}

    @every(hz=10)
    def count(self) -> Out:
        self.n += 1
        yield topics.TX(SerialData(self.now, "board", bytes([self.n])))

    @on(topics.RX)
    def heard(self, data: SerialData) -> Out:
        yield Log("INFO", f"heard {data.data.hex()}")

    @on(topics.PORT)
    def port(self, state: PortState) -> Out:
        yield Log("INFO", f"{state.port} {'open' if state.open else state.detail}")

    def on_shutdown(self) -> Out:
        yield topics.TX(SerialData(self.now, "board", b"bye"))


class Echo(Service):
    """Answers each byte with its double; pulls its own plug at the fifth."""

    def __init__(self) -> None:
        super().__init__(Section(), ROBOT)
        self.taken: list[bytes] = []

    @on(topics.RX)
    def heard(self, data: SerialData) -> Out:
        self.taken.append(data.data)
        yield topics.TX(SerialData(self.now, "board", bytes([2 * data.data[0]])))
        if len(self.taken) == 5:
            yield topics.PLUG(PortState(self.now, "board", False, ""))

    @every(hz=1)
    def plug(self) -> Out:
        yield topics.PLUG(PortState(self.now, "board", True, ""))


def driven() -> tuple[Lockstep, list[Sent]]:
    recorded: list[Sent] = []
    wires = ((("base_driver", "board"), ("sim", "board")),)
    lockstep = Lockstep({"base_driver": EchoingDriver(), "sim": Echo()}, recorded.append, wires)
    lockstep.run(1.25)
    return lockstep, recorded


def lines(recorded: list[Sent]) -> list[str]:
    return [sent.message.text for sent in recorded if sent.key == "log/base_driver"]


def test_bytes_cross_a_wire_and_nothing_crosses_an_unplugged_one():
    lockstep, recorded = driven()
    taken = lockstep.service("sim").taken
    assert taken == [bytes([n]) for n in (1, 2, 3, 4, 5, 11, 12, 13)]  # away from 0.4 to 1.0 s
    said = lines(recorded)
    assert said[0] == "board open"
    assert "board unplugged" in said
    assert said.index("heard 08") < said.index("board unplugged") < len(said) - 1
    assert said.count("board open") >= 2


def test_the_same_run_gives_the_same_bytes():
    assert [sent.payload for sent in driven()[1]] == [sent.payload for sent in driven()[1]]


class KeptBytes:
    """A recording in memory."""

    path = Path("kept.mcap")

    def __init__(self, recorded: list[Sent], name: str = "base_driver") -> None:
        journals = [s.message for s in recorded if s.key == f"journal/{name}"]
        self._lives = {name: [Life(name, journals[0].session, events_of(journals))]}
        self._entries = [
            Entry(Channel(s.key, "", "", "", b""), s.envelope.sent, s.envelope.sent, s.envelope.sequence, s.payload)
            for s in recorded
        ]

    def lives(self):
        return self._lives

    def entries(self, keys=None):
        return (entry for entry in self._entries if keys is None or entry.key in keys)


def test_a_driver_replays_to_the_byte_from_the_bytes_of_its_port():
    lockstep, recorded = driven()
    lockstep.flush()
    replayed = replay(KeptBytes(recorded), ["base_driver"], lambda name: EchoingDriver())
    assert not replayed.gaps
    spoken = {"log/base_driver", "port/tx/base_driver"}
    assert [s.payload for s in replayed.sent["base_driver"]] == [s.payload for s in recorded if s.key in spoken]


@pytest.mark.parametrize("name", ["base_driver", "sim"])
def test_a_restarted_end_finds_its_port_open(name):
    lockstep, recorded = driven()
    lockstep.kill(name)
    before = len(recorded)
    lockstep.start(name, EchoingDriver() if name == "base_driver" else Echo())
    lockstep.run(0.5)
    assert any(s.key == f"port/state/{name}" and s.message.open for s in recorded[before:])
