# SPDX-License-Identifier: Apache-2.0
"""Messages of the stack as those of ROS 2 that only the bridge needs: state, log, clock, markers. Stamps are ns."""

from typing import Any

import numpy as np

from shared.geometry import Pose2
from shared.messages import BaseStatus, LogLine, Message, Rollouts, ZoneKind, Zones
from shared.part_state import part_state
from shared.ros_messages import RosMessages

LOG_LEVELS = {"DEBUG": 10, "INFO": 20, "WARNING": 30, "ERROR": 40}  # rcl_interfaces/Log
LINE_STRIP, ADD, DELETE_ALL = 4, 0, 3  # visualization_msgs/Marker
ZONE_COLOURS = {ZoneKind.KEEP_OUT: (0.9, 0.1, 0.1), ZoneKind.SLOW: (0.95, 0.7, 0.1)}
ZONE_LINE_M = 0.05


def diagnostics(make: RosMessages, message: Message) -> Any:
    """diagnostic_msgs/DiagnosticArray of one part; None where the message is no state."""
    state = part_state(message)
    if state is None:
        return None
    status = make.new(
        "diagnostic_msgs/msg/DiagnosticStatus", level=state.level, name=f"zenav: {state.name}", message=state.text,
        hardware_id="zenav", values=[],
    )  # fmt: skip
    return make.new("diagnostic_msgs/msg/DiagnosticArray", header=make.header(message.stamp, ""), status=[status])


def battery(make: RosMessages, status: BaseStatus) -> Any:
    """sensor_msgs/BatteryState. What is not measured is NaN, by the message's definition."""
    nan = float("nan")
    return make.new(
        "sensor_msgs/msg/BatteryState", header=make.header(status.stamp, make.frames.base), voltage=status.battery,
        temperature=nan, current=nan, charge=nan, capacity=nan, design_capacity=nan, percentage=nan,
        power_supply_status=0, power_supply_health=0, power_supply_technology=0, present=True,
        cell_voltage=np.empty(0, np.float32), cell_temperature=np.empty(0, np.float32), location="", serial_number="",
    )  # fmt: skip


def log_line(make: RosMessages, line: LogLine, publisher: str) -> Any:
    """rcl_interfaces/Log."""
    level = LOG_LEVELS.get(line.level, LOG_LEVELS["INFO"])
    return make.new(
        "rcl_interfaces/msg/Log", stamp=make.time(line.stamp), level=level, name=f"zenav.{publisher}", msg=line.text,
        file="", function="", line=0,
    )  # fmt: skip


def clock(make: RosMessages, stamp: int) -> Any:
    """rosgraph_msgs/Clock."""
    return make.new("rosgraph_msgs/msg/Clock", clock=make.time(stamp))


def local_plan(make: RosMessages, rollouts: Rollouts) -> Any:
    """nav_msgs/Path in `odom` of the rollout that local control took; None without one."""
    if not rollouts.xs.size:
        return None
    xs, ys = rollouts.xs[0].astype(float), rollouts.ys[0].astype(float)
    yaws = np.arctan2(np.gradient(ys), np.gradient(xs)) if len(xs) > 1 else np.zeros(len(xs))
    poses = (Pose2(*row) for row in zip(xs.tolist(), ys.tolist(), yaws.tolist()))
    return make.path_of(rollouts.stamp, make.frames.odom, poses)


def zone_markers(make: RosMessages, zones: Zones) -> Any:
    """visualization_msgs/MarkerArray: the outline of each zone in `map`. The first marker removes the former ones."""
    markers = [_marker(make, zones.stamp, 0, DELETE_ALL, (0.0, 0.0, 0.0), [])]
    for i, zone in enumerate(zones.zones):
        points = [make.point(x, y) for x, y in zip(zone.xs.tolist(), zone.ys.tolist())]
        markers.append(_marker(make, zones.stamp, i, ADD, ZONE_COLOURS[zone.kind], [*points, points[0]]))
    return make.new("visualization_msgs/msg/MarkerArray", markers=markers)


def _marker(
    make: RosMessages, stamp: int, number: int, action: int, colour: tuple[float, float, float], points: list[Any]
) -> Any:
    red, green, blue = colour
    image = make.new(
        "sensor_msgs/msg/CompressedImage", header=make.header(0, ""), format="", data=np.empty(0, np.uint8)
    )
    return make.new(
        "visualization_msgs/msg/Marker",
        header=make.header(stamp, make.frames.map), ns="zones", id=number, type=LINE_STRIP, action=action,
        pose=make.pose(Pose2()), scale=make.vector(ZONE_LINE_M, 0.0),
        color=make.new("std_msgs/msg/ColorRGBA", r=red, g=green, b=blue, a=1.0),
        lifetime=make.new("builtin_interfaces/msg/Duration", sec=0, nanosec=0), frame_locked=False, points=points,
        colors=[], texture_resource="", texture=image, uv_coordinates=[], text="",
        mesh_resource="", mesh_file=make.new("visualization_msgs/msg/MeshFile", filename="", data=image.data),
        mesh_use_embedded_materials=False,
    )  # fmt: skip
