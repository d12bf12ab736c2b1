# SPDX-License-Identifier: Apache-2.0
"""Two runs field by field: laws of what counts as different, and what people read."""

from dataclasses import replace
from math import inf, pi

import msgpack
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from shared import topics
from shared.codec import Envelope, encode, fields_of
from shared.config import UserError
from shared.geometry import Pose2
from shared.messages import EmergencyStop, LaserScan, Odometry
from shared.topics import TOPICS, key_of
from tests.strategies import messages
from zenav.replay.comparison import FieldDifference, TopicReport, comparison_lines, differences, tolerances_from

ENVELOPE = Envelope("x", "s", 7, 10**18)
ODOM = Odometry(5, Pose2(1.0, 2.0, 3.0), 0.5, 0.1, np.eye(3).ravel())
some = st.sampled_from(TOPICS).flatmap(lambda t: st.tuples(st.just(key_of(t, "guard")), messages(t.type)))


def off(before: object, now: object, key: str = "odom") -> list[FieldDifference]:
    return differences(key, encode(before, ENVELOPE), encode(now, ENVELOPE))  # type: ignore[arg-type]


def taken(before: object, now: object, *tolerances: str) -> TopicReport:
    report = TopicReport("odom")
    report.add(encode(before, ENVELOPE), encode(now, ENVELOPE), tolerances_from(tolerances))  # type: ignore[arg-type]
    return report


@given(some)
def test_a_message_equals_itself_also_with_nan(drawn):
    key, message = drawn
    report = TopicReport(key)
    payload = encode(message, ENVELOPE)
    report.add(payload, payload, {})
    assert (report.n_equal, report.equal) == (1, True)


@given(some, st.data())
def test_whichever_two_differ_a_field_is_named(drawn, data):
    key, message = drawn
    topic = topics.topic_of(key)
    other = data.draw(messages(topic.type))
    before, now = encode(message, ENVELOPE), encode(other, ENVELOPE)
    report = TopicReport(key)
    report.add(before, now, {})
    assert report.equal == (before == now)
    if before != now:
        names = {row.name for row in fields_of(topic.type)} | {"sent", "bytes"}
        assert report.fields
        assert {name.partition(".")[0] for name in report.fields} <= names
        assert report.first.startswith("#7: ")


def test_each_part_of_a_pose_is_told_and_a_heading_goes_the_short_way_round():
    turned = replace(ODOM, odom_from_base=Pose2(1.5, 2.0, 3.0 + 2 * pi - 0.25))
    found = {o.field: o.by for o in off(ODOM, turned)}
    assert found == {"odom_from_base.x": pytest.approx(0.5), "odom_from_base.yaw": pytest.approx(0.25)}


def test_of_an_array_the_farthest_counts_and_another_length_is_no_number():
    scan = LaserScan(5, 0.0, 0.1, 0.1, 0.05, 12.0, np.array([1, 2, np.nan], np.float32))
    (one,) = off(scan, replace(scan, ranges=np.array([1, 2.5, np.nan], np.float32)), "scan")
    assert (one.field, one.by) == ("ranges", 0.5)
    assert "1 of 3 differ" in one.text
    for ranges in ([1, 2], [1, 2, 3], [1, np.nan, np.nan]):
        (one,) = off(scan, replace(scan, ranges=np.array(ranges, np.float32)), "scan")
        assert one.by == inf


def test_words_and_flags_are_never_nearly_equal():
    report = TopicReport("estop")
    stop = EmergencyStop(5, True, "me")
    report.add(encode(stop, ENVELOPE), encode(replace(stop, pressed=False), ENVELOPE), {"estop": 1e9})
    assert report.n_different == 1


@given(st.floats(1e-6, 10), st.floats(0.1, 10))
def test_what_is_within_its_tolerance_is_counted_apart(tolerance, share):
    moved = replace(ODOM, odom_from_base=Pose2(1.0 + tolerance * share, 2.0, 3.0))
    report = taken(ODOM, moved, f"odom.odom_from_base={tolerance}")
    near = moved.odom_from_base.x - 1.0 <= tolerance
    assert (report.n_within, report.n_different) == ((1, 0) if near else (0, 1))


def test_the_most_exact_name_of_a_field_decides():
    moved = replace(ODOM, odom_from_base=Pose2(1.1, 2.0, 3.0))
    assert taken(ODOM, moved, "odom=1").equal
    assert not taken(ODOM, moved, "odom=1", "odom.odom_from_base=0.01").equal
    assert taken(ODOM, moved, "odom=0.001", "odom.odom_from_base=0.01", "odom.odom_from_base.x=0.2").equal


def test_without_a_tolerance_no_other_byte_is_equal():
    assert not taken(replace(ODOM, v=0.0), replace(ODOM, v=-0.0)).equal
    assert taken(replace(ODOM, v=0.0), replace(ODOM, v=-0.0), "odom.v=0").equal


def test_the_first_and_the_largest_difference_are_told_with_their_place():
    report = TopicReport("odom")
    for i, by in enumerate((0.0, 0.1, 0.7, 0.2)):
        at = Envelope("odometry", "s", i, 10**18 + i * 10**8)
        now = replace(ODOM, odom_from_base=Pose2(1.0 + by, 2.0, 3.0))
        report.add(encode(ODOM, at), encode(now, at), {})
    assert (report.n_equal, report.n_different) == (1, 3)
    lines = comparison_lines([report], 10**18)
    assert lines[0] == "odom.odom_from_base.x: 3 off"
    assert lines[1].startswith("    first   +0.100 s #1: is 1.1, was 1.0, off by 0.1")
    assert lines[2].startswith("    largest +0.200 s #2: is 1.7, was 1.0, off by 0.7")


def test_bytes_that_this_version_does_not_know_are_different_and_said_to_be():
    good = encode(ODOM, ENVELOPE)
    tree = msgpack.unpackb(good)
    tree.pop("v")
    (one,) = differences("odom", msgpack.packb(tree), good)
    assert "not valid in this version" in one.text
    assert differences("nonsense", b"a", b"b")[0].by == inf


@pytest.mark.parametrize(
    ("words", "told", "hint"),
    [
        ("pose", "no tolerance", "TOPIC.FIELD=VALUE"),
        ("pose=x", "no tolerance", "TOPIC.FIELD=VALUE"),
        ("pose=-1", "no tolerance", "TOPIC.FIELD=VALUE"),
        ("pose=nan", "no tolerance", "TOPIC.FIELD=VALUE"),
        ("poze=1", "poze is not a topic", "`pose`"),
        ("health=1", "health is not a topic", "health/"),
        ("pose.qualty=1", "no field qualty", "`quality`"),
        ("pose.quality.x=1", "no field", "pose.quality"),
        ("pose.map_from_base.z=1", "no field", "pose.map_from_base"),
    ],
)
def test_a_tolerance_for_nothing_is_refused(words, told, hint):
    with pytest.raises(UserError, match=told) as error:
        tolerances_from([words])
    assert hint in error.value.hint
