# SPDX-License-Identifier: Apache-2.0
"""What ROS 2 nodes may do: goals, poses, teleop with its dead man's rule, STOP; refusals are counted."""

from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from services.ros2.incoming_topics import INCOMING, TRIGGERS
from services.ros2.service import Ros2Service
from shared.geometry import Pose2
from shared.messages import EmergencyStop, GuardState, GuardStatus, MapMode, PortState, SerialData, Velocity
from shared.reasons import GOAL_BLOCKED
from shared.rejections import RejectionCause
from shared.requests import Cancel, Explore, Navigate, Pause, StartMap
from shared.sample_messages import pose_estimate
from tests.unit.services.ros2.core import START, Core

OTHER = bytes(range(100, 116))


def drive(core: Core, v: float, w: float = 0.0, gid: bytes = OTHER, delay: float = 0.0) -> list[Any]:
    return core.message("/cmd_vel", core.make.twist(v, w), gid, delay)


def confirmed(core: Core, state: GuardState) -> list[Any]:
    core.service.now += 10_000_000
    return core.take(core.service.guard_status(GuardStatus(core.service.now, state, "", "", "", 0.0)))


def test_velocities_and_goals_from_before_a_broken_link_are_refused_and_counted():
    core = Core()
    assert drive(core, 0.2)
    assert drive(core, 0.2, delay=0.2)
    assert drive(core, 0.2, delay=0.4) == []
    assert core.message("/goal_pose", core.pose(Pose2(1, 2, 0)), OTHER, delay=0.4)
    assert core.message("/goal_pose", core.pose(Pose2(1, 2, 0)), OTHER, delay=4.0) == []
    assert drive(core, 0.2)
    assert sum("later than others of its publisher" in line for line in core.lines) == 2
    assert {key for key, _ in core.service.rejections.counts} == {"ros/cmd_vel", "ros/goal_pose"}


def test_the_static_frames_are_sent_when_the_router_is_there():
    core = Core()
    [order] = core.opening
    assert order["publish"] == "/tf_static"
    [stamped] = core.types.decode(order["data"], "tf2_msgs/msg/TFMessage").transforms
    mount = core.service.robot.laser.mount
    assert (stamped.header.frame_id, stamped.child_frame_id) == ("base_link", "laser")
    assert (stamped.transform.translation.x, stamped.transform.translation.y) == (mount.x, mount.y)


def test_a_goal_pose_is_a_request_to_the_navigator():
    core = Core()
    [order] = core.message("/goal_pose", core.pose(Pose2(1.5, -2, 0.25)))
    request = core.asked(order)
    assert isinstance(request, Navigate)
    assert request.poses[0].distance(Pose2(1.5, -2, 0.25)) == 0
    core.outcome(order, accepted=False)
    assert core.lines[-1] == f"ROS 2: goal refused: {GOAL_BLOCKED.text}"


@pytest.mark.parametrize(("before", "after"), [("map", "continue"), ("localise", "localise"), ("continue", "continue")])
def test_an_initial_pose_keeps_a_mapper_that_localises_at_it(before, after):
    core = Core()
    estimate = pose_estimate(START)
    object.__setattr__(estimate, "mode", MapMode(before))
    core.take(core.service.pose(estimate))
    [order] = core.message("/initialpose", core.make.pose_estimate(pose_estimate(START, Pose2(3, 4, 0))))
    request = core.asked(order)
    assert isinstance(request, StartMap)
    assert (str(request.mode), request.at[0].x) == (after, 3)


def test_a_pose_in_another_frame_is_refused_and_counted():
    core = Core()
    assert core.message("/goal_pose", core.pose(Pose2(), "odom")) == []
    assert core.service.rejections.counts == {("ros/goal_pose", RejectionCause.CONTENT): 1}


@pytest.mark.parametrize("is_stamped", [False, True])
def test_a_velocity_is_teleoperation_stamped_or_not(is_stamped):
    core = Core()
    message = core.make.twist(0.2, -0.5)
    if is_stamped:
        message = core.make.new(
            "geometry_msgs/msg/TwistStamped", header=core.make.header(0, "base_link"), twist=message
        )
    [command] = core.message("/cmd_vel", message)
    assert isinstance(command, Velocity)
    assert (command.v, command.w) == (0.2, -0.5)


def test_the_robot_gets_zero_after_the_last_velocity_and_then_nothing():
    core = Core(teleop_hold=0.3)
    drive(core, 0.2)
    assert core.tick(0.25) == []
    [zero] = core.tick(0.1)
    assert (zero.v, zero.w) == (0.0, 0.0)
    assert core.tick(1.0) == []


