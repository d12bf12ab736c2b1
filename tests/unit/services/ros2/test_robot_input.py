# SPDX-License-Identifier: Apache-2.0
"""A robot with ROS 2 that zenav drives: its sensors come in with our time, and the velocity goes out."""

from math import isnan
from typing import Any

import numpy as np
import pytest

from services.ros2 import outgoing_messages
from services.ros2.bridge_device import published_rows, received_rows
from services.ros2.outgoing_topics import OUTGOING, STATIC_TF
from services.ros2.robot_input import COMMAND, STAMPED_COMMAND
from shared import sample_messages
from shared.config import load_robot
from shared.geometry import Pose2
from shared.messages import BaseOdometry, BaseStatus, LaserScan, Odometry, Velocity
from tests.unit.services.ros2.core import Core

ROBOT = load_robot("x80sv").robot
HOUR_NS = 3600 * 10**9


def stamped(core: Core, message: Any, delay: float = 0.0, clock: int = -HOUR_NS) -> list[Any]:
    """Sends a message of the robot that comes `delay` s late. clock: ns of the robot's clock, less ours."""
    at = core.service.now + 100_000_000 - round(delay * 1e9) + clock
    message.header.stamp = core.make.time(at)
    name = {"LaserScan": "/scan", "Odometry": "/odom"}[message.__msgtype__.rsplit("/", 1)[1]]
    return core.message(name, message)


def scan_of(core: Core) -> Any:
    ranges = np.linspace(0.5, 3, ROBOT.laser.n_beams)
    return core.make.scan(sample_messages.scan(0 + 10**12, ROBOT.laser, ranges))


def odometry_of(core: Core, pose: Pose2 = Pose2(1, 2, 0.5), vy: float = 0.0) -> Any:  # noqa: B008  # a value
    covariance = np.diag([0.01, 0.02, 0.03]).ravel()
    message = core.make.odometry(Odometry(10**12, pose, 0.2, 0.1, covariance))
    message.twist.twist.linear.y = vy
    return message


@pytest.fixture
def core():
    return Core(drives=True)


def test_a_scan_comes_in_with_the_time_of_our_clock_however_wrong_the_robots_is(core):
    [scan] = stamped(core, scan_of(core))
    assert isinstance(scan, LaserScan)
    assert scan.stamp == core.service.now
    assert scan.angle_increment == pytest.approx(ROBOT.laser.angle_increment)
    assert scan.ranges[:3] == pytest.approx(np.linspace(0.5, 3, ROBOT.laser.n_beams)[:3], abs=1e-6)
    [late] = stamped(core, scan_of(core), delay=0.15)
    assert core.service.now - late.stamp == pytest.approx(150_000_000, abs=10)


def test_scan_and_odometry_of_one_moment_have_one_stamp_though_a_scan_comes_later(core):
    stamped(core, odometry_of(core))
    [odometry] = stamped(core, odometry_of(core))
    [scan] = stamped(core, scan_of(core), delay=0.1)  # the next event is 0.1 s later: it is of the same moment
    assert scan.stamp == pytest.approx(odometry.stamp, abs=10)


def test_odometry_comes_in_with_pose_twist_and_covariance(core):
    [odometry] = stamped(core, odometry_of(core))
    assert isinstance(odometry, BaseOdometry)
    assert odometry.odom_from_base.distance(Pose2(1, 2, 0.5)) < 1e-9
    assert (odometry.v, odometry.w, odometry.has_pose, odometry.has_twist) == (0.2, 0.1, True, True)
    assert odometry.covariance.reshape(3, 3).diagonal() == pytest.approx([0.01, 0.02, 0.03])


def test_a_clock_that_is_set_back_makes_messages_old_until_the_guard_has_stopped(core):
    stamped(core, odometry_of(core))
    [odometry] = stamped(core, odometry_of(core), clock=-2 * HOUR_NS)
    assert core.service.now - odometry.stamp == HOUR_NS


def test_a_robot_that_moves_sideways_is_refused_and_counted(core):
    assert stamped(core, odometry_of(core, vy=0.5)) == []
    assert "holonomic" in core.lines[-1]


@pytest.mark.parametrize("name", ["/scan", "/odom"])
def test_damaged_bytes_of_a_robot_are_refused_and_counted(core, name):
    type_ = {"/scan": "sensor_msgs/msg/LaserScan", "/odom": "nav_msgs/msg/Odometry"}[name]
    assert core.event(event="message", name=name, type=type_, data=b"\x00\x01\x00\x00", gid=b"", sent=1, came=1) == []
    assert sum(core.service.rejections.counts.values()) == 1


def tf_of(core: Core, child: str = "base_link", pose: Pose2 = Pose2(1, 2, 0.5)) -> Any:  # noqa: B008  # a value
    return core.make.transforms(core.make.transform(core.service.now, "odom", child, pose))


