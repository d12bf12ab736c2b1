# SPDX-License-Identifier: Apache-2.0
"""What is played, when, and with which bytes: laws of the playhead, and of the two times that `--now` moves."""

import itertools
from math import inf
from pathlib import Path

import msgpack
import pytest
from hypothesis import given
from hypothesis import strategies as st

from shared import topics
from shared.codec import CodecError, Envelope, decode, encode
from shared.config import UserError
from shared.messages import Goal, Odometry
from shared.recording import Channel, Entry, Recording, Writer, sink
from shared.recordings.latched_state import LatchedState
from shared.runners.admission import Admission, Verdict
from shared.runners.lockstep import Lockstep
from shared.topics import TOPICS
from tests.strategies import messages
from tests.toys import build, eventful
from zenav.replay.player import refusal_text
from zenav.replay.player_clock import (
    COMMANDS,
    MAX_SILENCE_NS,
    PlaybackOptions,
    Playhead,
    contents,
    renamed_keys,
    restamped,
    selected_keys,
    silences,
    timed_entries,
)

KEYS = ("scan", "odom", "health/mapper", "health/guard")
ns = st.integers(0, 10**13)


@pytest.fixture(scope="module")
def file(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("run") / "a.mcap"
    with Writer(path, {"robot": "x80"}) as writer:
        eventful(sink(writer))
    return path


# --- the playhead ---------------------------------------------------------------------------------------------------


@given(ns, st.floats(0.01, 100), ns)
def test_a_place_is_reached_when_it_is_due(now, rate, place):
    head = Playhead(now, rate)
    assert head.wait(place, now) * rate * 1e9 == pytest.approx(place, abs=2)
    assert head.place(head.due(place)) == pytest.approx(place, abs=2 + rate)
    assert head.wait(place, head.due(place)) == pytest.approx(0, abs=1e-6)


@given(ns, st.lists(st.tuples(st.integers(0, 10**10), st.sampled_from(["pause", "go", "rate"]), st.floats(0.01, 100))))
def test_whatever_is_pressed_playing_never_jumps(now, presses):
    head, last = Playhead(now), 0
    for after, what, rate in presses:
        now += after
        before = head.place(now)
        assert before >= last
        head.set_rate(now, rate if what == "rate" else None, {"pause": True, "go": False}.get(what))
        assert head.place(now) == before
        last = before


def test_while_it_is_paused_nothing_is_due_but_a_step():
    head = Playhead(0, 2.0)
    head.set_rate(10**9, paused=True)
    assert head.wait(2 * 10**9 + 1, 5 * 10**9) == inf
    assert head.place(5 * 10**9) == 2 * 10**9
    head.step_to(3 * 10**9, 6 * 10**9)
    assert head.place(9 * 10**9) == 3 * 10**9
    head.set_rate(9 * 10**9, paused=False)
    assert head.due(5 * 10**9) == 10 * 10**9


def jumps_of(times: list[int]) -> list[tuple[int, int]]:
    latest = list(itertools.accumulate(times, max))
    return [(a, b) for a, b in itertools.pairwise(latest) if b - a > MAX_SILENCE_NS]


@given(st.lists(st.integers(0, 10**12), min_size=1))
def test_places_follow_the_times_of_logging_and_never_go_back(times):
    channel = Channel("odom", "msgpack", "", "", b"")
    notes: list[str] = []
    entries = [Entry(channel, t, 0, 0, b"") for t in times]
    jumps = jumps_of(times)
    places = [place for place, _ in timed_entries(entries, times[0], jumps, notes)]
    assert places == sorted(places)
    some = [place for place, _ in timed_entries(entries[::3], times[0], jumps, [])]
    assert some == sorted(some)
    assert all(b - a <= MAX_SILENCE_NS for a, b in itertools.pairwise(places))
    if not notes and times == sorted(times):
        assert places == [t - times[0] for t in times]


def test_a_topic_with_pauses_keeps_its_times_and_a_jump_of_the_clock_is_passed_over(tmp_path):
    path, begin = tmp_path / "a.mcap", 10**18
    seconds = [*range(200), *range(5000, 5200)]  # the clock jumped
    with Writer(path) as writer:
        for s in seconds:
            writer.write("odom", Odometry, b"x", begin + s * 10**9, 0, s)
            if s in (10, 150, 5100):
                writer.write("goal", Goal, b"x", begin + s * 10**9, 0, s)
    recording, notes = Recording(path), list[str]()
    jumps = silences(recording, begin)
    assert jumps == [(begin + 199 * 10**9, begin + 5000 * 10**9)]
    entries = recording.entries(["goal"], as_recorded=True)
    assert [place / 1e9 for place, _ in timed_entries(entries, begin, jumps, notes)] == [10.0, 150.0, 300.0]
    assert notes == ["4801 s of silence at 199.0 s are passed over"]


# --- what is played -------------------------------------------------------------------------------------------------


def test_a_word_means_a_key_or_a_family():
    assert selected_keys("", KEYS) == sorted(KEYS)
    assert selected_keys("odom,health", KEYS) == ["odom", "health/guard", "health/mapper"]
    with pytest.raises(UserError, match="no topic odm") as error:
        selected_keys("odm", KEYS)
    assert "odom" in error.value.hint


@pytest.mark.parametrize(
    ("words", "told"),
    [("scan", "renames nothing"), ("scan=", "renames nothing"), ("scan=/a", "renames nothing"),
     ("scan=a/*", "renames nothing"), ("scn=a", "not played"), ("scan=odom", "LaserScan, odom Odometry")],
)  # fmt: skip
def test_a_name_that_cannot_be_is_refused(words, told):
    with pytest.raises(UserError, match=told):
        renamed_keys([words], KEYS)


def test_a_key_is_played_under_another():
    assert renamed_keys(["scan=scan/rear", "odom=old/odom"], KEYS) == {"scan": "scan/rear", "odom": "old/odom"}


def test_contents_are_the_same_with_and_without_an_index(file, tmp_path):
    whole = contents(Recording(file))
    assert whole.keys == tuple(sorted({e.key for e in Recording(file).entries()}))
    assert whole.seconds == pytest.approx(3.3, abs=0.1)
    cut = tmp_path / "cut.mcap"
    cut.write_bytes(file.read_bytes()[:-100])
    assert contents(Recording(cut)) == whole
    Writer(tmp_path / "none.mcap").close()
    with pytest.raises(UserError, match="holds no messages"):
        contents(Recording(tmp_path / "none.mcap"))


@pytest.fixture(scope="module")
def small(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("small") / "a.mcap"
    with Writer(path, {"robot": "x80"}) as writer:
        lockstep = Lockstep({"base_driver": build("base_driver")}, sink(writer))
        lockstep.run(0.1)
    return path


@given(st.data())
def test_whatever_is_cut_or_flipped_is_read_or_told(small, data):
    whole = bytearray(small.read_bytes())
    at = data.draw(st.integers(0, len(whole) - 1))
    if data.draw(st.booleans()):
        del whole[at:]
    else:
        whole[at] ^= data.draw(st.integers(1, 255))
    path = small.with_name("damaged.mcap")
    path.write_bytes(whole)
    try:
        there = contents(Recording(path))
    except UserError:
        return
    assert there.keys


OBEYED = {"cmd/nav", "cmd/teleop", "cmd/vel", "goal", "recovery", "estop", "hardware/motors", "hardware/velocity"}


def test_the_keys_that_a_robot_obeys_are_topics():
    assert {topic.key for topic in TOPICS} >= OBEYED


@pytest.mark.parametrize("topic", TOPICS, ids=lambda topic: topic.key)
def test_what_a_robot_obeys_is_played_only_when_that_is_asked_for(topic):
    obeyed = topic.key in OBEYED
    assert (topic.key in COMMANDS) == obeyed
    if obeyed:
        assert refusal_text(topic.key, PlaybackOptions(), set()) is not None
        assert refusal_text(topic.key, PlaybackOptions(commands=True), set()) is None


def test_what_a_running_service_says_itself_is_not_played():
    assert refusal_text("pose", PlaybackOptions(), {"mapper"}) is not None
    assert refusal_text("health/mapper", PlaybackOptions(), {"mapper"}) is not None
    assert refusal_text("health/guard", PlaybackOptions(), {"mapper"}) is None
    assert refusal_text("scan", PlaybackOptions(), {"mapper"}) is None
    assert refusal_text("plan", PlaybackOptions(), set()) is None
    assert refusal_text("plan", PlaybackOptions(), {"local_ctrl"}) is not None
    assert refusal_text("journal/guard", PlaybackOptions(), set()) is None
    assert refusal_text("journal/guard", PlaybackOptions(now=True), set()) is not None


# --- with which bytes -----------------------------------------------------------------------------------------------


@given(st.sampled_from(TOPICS).flatmap(lambda t: st.tuples(st.just(t), messages(t.type))), st.integers(-(10**6), 10**9))
def test_only_stamp_session_and_time_of_sending_change(drawn, later):
    topic, message = drawn
    before = encode(message, Envelope("x", "s", 4, 10**15))
    tree = msgpack.unpackb(before)
    if tree["stamp"] + later < 0 or tree["stamp"] + later >= 2**62:
        return
    after = restamped(before, later, "+1")
    _, envelope = decode(topic.type, after)
    assert envelope == ("x", "s+1", 4, 10**15 + later)
    changed = msgpack.unpackb(after)
    assert changed.pop("stamp") == tree.pop("stamp") + later
    assert changed.pop("@") != tree.pop("@")
    assert msgpack.packb(changed) == msgpack.packb(tree)  # NaN differs from itself, its bytes do not


@given(st.binary(max_size=60))
def test_what_is_no_message_is_refused_in_words(junk):
    with pytest.raises(CodecError):
        restamped(junk, 1, "")


def test_a_second_pass_is_taken_like_the_first(file):
    admission, now = Admission(topics.WHEELS), 0
    first = None
    for n in range(2):
        for entry in Recording(file).entries(["base/wheels"]):
            first = first or entry.log_time
            later = 10**18 + n * 5 * 10**9 - first
            now = entry.log_time + later
            _, envelope = decode(topics.WHEELS.type, restamped(entry.payload, later, f"+{n}"))
            assert admission.judge(envelope, now) is Verdict.TAKE


def test_the_latched_map_is_all_that_was_sent(file):
    latched, whole = LatchedState(), None
    for entry in Recording(file).entries(["map", "odom"]):
        assert latched.take(entry.key, entry.payload) == (entry.key == "map")
        if entry.key == "map":
            update, last = decode(topics.MAP.type, entry.payload)
            whole = update if whole is None else whole.merged(update)
    kept, envelope = decode(topics.MAP.type, latched.value("map")())
    assert envelope == last
    assert (kept.version, kept.rows.tolist()) == (whole.version, whole.rows.tolist())
    assert kept.cells.tolist() == whole.cells.tolist()
