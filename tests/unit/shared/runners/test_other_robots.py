# SPDX-License-Identifier: Apache-2.0
"""Messages of other robots count in their order, one process a robot, and never this robot's own."""

import pytest

from shared import topics
from shared.codec import CodecError, Envelope, encode
from shared.runners.other_robots import GONE_NS, MAX_ROBOTS, OtherRobotsAdmission, key_of_others
from shared.types import NS_PER_S
from tests.unit.services.traffic.intents import intent

NOW = 10**13
KEY = "blue/traffic/intent"


def payload(sequence, name="blue", session="s1", sent=NOW):
    return encode(intent(NOW, name), Envelope("traffic", session, sequence, sent))


def test_each_robot_is_heard_in_the_order_of_its_messages():
    admission = OtherRobotsAdmission(topics.HEARD, "red")
    assert key_of_others(topics.HEARD) == "*/traffic/intent"
    assert admission.admitted(KEY, payload(0), NOW) is not None
    assert admission.admitted(KEY, payload(0), NOW) is None, "repeated"
    assert admission.admitted(KEY, payload(7), NOW) is not None
    assert admission.admitted(KEY, payload(3), NOW) is None, "old"
    assert admission.admitted("green/traffic/intent", payload(0, "green"), NOW) is not None
    assert admission.admitted(KEY, payload(0, session="s2", sent=NOW + 1), NOW) is not None, "it was restarted"


def test_the_own_messages_and_those_under_a_wrong_name_do_not_count():
    admission = OtherRobotsAdmission(topics.HEARD, "red")
    assert admission.admitted("red/traffic/intent", payload(0, "red"), NOW) is None
    with pytest.raises(CodecError, match="another robot"):
        admission.admitted("green/traffic/intent", payload(0), NOW)
    with pytest.raises(CodecError):
        admission.admitted(KEY, b"nonsense", NOW)


def test_a_robot_that_was_silent_is_heard_again_also_where_its_clock_was_set_back():
    admission, behind = OtherRobotsAdmission(topics.HEARD, "red"), NOW - 1800 * NS_PER_S
    assert admission.admitted(KEY, payload(7), NOW) is not None
    assert admission.admitted(KEY, payload(0, session="s2", sent=behind), NOW + GONE_NS - 1) is None, "it is heard"
    assert admission.admitted(KEY, payload(6), NOW + GONE_NS) is None, "old, of the same process"
    for k in range(3):
        later = NOW + GONE_NS + k
        assert admission.admitted(KEY, payload(k, session="s2", sent=behind + k), later) is not None
    assert admission.admitted(KEY, payload(1, session="s2", sent=behind + 1), later) is None, "repeated"


def test_the_messages_of_too_many_robots_are_dropped_but_never_those_of_known_ones():
    admission = OtherRobotsAdmission(topics.HEARD, "red")
    for k in range(MAX_ROBOTS):
        assert admission.admitted(f"r{k}/traffic/intent", payload(0, f"r{k}"), NOW) is not None
    with pytest.raises(CodecError, match=str(MAX_ROBOTS)):
        admission.admitted(KEY, payload(0), NOW)
    later = NOW + GONE_NS
    assert admission.admitted("r5/traffic/intent", payload(0, "r5", session="s2", sent=NOW - 1), later) is not None
