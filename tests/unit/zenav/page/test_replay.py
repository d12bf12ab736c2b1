# SPDX-License-Identifier: Apache-2.0
"""A recording that a page replays: its messages and its map at each time, against brute force over all messages."""

from collections.abc import Callable, Iterator
from contextlib import ExitStack, closing
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from services.dashboard.frames import MARK
from shared import topics
from shared.codec import Envelope, decode, encode
from shared.geometry import Pose2
from shared.messages import EmergencyStop, GuardState, GuardStatus, LogLine, MapUpdate, Message, PoseEstimate
from shared.recording import Writer
from shared.topics import topic_of
from zenav.page.replay import RECENT_NS, REPLAYED_KEYS, REPLAYS, OpenReplay
from zenav.page.replay_map import MAX_TILES
from zenav.page.target import PageTarget
from zenav.page.tools import run

START = 1_000_000_000
STEP = 100_000_000  # ns
TARGET = PageTarget("x80sv", "0")
DRIVING = Path(__file__).parents[3] / "replay" / "recordings"


def map_update(time: int, map_id: int, places: list[tuple[int, int]], value: int) -> MapUpdate:
    rows, columns = (np.array([place[i] for place in places], np.int32) for i in (0, 1))
    return MapUpdate(time, map_id, 0, 0.05, rows, columns, np.full((len(places), 4096), value, np.int8))


def status(time: int, state: GuardState, reason: str) -> GuardStatus:
    return GuardStatus(time, state, "", reason, "", 1.0)


def write(path: Path, rows: list[tuple[str, Message]], flush_every: int = 0, close: bool = True) -> Path:
    writer = Writer(path)
    for i, (key, message) in enumerate(rows):
        payload = encode(message, Envelope("test", "s", i, message.stamp))
        writer.write(key, type(message), payload, message.stamp, message.stamp, i)
        if flush_every and i % flush_every == flush_every - 1:
            writer.flush()
    writer.flush()
    unclosed = path.read_bytes()
    writer.close()
    if not close:
        path.write_bytes(unclosed)
    return path


@pytest.fixture
def opened() -> Iterator[Callable[[Path], OpenReplay]]:
    """Opens recordings that are closed after the test."""
    with ExitStack() as stack:
        yield lambda path: stack.enter_context(closing(OpenReplay(path)))


@pytest.fixture(autouse=True, scope="module")
def closed() -> Iterator[None]:
    """What the operations keep open is closed."""
    yield
    REPLAYS.close()


places = st.lists(st.tuples(st.integers(-2, 2), st.integers(-2, 2)), min_size=1, max_size=3, unique=True)
events = st.one_of(
    st.tuples(st.just("map"), st.integers(1, 2), places, st.integers(-1, 100)),
    st.tuples(st.just("estop"), st.booleans()),
    st.tuples(st.just("guard/status"), st.sampled_from(list(GuardState))),
)


def message_of(event: tuple, time: int) -> Message:
    if event[0] == "map":
        return map_update(time, *event[1:])
    if event[0] == "estop":
        return EmergencyStop(time, event[1], "test")
    return status(time, event[1], "estop")


def map_by_brute_force(rows: list[tuple[str, Message]], time: int) -> dict[tuple[int, int], bytes]:
    tiles: dict[tuple[int, int], bytes] = {}
    map_id = 0
    for _, update in rows:
        if isinstance(update, MapUpdate) and update.stamp <= time:
            tiles = tiles if update.map_id == map_id else {}
            map_id = update.map_id
            tiles |= {(int(r), int(c)): x.tobytes() for r, c, x in zip(update.rows, update.columns, update.cells)}
    return tiles


def shown_tiles(tiles: dict, before: dict[tuple[int, int], bytes]) -> dict[tuple[int, int], bytes]:
    """What a page shows that had the tiles `before`."""
    held = {} if tiles["reset"] else dict(before)
    cells = [tiles["cells"][i : i + 4096] for i in range(0, len(tiles["cells"]), 4096)]
    return held | dict(zip(zip(tiles["rows"], tiles["columns"], strict=True), cells, strict=True))


