# SPDX-License-Identifier: Apache-2.0
"""Messages of the stack as those of ROS 2 that only the bridge needs: state, log, clock. Stamps are ns."""

from typing import Any

import numpy as np

from shared.geometry import Pose2
from shared.messages import BaseStatus, LogLine, Message, Rollouts
from shared.part_state import part_state
from shared.ros_messages import RosMessages

LOG_LEVELS = {"DEBUG": 10, "INFO": 20, "WARNING": 30, "ERROR": 40}  # rcl_interfaces/Log


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