def test_odometry_that_is_only_in_tf_comes_in_without_a_velocity():
    core = Core(drives=True, odometry="tf")
    assert core.message("/tf", core.make.transforms(core.make.transform(5, "base_link", "wheel", Pose2()))) == []
    [odometry] = core.message("/tf", tf_of(core))
    assert isinstance(odometry, BaseOdometry)
    assert odometry.odom_from_base.distance(Pose2(1, 2, 0.5)) < 1e-9
    assert (odometry.has_pose, odometry.has_twist) == (True, False)


def test_a_base_of_another_name_in_tf_is_named_with_its_setting():
    core = Core(drives=True, odometry="tf")
    assert core.message("/tf", tf_of(core, "base_footprint")) == []
    assert "ros2.frames.base=base_footprint" in core.lines[-1]


def battery_of(core: Core, voltage: float) -> Any:
    return outgoing_messages.battery(core.make, BaseStatus(10**12, voltage, 0.0, 0.0, True, "", ""))


def test_the_battery_comes_in_with_the_odometry_until_it_is_old(core):
    [odometry] = stamped(core, odometry_of(core))
    assert isnan(odometry.battery)
    assert core.message("/battery_state", battery_of(core, 15.5)) == []
    [odometry] = stamped(core, odometry_of(core))
    assert odometry.battery == 15.5
    core.service.now += 100 * 10**9
    [odometry] = stamped(core, odometry_of(core))
    assert isnan(odometry.battery)


@pytest.mark.parametrize("voltage", [-1.0, float("nan"), float("inf"), 1e9])
def test_a_voltage_that_is_none_is_not_used(core, voltage):
    core.message("/battery_state", battery_of(core, voltage))
    [odometry] = stamped(core, odometry_of(core))
    assert isnan(odometry.battery)


def hazards_of(core: Core, *rows: tuple[int, str]) -> Any:
    """Type and frame of each detection."""
    kind = "irobot_create_msgs/msg/HazardDetection"
    detections = [core.make.new(kind, header=core.make.header(5, frame), type=type_) for type_, frame in rows]
    return core.make.new(f"{kind}Vector", header=core.make.header(5, "base_link"), detections=detections)


def test_hazards_are_contacts_by_their_frames():
    core = Core(robot="turtlebot4", drives=True)
    hazards = hazards_of(core, (1, "bump_left"), (2, "cliff_front_left"), (0, "base_link"), (4, "wheel_drop_left"))
    [contacts] = core.message("/hazard_detection", hazards)
    assert contacts.bumpers == ("bump_left",)
    assert contacts.cliffs == ("cliff_front_left", "wheel_drop_left")
    [free] = core.message("/hazard_detection", hazards_of(core))
    assert (free.bumpers, free.cliffs, free.estop) == ((), (), False)


def test_a_robot_file_without_contacts_takes_no_hazards(core):
    assert core.message("/hazard_detection", hazards_of(core, (1, "bump_left"))) == []


def test_the_clock_of_a_robot_that_differs_is_said_once_and_again_after_it_jumps(core):
    def lines_after(clock: int) -> list[str]:
        n_lines = len(core.lines)
        for _ in range(150):  # 15 s
            stamped(core, odometry_of(core), clock=clock)
            core.tick(0.0)
        return [line.removeprefix("ROS 2: the robot's clock ") for line in core.lines[n_lines:]]

    stands = ": the robot stands until it is steady for 10 s"
    late = ", or its messages come so late"
    again = "is believed again"
    assert lines_after(0) == []
    assert lines_after(-HOUR_NS) == [f"was set back by 3600.0 s{late}{stands}", again, "is 3600.0 s behind ours"]
    assert core.service.state() == "in domain 0; its clock is 3600.0 s behind ours"
    assert lines_after(2 * 10**9) == [f"was set forward by 3602.0 s{stands}", again, "is 2.0 s ahead of ours"]
    assert lines_after(0) == [f"was set back by 2.0 s{late}{stands}", again, "is as ours again"]
    assert core.service.state() == "in domain 0"


@pytest.mark.parametrize("jump", [-HOUR_NS, -3 * 10**9, 3 * 10**9, HOUR_NS])
def test_after_a_clock_is_set_scans_are_refused_odometry_is_old_and_the_robot_gets_zero(core, jump):
    for _ in range(30):
        stamped(core, odometry_of(core))
    [odometry] = stamped(core, odometry_of(core), clock=jump - HOUR_NS)
    assert core.service.now - odometry.stamp == max(abs(jump), 2 * 10**9)
    assert stamped(core, scan_of(core), clock=jump - HOUR_NS) == []
    [text] = core.service.rejections.words.values()
    assert f"{abs(jump) / 1e9:.1f} s off the robot's clock" in text
    twist = core.types.decode(commands(velocity(core, 0.2, 0.1))[COMMAND], "geometry_msgs/msg/Twist")
    assert (twist.linear.x, twist.angular.z) == (0, 0)
    for _ in range(101):
        stamped(core, odometry_of(core), clock=jump - HOUR_NS)
    [scan] = stamped(core, scan_of(core), clock=jump - HOUR_NS)
    assert scan.stamp == core.service.now
    twist = core.types.decode(commands(velocity(core, 0.2, 0.1))[COMMAND], "geometry_msgs/msg/Twist")
    assert twist.linear.x == 0.2