def test_a_second_node_may_not_drive_while_the_first_one_does():
    core = Core()
    drive(core, 0.2)
    assert drive(core, -0.2, gid=bytes(16)) == []
    assert core.service.rejections.counts["ros/cmd_vel", RejectionCause.CONTENT] == 1
    core.tick(1.0)
    assert drive(core, -0.2, gid=bytes(16))[0].v == -0.2


def test_another_tool_that_drives_has_the_robot():
    core = Core()
    core.event(event="other_teleop")
    assert drive(core, 0.2) == []


@pytest.mark.parametrize("fault", ["sideways", "fast", "nan"])
def test_a_velocity_that_the_robot_cannot_drive_is_refused(fault):
    core = Core()
    message = core.make.twist({"fast": 1000.0, "nan": float("nan")}.get(fault, 0.1), 0.0)
    if fault == "sideways":
        message.linear.y = 0.1
    assert core.message("/cmd_vel", message) == []
    assert sum(core.service.rejections.counts.values()) == 1


def test_a_lost_router_ends_the_drive_at_once():
    core = Core()
    drive(core, 0.2)
    core.service.now += 50_000_000
    out = core.take(core.service.port_state(PortState(core.service.now, "ros", False, "the router is away")))
    assert [(command.v, command.w) for command in out] == [(0.0, 0.0)]
    assert core.service.state() == "the router is away"


def test_stop_is_repeated_until_the_guard_confirms_and_then_replied_to():
    core = Core()
    [stop] = core.request("/estop", 3, core.trigger())
    assert stop == EmergencyStop(core.service.now, True, "ROS 2")
    assert isinstance(core.tick(0.15)[0], EmergencyStop)
    assert confirmed(core, GuardState.ACTIVE) == []
    [reply] = confirmed(core, GuardState.STOPPED)
    assert core.response(reply, "std_srvs/srv/Trigger").success
    assert core.tick(0.15) == []
    [release] = core.request("/estop_release", 4, core.trigger())
    assert not release.pressed
    [reply] = confirmed(core, GuardState.IDLE)
    assert reply["reply"] == 4


def test_stop_that_no_guard_confirms_is_replied_to_as_failed():
    core = Core()
    core.request("/estop", 3, core.trigger())
    [reply] = core.tick(3.5)
    response = core.response(reply, "std_srvs/srv/Trigger")
    assert not response.success
    assert "switch the robot off" in response.message


@pytest.mark.parametrize(
    ("first", "second", "state"),
    [("/estop", "/estop_release", GuardState.IDLE), ("/estop_release", "/estop", GuardState.STOPPED)],
)
def test_stop_that_its_release_replaces_and_a_release_that_stop_replaces_fail(first, second, state):
    core = Core()
    core.request(first, 1, core.trigger())
    replies = [order for order in core.request(second, 2, core.trigger()) if isinstance(order, dict)]
    replies += core.take(core.service.guard_status(GuardStatus(core.service.now, state, "", "", "", 0.0)))
    answers = {order["reply"]: core.response(order, "std_srvs/srv/Trigger").success for order in replies}
    assert answers == {1: False, 2: True}


def test_stop_counts_whatever_its_bytes_are():
    [stop] = Core().event(event="request", name="/estop", id=1, data=b"")
    assert stop.pressed


def test_a_release_of_stop_in_damaged_bytes_is_none():
    [order] = Core().event(event="request", name="/estop_release", id=1, data=b"")
    assert order == {"reply": 1, "data": b""}


def save_request(core: Core, place: str) -> Any:
    return core.make.new(
        "nav2_msgs/srv/SaveMap_Request", map_topic="map", map_url=place, image_format="pgm", map_mode="trinary",
        free_thresh=0.25, occupied_thresh=0.65,
    )  # fmt: skip


@pytest.mark.parametrize("is_done", [True, False])
def test_a_map_is_saved_and_loaded_by_its_name(is_done):
    core = Core()
    [order] = core.request("/map_saver/save_map", 2, save_request(core, "office"))
    assert order["tool"] == ["map", "save", "office"]
    [reply] = core.outcome(order, accepted=is_done)
    assert core.response(reply, "nav2_msgs/srv/SaveMap").result is is_done
    request = core.make.new("nav2_msgs/srv/LoadMap_Request", map_url="office")
    [order] = core.request("/map_server/load_map", 3, request)
    assert order["tool"] == ["map", "load", "office"]
    [reply] = core.outcome(order, accepted=is_done)
    assert (core.response(reply, "nav2_msgs/srv/LoadMap").result == 0) is is_done


