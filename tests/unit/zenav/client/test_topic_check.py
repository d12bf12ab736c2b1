# SPDX-License-Identifier: Apache-2.0
"""`zenav topic check` names each reason why a message does not pass, with a hint."""

from dataclasses import replace

import msgpack
import numpy as np
import pytest

from shared import sample_messages, topics
from shared.codec import Envelope, encode
from shared.config import UserError, load_robot
from shared.messages import BoardReport, Message
from zenav.client.sending import publisher_for, request_named
from zenav.client.topic_check import KeyCheck

ROBOT = load_robot("x80sv").robot
NOW = 1_700_000_000_000_000_000
STEP = 100_000_000  # ns
BOARD = BoardReport(NOW, 1, 2, 0.0, 0.0, np.ones(3, np.float32), np.ones(7, np.float32), 7.4, np.zeros(2, np.float32))
SCAN_PUBLISHERS = "lidar_driver or sim or ros2"
SCAN = sample_messages.scan(NOW, ROBOT.laser)


def check_of(topic: topics.Topic, messages: list[tuple[Message, Envelope]]) -> KeyCheck:
    check = KeyCheck(topic.key, topic, ROBOT)
    for i, (message, envelope) in enumerate(messages):
        check.take(encode(message, envelope), NOW + STEP * i)
    return check


def stream(message: Message, n: int = 5, publisher: str = "sim", session: str = "a") -> list[tuple[Message, Envelope]]:
    """n messages at 10 Hz."""
    return [
        (replace(message, stamp=message.stamp + STEP * i), Envelope(publisher, session, i, NOW + STEP * i))
        for i in range(n)
    ]


def test_good_messages_pass_with_their_rate():
    check = check_of(topics.SCAN, stream(SCAN))
    assert (check.n, check.n_passed, check.problems(), check.publisher) == (5, 5, [], "sim")
    assert check.rate() == pytest.approx(10)


@pytest.mark.parametrize(
    ("topic", "messages", "said"),
    [
        (topics.SCAN, stream(SCAN, publisher="lasr"), f"publisher 'lasr', where {SCAN_PUBLISHERS} publishes (5 of 5)"),
        (topics.SCAN, [*stream(SCAN, 2), *stream(SCAN, 4, session="b")[2:]], "session 'b' beside another one (2 of 4)"),
        (topics.SCAN, [(m, e._replace(sequence=3)) for m, e in stream(SCAN)], "the sequence stands still (4 of 5)"),
        (topics.SCAN, stream(replace(SCAN, stamp=NOW - 10 * STEP)), "0.9 s old (5 of 5)"),
        (topics.SCAN, stream(replace(SCAN, stamp=NOW // 10**9)), "are they ns?"),
        (topics.SCAN, stream(replace(SCAN, stamp=NOW + 10 * STEP)), "ahead (5 of 5)"),
        (topics.SCAN, stream(replace(SCAN, ranges=SCAN.ranges[:90])), "90 beams came, robot.laser.n_beams is 450"),
        (topics.BOARD, stream(replace(BOARD, ultrasonic=np.ones(2, np.float32))), "the board sends 2 ultrasonic"),
        (topics.BOARD, stream(replace(BOARD, left_counts=40000)), "robot.drive.encoder_wrap is 32768"),
        (topics.BOARD, stream(BOARD), "10.0 Hz, where 50 are expected"),
    ],
)
def test_each_problem_is_named_and_counted(topic, messages, said):
    (problem,) = [p for p in check_of(topic, messages).problems() if said in p.what]
    assert problem.hint


def test_bytes_that_are_no_message_are_named_with_the_field():
    check = KeyCheck("scan", topics.SCAN, ROBOT)
    tree = msgpack.unpackb(encode(*stream(SCAN, 1)[0]))
    for junk in (b"\xc1", msgpack.packb({**tree, "range_min": "a"}), bytes(5 * 2**20)):
        check.take(junk, NOW)
    check.take(msgpack.packb({**tree, "colour": 1}), NOW)
    assert check.n_passed == 1
    assert check.note == "unknown field colour ignored"
    content, size = check.problems()
    assert "range_min: str, not a number (2 of 4)" in content.what
    assert "5.0 MiB" in size.what


def test_another_publisher_is_taken_only_when_it_is_named():
    assert publisher_for("cmd/teleop", topics.TELEOP, "") == "operator"
    assert publisher_for("cmd/vel", topics.CMD_VEL, "guard") == "guard"
    assert publisher_for("log/mapper", topics.LOG, "mapper") == "mapper"
    for key, topic, wanted in (("cmd/vel", topics.CMD_VEL, ""), ("log/mapper", topics.LOG, "guard")):
        with pytest.raises(UserError, match="is published by"):
            publisher_for(key, topic, wanted)


def test_a_request_is_found_by_its_name_and_its_service():
    assert request_named("navigate")[1] == "navigator"
    assert request_named("request/set/planner")[1] == "planner"
    with pytest.raises(UserError, match="navigat is not a request"):
        request_named("navigat")


def test_the_rate_of_scans_is_that_of_the_robots_laser():
    robot = load_robot("turtlebot3_burger").robot
    assert KeyCheck("scan", topics.SCAN, robot).expected_hz == robot.laser.rate == 5
    assert KeyCheck("odom", topics.ODOM, robot).expected_hz == topics.ODOM.hz
    front, rear = (robot.laser.model_copy(update={"name": name, "rate": rate}) for name, rate in (("a", 5), ("b", 7)))
    both = robot.model_copy(update={"laser": front, "lasers": (front, rear)})
    assert KeyCheck("scan_2", topics.SCAN_2, both).expected_hz == 7
