# SPDX-License-Identifier: Apache-2.0
"""Which settings may change while the robot runs? One table, and the rule by which a service takes a change.

Types, bounds and descriptions are those of the configuration's models. A change is validated as a robot's file is.
"""

import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

from pydantic.fields import FieldInfo
from ruamel.yaml.comments import CommentedMap

from shared.config import Robot, RobotFile, Section, UserError, nearest, yaml_value

RUN_TIME = "set at run time"
"""Origin of a value that was set while the robot runs."""


@dataclass(frozen=True, slots=True)
class RuntimeSetting:
    """A setting that may change while the robot runs.

    name: dotted, as in a robot's file.  services: those that take it.
    is_limit: it may only be lowered below the value with which the robot was started.
    """

    name: str
    services: tuple[str, ...]
    is_limit: bool = False

    @property
    def path(self) -> tuple[str, ...]:
        return tuple(self.name.split("."))


class Configuration(NamedTuple):
    """What a service is built from: its own section, and the robot's."""

    config: Any
    robot: Robot


def _rows(
    section: str, names: str, services: tuple[str, ...] = (), is_limit: bool = False
) -> tuple[RuntimeSetting, ...]:
    """Rows of the settings at a path. services: that of the path's section, where none is given."""
    takers = services or (section.partition(".")[0],)
    return tuple(RuntimeSetting(f"{section}.{name}", takers, is_limit) for name in names.split())


RUNTIME_SETTINGS: tuple[RuntimeSetting, ...] = (
    *_rows(
        "robot.drive",
        "max_speed max_reverse_speed max_turn_rate max_acceleration max_turn_acceleration",
        services=("local_ctrl", "guard"),
        is_limit=True,
    ),
    *_rows("sim.laser", "sigma sigma_share dropout"),
    *_rows("sim.ranges", "sigma dropout"),
    *_rows("odometry", "wheel_variance"),
    *_rows("mapper.front_end", "keyframe_distance keyframe_turn"),
    *_rows("mapper.back_end", "redraw_interval"),
    *_rows("mapper.loop_closure", "enabled search_interval min_inlier_ratio min_inlier_margin max_rival_ratio"),
    *_rows("mapper.kidnap_detection", "min_agreement n_averaged_scans"),
    *_rows("mapper", "max_path_without_closure"),
    *_rows("planner.cost", "margin min_margin inflation_radius clearance_weight clearance_falloff narrow_weight"),
    *_rows("planner.cost", "unknown unknown_weight"),
    *_rows("planner.path", "goal_reach escape_radius"),
    *_rows("planner.replanning", "off_plan refine_gain switch_gain min_switch_gain max_wait_time min_wait_distance"),
    *_rows("local_ctrl", "max_speed max_reverse_speed", is_limit=True),
    *_rows("local_ctrl", "speed_settling"),
    *_rows("local_ctrl.costmap", "memory echo_memory no_echo_clears scan ultrasonic infrared static_map"),
    *_rows("local_ctrl.costmap.dynamic_obstacles", "enabled min_speed max_size memory"),
    *_rows("local_ctrl.cost_to_go", "beside_plan max_beside_plan near_obstacles clearance unknown no_room"),
    *_rows("local_ctrl.path_following", "turn_from turn_until turn_rate look closed_within stalled_after"),
    *_rows("local_ctrl.manoeuvres", "back_up_speed turn_rate"),
    *_rows("local_ctrl.mppi", "temperature clearance critical_clearance full_speed_clearance min_speed_share"),
    *_rows("local_ctrl.mppi", "dynamic_clearance"),
    *_rows("local_ctrl.mppi.critics", "progress haste goal obstacle critical overspeed headway dynamic_collision"),
    *_rows("local_ctrl.mppi.critics", "dynamic_obstacle reverse twirl smooth collision"),
    *_rows("local_ctrl.dwa", "path_distance_bias goal_distance_bias occdist_scale clearance forward_point_distance"),
    *_rows("local_ctrl.dwa", "stop_time_buffer reverse"),
    *_rows("local_ctrl.pursuit", "lookahead_time min_lookahead_dist max_lookahead_dist cost_scaling_dist"),
    *_rows("local_ctrl.pursuit", "cost_scaling_gain regulated_linear_scaling_min_radius"),
    *_rows("local_ctrl.pursuit", "regulated_linear_scaling_min_speed stop_time_buffer"),
    *_rows("navigator", "tolerance yaw_tolerance lost_time"),
    *_rows("navigator.leg", "progress progress_time blocked_time refused_time unreachable_time start_time hold_time"),
    *_rows("navigator.leg", "detours base_time min_speed"),
    *_rows("navigator.recovery", "back_up turn wait deadline earned_by"),
    *_rows("navigator.exploration", "size_weight turn_weight switch_gain switch_after look_time max_visits patience"),
    *_rows("navigator.exploration", "max_recoveries settle_time blocked_time tolerance"),
    *_rows("navigator.exploration.frontier", "margin min_margin goal_margin min_size max_size"),
    *_rows("recorder", "split_size split_time budget upload_rate"),
)
"""No row for the guard's settings, ages, what is measured (max_braking), or what hides scans from the guard (masks)."""