def test_what_of_a_map_s_format_does_not_count_is_said():
    core = Core()
    request = save_request(core, "office")
    n_lines = len(core.lines)
    core.request("/map_saver/save_map", 2, request)
    assert core.lines[n_lines:] == []
    request.image_format, request.map_mode = "png", "scale"
    [order] = core.request("/map_saver/save_map", 3, request)
    assert order["tool"] == ["map", "save", "office"]
    assert "image_format, map_mode does not count" in core.lines[n_lines]


@pytest.mark.parametrize("place", ["", "../x", "/etc/passwd", "a b", "--help", "file:///maps/office.yaml", "x" * 65])
def test_a_path_is_no_name_of_a_map(place):
    core = Core()
    assert core.request("/map_saver/save_map", 2, save_request(core, place)) == [{"reply": 2, "data": b""}]
    assert "is no name of a map" in core.lines[-1]


@pytest.mark.parametrize(
    ("name", "request_"),
    [("/explore", Explore), ("/cancel", Cancel), ("/pause", Pause), ("/resume", Pause)],
)
def test_a_service_without_arguments_is_a_request_and_its_reply_the_outcome(name, request_):
    core = Core()
    [order] = core.request(name, 5, core.trigger())
    request = core.asked(order)
    assert isinstance(request, request_)
    assert getattr(request, "paused", None) == {"/pause": True, "/resume": False}.get(name)
    [reply] = core.outcome(order, accepted=False)
    response = core.response(reply, "std_srvs/srv/Trigger")
    assert (reply["reply"], response.success, response.message) == (5, False, GOAL_BLOCKED.text)


def test_a_flood_of_goals_does_not_displace_a_request_that_waits_for_its_outcome():
    core = Core()
    [waiting] = core.request("/explore", 5, core.trigger())
    goals = [core.message("/goal_pose", core.pose(Pose2(1, 2, 0)))[0] for _ in range(200)]
    [reply] = core.outcome(waiting)
    assert reply["reply"] == 5
    n_lines = len(core.lines)
    core.outcome(goals[-2], accepted=False)
    assert core.lines[n_lines:] == []
    core.outcome(goals[-1], accepted=False)
    assert core.lines[n_lines:] == [f"ROS 2: goal refused: {GOAL_BLOCKED.text}"]


@pytest.mark.parametrize("name", ["/amcl/get_state", "/bt_navigator/get_state"])
def test_nav2s_simple_commander_finds_its_nodes_active(name):
    core = Core()
    [order] = core.request(name, 6, core.trigger())
    state = core.response(order, "lifecycle_msgs/srv/GetState").current_state
    assert (order["reply"], state.id, state.label) == (6, 3, "active")


def test_nav2s_panel_finds_its_lifecycle_managers_active():
    core = Core()
    [order] = core.request("/lifecycle_manager_navigation/is_active", 6, core.trigger())
    assert core.response(order, "std_srvs/srv/Trigger").success


def test_what_the_shell_rejects_is_counted_and_told_in_health():
    core = Core()
    core.event(event="rejected", name="/cmd_vel", text="a message without rmw_zenoh's attachment", n=40)
    assert core.service.rejections.counts["ros/cmd_vel", RejectionCause.CONTENT] == 40


@given(st.binary(max_size=60), st.sampled_from([row.name for row in INCOMING]))
def test_any_bytes_of_a_topic_are_survived(data, name):
    types = next(row.types for row in INCOMING if row.name == name)
    core = Core()
    core.event(event="message", name=name, type=types[0], data=data, gid=OTHER, sent=1, came=1)


@given(st.binary(max_size=60), st.sampled_from([name for name, _ in TRIGGERS]))
def test_any_bytes_of_a_request_are_survived(data, name):
    Core().event(event="request", name=name, id=1, data=data)


def test_bytes_that_are_no_event_are_survived():
    core = Core()
    assert core.take(core.service.receive(SerialData(START, "ros", b"\xc1\xff"))) == []
    assert core.take(core.service.receive(SerialData(START, "other", b"\x81\xa5event\xa5click"))) == []


def test_the_end_of_the_service_stands_the_robot_that_ros_drives():
    core = Core()
    drive(core, 0.2)
    [zero] = core.take(core.service.on_shutdown())
    assert (zero.v, zero.w) == (0.0, 0.0)


def test_without_a_router_the_state_says_what_to_set():
    core = Core()
    assert Ros2Service(core.config, core.service.robot).state() == "no router: set ros2.port.device"
