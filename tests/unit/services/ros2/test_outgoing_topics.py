# SPDX-License-Identifier: Apache-2.0
"""Messages of the stack as ROS 2 sees them: every row converts, encodes, and comes back the same."""

from dataclasses import replace

import numpy as np
import pytest

from services.ros2.config import Ros2Config
from services.ros2.outgoing_markers import MARKERS, Place, place_markers
from services.ros2.outgoing_topics import OUTGOING, OutgoingState, converted, keys_of
from services.ros2.ros_types import Distro, ros_types
from shared import messages as m
from shared import sample_messages, topics
from shared.config import load_robot
from shared.geometry import Pose2
from shared.ros_messages import RosFrames, RosMessages, pose2, pose_of_transform


def base_odometry(stamp: int, pose: Pose2) -> m.BaseOdometry:
    """The odometry of a robot's base."""
    zeros = np.zeros(9)
    return m.BaseOdometry(stamp, 1, True, pose, False, 0.0, 0.0, 0.0, zeros, zeros, float("nan"))


ROBOT = load_robot("x80sv").robot
STAMP = 1_700_000_000_123_456_789
XS = np.array([0.0, 1.0, 2.0])
ONES = np.ones((2, 5), np.float32)
FRAMES = RosFrames()
SAMPLES = {
    "scan": sample_messages.scan(STAMP, ROBOT.laser),
    "scan_2": sample_messages.scan(STAMP, ROBOT.laser),
    "hardware/odometry": base_odometry(STAMP, Pose2(1, 2, 3)),
    "odom": sample_messages.odometry(STAMP, Pose2(1, 2, 3), 0.4),
    "pose": sample_messages.pose_estimate(STAMP, Pose2(1, 2, 3)),
    "plan": m.Path(STAMP, 1, 1, "", XS, XS, XS, 3.0, 3.0),
    "debug/rollouts": m.Rollouts(
        STAMP, np.ones((2, 5), np.float32), np.ones((2, 5), np.float32), np.ones(2, np.float32)
    ),
    "debug/costmap": m.Costmap(STAMP, -1.0, -2.0, 0.05, np.full((4, 6), 99, np.int8)),
    "debug/global_costmap": m.Costmap(STAMP, -1.0, -2.0, 0.05, np.full((4, 6), 99, np.int8)),
    "debug/moving_obstacles": m.MovingObstacles(
        STAMP, *(np.array([row], np.float32) for row in (1, 2, 0.5, -0.5, 0.3))
    ),
    "map/state": m.MapState(STAMP, 1, "office", ()),
    "base/status": m.BaseStatus(STAMP, 12.5, 0.0, 0.0, True, "", ""),
    "guard/status": m.GuardStatus(STAMP, m.GuardState.STOPPED, "", "estop", "", 0.0),
    "nav/status": m.NavStatus(STAMP, 1, m.NavState.FAILED, "", "", "", Pose2(), 0.0, 0.0, 0, 1, 0),
    "health": m.Health(STAMP, "mapper", 1, "running", 1, 0, 0, 0, "", 0.1, 50.0, 1.0, ()),
    "log": m.LogLine(STAMP, "WARNING", "a wheel slips"),
    "sim/clock": m.Clock(STAMP, 1.0),
    "zones": m.Zones(STAMP, (m.Zone(STAMP, "hall", m.ZoneKind.KEEP_OUT, XS, XS**2),)),
}


def state(distro: Distro = Distro.JAZZY, frames: RosFrames = FRAMES) -> OutgoingState:
    return OutgoingState(RosMessages(ros_types(distro).types, frames), 1_000_000_000)


def rows_with_sources():
    return [(row, topic) for row in OUTGOING for topic in row.sources if topic is not topics.MAP]


@pytest.mark.parametrize("distro", Distro)
@pytest.mark.parametrize(
    ("row", "topic"), rows_with_sources(), ids=lambda part: getattr(part, "name", getattr(part, "key", ""))
)
def test_a_message_comes_back_the_same_from_cdr(distro, row, topic):
    types = ros_types(distro)
    made = list(converted(state(distro), frozenset((row.name,)), topic, SAMPLES[topic.key], "mapper"))
    if (row.name, topic) in (("/tf", topics.POSE), ("/tf", topics.BASE_MOTION), ("/places", topics.MAP_STATE)):
        assert made == []  # it is sent with odometry, and with the places that are read
        return
    [(name, message)] = made
    assert name == row.name
    assert message.__msgtype__ == row.type
    data = types.encode(message)
    assert data[:4] == b"\x00\x01\x00\x00"
    assert types.encode(types.decode(data, row.type)) == data


def converted_one(name: str, topic, message, **options):
    return next(iter(converted(state(**options), frozenset((name,)), topic, message, "mapper")))[1]


def test_a_stamp_is_seconds_and_nanoseconds_and_the_frames_are_the_configurations():
    frames = RosFrames("world", "wheel_odom", "base_footprint", "lidar")
    odometry = converted_one("/odom", topics.ODOM, SAMPLES["odom"], frames=frames)
    assert (odometry.header.stamp.sec, odometry.header.stamp.nanosec) == (1_700_000_000, 123_456_789)
    assert (odometry.header.frame_id, odometry.child_frame_id) == ("wheel_odom", "base_footprint")
    assert converted_one("/scan", topics.SCAN, SAMPLES["scan"], frames=frames).header.frame_id == "lidar"
    back = pose2(odometry.pose.pose)
    assert back.distance(Pose2(1, 2, 3)) < 1e-9
    assert odometry.twist.twist.linear.x == 0.4