def static(core: Core, *rows: tuple[str, str, Pose2]) -> list[Any]:
    return core.message("/tf_static", core.make.transforms(*(core.make.transform(0, *row) for row in rows)))


def test_a_mount_that_differs_from_tf_is_logged_once_with_its_setting(core):
    shell = Pose2(0.3, 0, 0)
    assert static(core, ("base_link", "shell", shell), ("shell", "laser", Pose2(-0.1, 0.0, 1.5708))) == []
    n_lines = len(core.lines)
    for _ in range(3):
        [scan] = stamped(core, scan_of(core))
    assert isinstance(scan, LaserScan)
    [line] = core.lines[n_lines:]
    assert "robot.laser.mount={x: 0.200, y: 0.000, yaw: 1.5708}" in line


def test_a_mount_that_is_that_of_tf_is_not_logged(core):
    mount = ROBOT.laser.mount
    static(core, ("base_link", "laser", Pose2(mount.x + 0.005, mount.y, mount.yaw)))
    n_lines = len(core.lines)
    stamped(core, scan_of(core))
    assert core.lines[n_lines:] == []


def test_the_beams_of_a_laser_that_hangs_upside_down_run_the_other_way(core):
    [upright] = stamped(core, scan_of(core))
    message = core.make.transforms(core.make.transform(0, "base_link", "laser", Pose2()))
    turn = message.transforms[0].transform.rotation
    turn.x, turn.w = 1.0, 0.0
    core.message("/tf_static", message)
    [hanging] = stamped(core, scan_of(core))
    assert hanging.angle_increment == -upright.angle_increment


def commands(orders: list[Any]) -> dict[str, Any]:
    return {order["publish"]: order["data"] for order in orders}


def velocity(core: Core, v: float, w: float) -> list[Any]:
    return core.take(core.service.velocity(Velocity(core.service.now, v, w, "")))


def test_the_velocity_goes_out_stamped_and_not(core):
    data = commands(velocity(core, 0.2, -0.3))
    twist = core.types.decode(data[COMMAND], "geometry_msgs/msg/Twist")
    assert (twist.linear.x, twist.angular.z) == (0.2, -0.3)
    stamped_twist = core.types.decode(data[STAMPED_COMMAND], "geometry_msgs/msg/TwistStamped")
    assert stamped_twist.twist.linear.x == 0.2
    assert stamped_twist.header.frame_id == "base_link"


def test_a_silent_base_driver_is_zero_once(core):
    velocity(core, 0.2, 0.0)
    assert core.tick(0.1) == []
    data = commands(core.tick(0.15))
    assert core.types.decode(data[COMMAND], "geometry_msgs/msg/Twist").linear.x == 0.0
    assert core.tick(0.5) == []


def test_a_velocity_that_waited_is_zero(core):
    now = core.service.now
    data = commands(core.take(core.service.velocity(Velocity(now - 250_000_000, 0.2, 0.1, ""))))
    twist = core.types.decode(data[COMMAND], "geometry_msgs/msg/Twist")
    assert (twist.linear.x, twist.angular.z) == (0.0, 0.0)
    data = commands(core.take(core.service.velocity(Velocity(now - 150_000_000, 0.2, 0.1, ""))))
    assert core.types.decode(data[COMMAND], "geometry_msgs/msg/Twist").linear.x == 0.2


def test_the_end_of_the_bridge_is_zero_for_a_robot_that_moves_and_nothing_for_one_that_stands(core):
    velocity(core, 0.2, 0.1)
    data = commands(core.take(core.service.on_shutdown()))
    twist = core.types.decode(data[COMMAND], "geometry_msgs/msg/Twist")
    assert (twist.linear.x, twist.angular.z) == (0.0, 0.0)
    assert STAMPED_COMMAND in data
    velocity(core, 0.0, 0.0)
    assert core.take(core.service.on_shutdown()) == []


def test_a_bridge_that_drives_no_robot_of_ros_publishes_no_velocity():
    assert velocity(Core(), 0.2, 0.0) == []


def test_the_robots_own_topics_are_received_and_not_published():
    published = {row.name for row in published_rows(True)}
    assert {"/scan", "/odom", "/battery_state"}.isdisjoint(published)
    assert {"/tf", "/map"} <= published
    assert {COMMAND, STAMPED_COMMAND}.isdisjoint(published)
    received = {row.name for row in received_rows(Core(drives=True).config)}
    own = {"/scan", "/odom", "/tf_static", "/battery_state", "/hazard_detection"}
    assert received == own | {"/goal_pose", "/initialpose"}
    assert {row.name for row in received_rows(Core(drives=True, imu=True).config)} == received | {"/imu"}
    by_tf = {row.name for row in received_rows(Core(drives=True, odometry="tf").config)}
    assert by_tf == received - {"/odom"} | {"/tf"}
    assert published_rows(False) == (*OUTGOING, STATIC_TF)


def test_two_types_of_one_name_keep_the_name():
    assert Core(namespace="/robot1").config.name(STAMPED_COMMAND) == "/robot1/cmd_vel"