BY_NAME = {row.name: row for row in RUNTIME_SETTINGS}


def settings_of(service: str) -> tuple[RuntimeSetting, ...]:
    """The rows that a service takes."""
    return tuple(row for row in RUNTIME_SETTINGS if service in row.services)


def taken_by(service: str, name: str) -> RuntimeSetting:
    """The row of a name. Raises UserError where this service takes no such setting at run time."""
    row = BY_NAME.get(name)
    if row is None or service not in row.services:
        what = f"{name} is not a setting that {service} takes while it runs"
        raise UserError(what, nearest(name, tuple(row.name for row in settings_of(service))))
    return row


def reconfigured(service: str, started: Configuration, values: Mapping[str, str]) -> Configuration:
    """The configuration of a service with these settings (name -> YAML) set. Raises UserError, with a hint.

    started: its configuration at its start.
    """
    file = RobotFile(Path(service), CommentedMap())
    file.put(("robot",), started.robot.model_dump(mode="json"), RUN_TIME)
    file.put((service,), started.config.model_dump(mode="json"), RUN_TIME)
    rows = [taken_by(service, name) for name in values]
    for row in rows:
        put_runtime_value(file, row, values[row.name])
    try:
        new = Configuration(file.section(service, type(started.config)), file.robot)
    except UserError as error:
        raise without_origin(error) from None
    for row in rows:
        limit, value = value_at(started, row), value_at(new, row)
        if row.is_limit and value > limit:
            what = f"{row.name} may only be lowered while the robot runs: {value:g} is over {limit:g}"
            raise UserError(what, "for more, change the robot's file and start again")
    return new


def put_runtime_value(file: RobotFile, row: RuntimeSetting, text: str) -> None:
    """Sets one value of a robot's file from its text. Raises UserError where the text is no single value."""
    value = yaml_value(text)
    if not isinstance(value, (bool, int, float, str)):
        raise UserError(f"{row.name}: {text!r} is no value", "give one number, true, false, or one word")
    file.put(row.path, value, RUN_TIME)


def without_origin(error: UserError) -> UserError:
    """The error of a value that was set at run time, without that origin: its reader has just given the value."""
    return UserError(error.what.removeprefix(f"{RUN_TIME}: "), error.hint)


def value_at(configuration: Configuration, row: RuntimeSetting) -> Any:
    """The present value of a setting."""
    node: Any = configuration.robot if row.path[0] == "robot" else configuration.config
    for name in row.path[1:]:
        node = getattr(node, name)
    return node


def field_at(model: type[Section], path: tuple[str, ...]) -> FieldInfo:
    """The field of a model at a path: type, bounds and description. Of what is no section, that of the whole.

    KeyError where there is none.
    """
    field = model.model_fields[path[0]]
    inner = field.annotation
    if len(path) == 1 or not (isinstance(inner, type) and issubclass(inner, Section)):
        return field
    return field_at(inner, path[1:])


def present_values(service: str, configuration: Configuration) -> dict[str, str]:
    """Name -> value, as YAML, of every setting that a service takes while it runs."""
    return {row.name: json.dumps(value_at(configuration, row)) for row in settings_of(service)}


def changed_values(service: str, old: Configuration, new: Configuration) -> list[str]:
    """`name = value (was value)` for every setting that differs."""
    rows = [(row.name, value_at(old, row), value_at(new, row)) for row in settings_of(service)]
    return [f"{name} = {json.dumps(now)} (was {json.dumps(before)})" for name, before, now in rows if now != before]