@pytest.mark.parametrize("robot_first", [True, False])
def test_a_robot_with_its_own_odom_is_where_the_stack_says(robot_first):
    """Its base was restarted and counts from 0, so the frames differ. A later message of one source has no partner."""
    config = Ros2Config(drives=True)
    make = RosMessages(ros_types(config.distro).types, config.stack_frames)
    both = OutgoingState(make, 1_000_000_000, config.ros_frames.odom)
    by_stack, by_robot, map_from_odom = Pose2(5, 1, 0.3), Pose2(0.2, 0.1, -0.4), Pose2(1, 2, 0.5)
    messages = [
        (topics.BASE_MOTION, base_odometry(STAMP, by_robot)),
        (topics.ODOM, sample_messages.odometry(STAMP, by_stack, 0.4)),
    ]
    late = (topics.BASE_MOTION, base_odometry(STAMP + 1, Pose2()))
    estimate = replace(sample_messages.pose_estimate(STAMP, Pose2()), map_from_odom=map_from_odom)
    rows = [*messages[:1], late, *messages[1:]] if robot_first else [*messages[::-1], late]
    found = [
        made
        for topic, message in [(topics.POSE, estimate), *rows]
        for _, made in converted(both, frozenset(("/tf",)), topic, message, "")
    ]
    [tf] = found
    frames = {(row.header.frame_id, row.child_frame_id): pose_of_transform(row.transform) for row in tf.transforms}
    assert frames.keys() == {("map", "odom"), ("map", "zenav_odom")}
    truth = map_from_odom @ by_stack
    for frame, pose in (("odom", by_robot), ("zenav_odom", by_stack)):
        there = frames["map", frame] @ pose
        assert (there.x, there.y, there.yaw) == pytest.approx((truth.x, truth.y, truth.yaw))


def test_the_local_costmap_is_in_odom_and_the_global_one_in_the_map():
    local = converted_one("/local_costmap/costmap", topics.COSTMAP, SAMPLES["debug/costmap"])
    whole = converted_one("/global_costmap/costmap", topics.GLOBAL_COSTMAP, SAMPLES["debug/global_costmap"])
    assert (local.header.frame_id, whole.header.frame_id) == ("odom", "map")
    assert (whole.info.origin.position.x, whole.info.width, whole.data[0]) == (-1.0, 6, 99)


def test_a_stop_is_an_error_in_diagnostics():
    array = converted_one("/diagnostics", topics.GUARD, SAMPLES["guard/status"])
    assert (array.status[0].name, array.status[0].level) == ("zenav: guard", 2)
    assert "STOP is pressed" in array.status[0].message


def test_the_log_names_the_service():
    line = converted_one("/rosout", topics.LOG, SAMPLES["log"])
    assert (line.level, line.name, line.msg) == (30, "zenav.mapper", "a wheel slips")


def test_a_zone_is_a_closed_line_after_the_removal_of_the_former_ones():
    first, zone = converted_one("/zones", topics.ZONES, SAMPLES["zones"]).markers
    assert first.action == first.DELETEALL
    assert (zone.points[0].x, zone.points[0].y) == (zone.points[-1].x, zone.points[-1].y)
    assert len(zone.points) == 4


def test_a_moving_obstacle_is_a_disc_with_the_way_of_a_second_and_disappears():
    array = converted_one("/dynamic_obstacles", topics.MOVING, SAMPLES["debug/moving_obstacles"])
    first, disc, arrow = array.markers
    assert first.action == first.DELETEALL
    assert (disc.type, disc.header.frame_id, disc.lifetime.sec) == (disc.CYLINDER, "odom", 1)
    assert (disc.pose.position.x, disc.pose.position.y) == (1, 2)
    assert (disc.scale.x, disc.scale.y) == pytest.approx((0.6, 0.6))
    assert [(point.x, point.y) for point in arrow.points] == [(1, 2), (1.5, 1.5)]
    none = m.MovingObstacles(STAMP, *[np.empty(0, np.float32)] * 5)
    [gone] = converted_one("/dynamic_obstacles", topics.MOVING, none).markers
    assert gone.action == gone.DELETEALL


@pytest.mark.parametrize("distro", Distro)
def test_a_place_has_its_name_and_its_heading_where_it_has_one(distro):
    types = ros_types(distro)
    make = RosMessages(types.types, FRAMES)
    array = place_markers(make, (Place("kitchen", 1.0, 2.0, np.pi / 2), Place("hall", 3.0, 4.0, None)), STAMP)
    first, *markers = array.markers
    assert first.action == first.DELETEALL
    assert [marker.text for marker in markers if marker.type == first.TEXT_VIEW_FACING] == ["kitchen", "hall"]
    [arrow] = [marker for marker in markers if marker.type == first.ARROW]
    assert (arrow.points[1].x, arrow.points[1].y) == pytest.approx((1.0, 2.4))
    assert len({marker.id for marker in array.markers}) == len(array.markers)
    data = types.encode(array)
    assert types.encode(types.decode(data, MARKERS)) == data


def test_only_the_keys_of_the_wanted_topics_are_listened_to():
    assert keys_of(frozenset()) == frozenset()
    assert keys_of(frozenset(("/scan", "/tf"))) == {"scan", "odom", "pose", "hardware/odometry"}
    assert "log/mapper" in keys_of(frozenset(("/rosout",)))