@settings(deadline=None)
@given(st.lists(st.tuples(st.integers(0, 3), events), min_size=1, max_size=25), st.integers(0, 4), st.booleans())
def test_the_state_at_any_time_is_that_of_all_messages_until_then(tmp_path_factory, steps, flush_every, close):
    time, rows = START, []
    for gap, event in steps:
        time += gap * STEP
        rows.append((event[0], message_of(event, time)))
    path = write(tmp_path_factory.mktemp("replay") / "a.mcap", rows, flush_every, close)
    zero = rows[0][1].stamp
    with closing(OpenReplay(path)) as replay:
        assert replay.summary()["length"] == pytest.approx((time - zero) / 1e9)
        played: dict[tuple[int, int], bytes] = {}
        since = None
        for at in range(zero - STEP // 2, time + STEP, STEP // 2):
            t = (at - zero) / 1e9
            sought = replay.state(t, None, 0)
            newest = {key: message.stamp for key, message in rows if message.stamp <= at and key != "map"}
            stamps = {key: decode(topic_of(key).type, payload)[1].sequence for key, payload in sought["messages"]}
            expected = {key: max(i for i, (k, m) in enumerate(rows) if k == key and m.stamp <= at) for key in newest}
            assert stamps == expected
            truth = map_by_brute_force(rows, at)
            assert shown_tiles(sought["tiles"], {}) == truth
            played = shown_tiles(replay.state(t, since, 0)["tiles"], played)
            assert played == truth, "increments equal a seek"
            since = t


def test_only_the_changed_tiles_come_while_it_plays_and_all_where_the_page_is_ahead_or_has_another_map(
    tmp_path, opened
):
    updates = [
        map_update(START, 1, [(0, 0), (0, 1)], 10),
        map_update(START + STEP, 1, [(0, 1)], 20),
        map_update(START + 2 * STEP, 2, [(5, 5)], 30),
    ]
    replay = opened(write(tmp_path / "a.mcap", [("map", update) for update in updates]))

    def tiles(t: float, since: float | None) -> tuple[bool, list[int]]:
        fields = replay.state(t, since, 0)["tiles"]
        return fields["reset"], fields["columns"]

    assert tiles(0.1, 0.0) == (False, [1])
    assert tiles(0.15, 0.1) == (False, [])
    assert tiles(0.0, 0.1) == (True, [0, 1])
    assert tiles(0.2, 0.1) == (True, [5])
    assert tiles(0.1, 0.2) == (True, [0, 1])


def test_a_large_map_comes_in_parts(tmp_path, opened):
    cells = [(row, column) for row in range(20) for column in range(20)]
    replay = opened(write(tmp_path / "a.mcap", [("map", map_update(START, 1, cells, 7))]))
    first = replay.state(0.0, None, 0)["tiles"]
    second = replay.state(0.0, None, MAX_TILES)["tiles"]
    assert (len(first["rows"]), first["left"], first["reset"]) == (MAX_TILES, 400 - MAX_TILES, True)
    assert (len(second["rows"]), second["left"], second["reset"]) == (400 - MAX_TILES, 0, False)
    assert set(shown_tiles(second, shown_tiles(first, {}))) == set(cells)


def test_faults_marks_and_the_trail_stand_beside_the_time(tmp_path, opened):
    pose = [
        PoseEstimate(START + i * STEP, Pose2(0.06 * i, 0.0, 0.0), Pose2(), np.zeros((3, 3)), 1.0, "ok")
        for i in range(5)
    ]
    rows: list[tuple[str, Message]] = [("pose", message) for message in pose]
    rows += [
        ("guard/status", status(START + 5 * STEP, GuardState.STOPPED, "estop")),
        ("guard/status", status(START + 6 * STEP, GuardState.STOPPED, "estop")),
        ("guard/status", status(START + 7 * STEP, GuardState.IDLE, "no_command")),
        ("guard/status", status(START + 8 * STEP, GuardState.STOPPED, "obstacle")),
        ("log/dashboard", LogLine(START + 9 * STEP, "INFO", f"{MARK}page 1: a person")),
        ("log/dashboard", LogLine(START + 9 * STEP, "INFO", "something else")),
    ]
    summary = opened(write(tmp_path / "a.mcap", rows)).summary()
    assert [(row["t"], row["kind"], row["reason"], row["text"]) for row in summary["marks"]] == [
        (0.5, "fault", "estop", ""),
        (0.8, "fault", "obstacle", ""),
        (0.9, "mark", "", "page 1: a person"),
    ]
    assert summary["trail"] == pytest.approx([0.0, 0.0, 0.0, 0.2, 0.12, 0.0, 0.4, 0.24, 0.0])


def recorded(name: str, size: int | None = None, damage: range = range(0)) -> Path:
    """A copy of a kept recording below recordings/, cut or damaged."""
    data = bytearray((DRIVING / "driving.mcap").read_bytes()[:size])
    for i in damage:
        data[i] ^= 0xFF
    path = Path("recordings") / name
    path.parent.mkdir(exist_ok=True)
    path.write_bytes(data)
    return path


def _shows_robot_and_map(t: float) -> bool:
    state = run(TARGET, "replay_at", {"name": "a.mcap", "t": t})["data"]
    return {"pose", "guard/status"} <= {key for key, _ in state["messages"]} and bool(state["tiles"]["rows"])


def test_a_kept_recording_replays_with_the_odometry_just_before(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    recorded("a.mcap")
    summary = run(TARGET, "replay_open", {"name": "a.mcap"})["data"]
    assert summary["robot"]["name"] == "x80"
    assert summary["problems"] == []
    assert _shows_robot_and_map(summary["start"])
    assert not _shows_robot_and_map(summary["start"] - 0.001)
    state = run(TARGET, "replay_at", {"name": "a.mcap", "t": 3.0})["data"]
    keys = [key for key, _ in state["messages"]]
    assert {"pose", "scan", "plan", "goal", "guard/status", "nav/status"} <= set(keys) <= REPLAYED_KEYS
    odometry = [decode(topics.ODOM.type, payload)[1].sent for key, payload in state["messages"] if key == "odom"]
    assert len(odometry) == RECENT_NS // 20_000_000
    assert odometry == sorted(odometry)
    assert odometry[-1] == pytest.approx(state["stamp"], abs=20_000_000)


def test_a_cut_and_a_damaged_recording_replay_as_far_as_they_go(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    recorded("whole.mcap"), recorded("cut.mcap", 200_000), recorded("damaged.mcap", None, range(250_000, 250_400))
    replies = {
        name: run(TARGET, "replay_open", {"name": f"{name}.mcap"})["data"] for name in ("whole", "cut", "damaged")
    }
    assert replies["cut"]["length"] < replies["whole"]["length"]
    assert replies["cut"]["problems"]
    assert replies["damaged"]["problems"]
    whole, cut, damaged = (
        run(TARGET, "replay_at", {"name": f"{name}.mcap", "t": 1.0})["data"] for name in ("whole", "cut", "damaged")
    )
    assert cut == whole
    assert {key for key, _ in damaged["messages"]} == {key for key, _ in whole["messages"]}


def test_what_is_no_recording_is_refused_with_a_hint(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    recorded("empty.mcap", 0), recorded("other.mcap").write_bytes(b"something else")
    write(Path("recordings/nothing.mcap"), [])
    for name, words in (
        ("missing.mcap", "no recording"),
        ("../secret.mcap", "no recording"),
        ("empty.mcap", "empty"),
        ("other.mcap", "no MCAP"),
        ("nothing.mcap", "no message"),
    ):
        for op, values in (("replay_open", {}), ("replay_at", {"t": 1.0})):
            reply = run(TARGET, op, {"name": name, **values})
            assert not reply["accepted"]
            assert words in reply["detail"], reply
            assert reply["hint"]


def test_a_recording_that_grows_is_longer_when_it_is_opened_again(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    Path("recordings").mkdir()
    rows = [("estop", EmergencyStop(START + i * STEP, False, "test")) for i in range(20)]
    path = write(Path("recordings/a.mcap"), rows[:10], close=False)
    assert run(TARGET, "replay_open", {"name": "a.mcap"})["data"]["length"] == pytest.approx(0.9)
    write(path, rows, close=False)
    assert run(TARGET, "replay_open", {"name": "a.mcap"})["data"]["length"] == pytest.approx(1.9)
