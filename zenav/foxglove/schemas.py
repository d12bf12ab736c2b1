# SPDX-License-Identifier: Apache-2.0
"""Which of Foxglove's schemas shows which of the stack's messages? One table, for files and for the live view.

A row is a Foxglove topic, the type that it carries, and a function of (message, Seen). The function makes that type, or
None where the message has no content for it. Frames are REP 105's: map, odom, base_link, and laser.
Where Foxglove's schema leaves out fields, the whole message also goes out as JSON under /zenav. A message without
schema goes out as JSON only (as_json.py).
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from typing import Any, NamedTuple

import numpy as np
from foxglove import Schema
from foxglove import messages as fox
from numpy.typing import NDArray

from shared import messages as m
from shared import topics
from shared.config import Robot
from shared.geometry import Pose2
from shared.grid import UNKNOWN, OccupancyGrid
from shared.messages import Message
from zenav.foxglove import as_json, scene
from zenav.foxglove.diagnostics import DIAGNOSTICS, Diagnostics, diagnostics_of
from zenav.foxglove.scene import BASE, LASERS, MAP, ODOM, pose_of, quaternion, stamp_of

MAP_PERIOD = 1_000_000_000  # ns between two pictures of the map: each is the whole, megabytes of a large one

_COVARIANCE = [6 * row + column for row in (0, 1, 5) for column in (0, 1, 5)]  # x, y, yaw of a 6 x 6 matrix
_LEVELS = {
    "DEBUG": fox.LogLevel.Debug,
    "INFO": fox.LogLevel.Info,
    "WARNING": fox.LogLevel.Warning,
    "ERROR": fox.LogLevel.Error,
    "CRITICAL": fox.LogLevel.Fatal,
}


@dataclass(frozen=True, slots=True)
class MessageContext:
    """Context of a message: its publisher, and the robot, where it is known."""

    publisher: str
    robot: Robot | None


class SchemaRow(NamedTuple):
    """What a message shows on one of Foxglove's topics."""

    topic: str
    type: Any
    make: Callable[[Any, MessageContext], Any]


class ChannelEncoding(NamedTuple):
    """How a topic's messages are written: the encoding, and the schema with its name and its own encoding."""

    encoding: str
    schema: Schema


@cache
def encoding_of(type_: Any) -> ChannelEncoding:
    """How values of a type of this table are written."""
    if issubclass(type_, Message):
        schema = as_json.json_schema(type_)
        return ChannelEncoding(
            "json", Schema(name=schema["title"], encoding="jsonschema", data=as_json.compact(schema))
        )
    if type_ is Diagnostics:
        name = "diagnostic_msgs/DiagnosticArray"  # what Foxglove's diagnostics panels look for, in JSON too
        return ChannelEncoding("json", Schema(name=name, encoding="jsonschema", data=as_json.compact(DIAGNOSTICS)))
    return ChannelEncoding("protobuf", type_.get_schema())


def encode_message(value: Any) -> bytes:
    """The bytes of a value of this table."""
    if isinstance(value, Message):
        return as_json.compact(as_json.document(value))
    return as_json.compact(value.document()) if isinstance(value, Diagnostics) else bytes(value.encode())


@cache
def rows_of(key: str) -> tuple[SchemaRow, ...]:
    """What messages on a key (without the robot's name) show. The map's tiles are not here: see MapPicture."""
    topic = topics.topic_of(key)
    if topic is None or topic in (topics.MAP, topics.JOURNAL):
        return ()
    own = ROWS.get(topic.key, (SchemaRow(f"/{key}", topic.type, _itself),))
    whole = (SchemaRow(f"/zenav/{key}", topic.type, _itself),) if topic in LEAVES_OUT else ()
    return own + ALSO.get(topic.key, ()) + whole


# --- the makers -----------------------------------------------------------------------------------------------------


def laser_scan(scan: m.LaserScan, frame: str) -> fox.LaserScan:
    """The sweep in the laser's frame. Readings outside its limits become NaN: Foxglove's schema has no limits."""
    good = (scan.ranges >= scan.range_min) & (scan.ranges <= scan.range_max)
    return fox.LaserScan(
        timestamp=stamp_of(scan.stamp),
        frame_id=frame,
        pose=pose_of(Pose2()),
        start_angle=scan.angle_min,
        end_angle=scan.angle_min + scan.angle_increment * (len(scan.ranges) - 1),
        ranges=np.where(good, scan.ranges, np.nan).tolist(),
        intensities=scan.intensities.tolist(),
    )


def _transform(stamp: int, parent: str, child: str, parent_from_child: Pose2) -> fox.FrameTransforms:
    transform = fox.FrameTransform(
        timestamp=stamp_of(stamp),
        parent_frame_id=parent,
        child_frame_id=child,
        translation=fox.Vector3(x=parent_from_child.x, y=parent_from_child.y, z=0.0),
        rotation=quaternion(parent_from_child.yaw),
    )
    return fox.FrameTransforms(transforms=[transform])


def laser_transform(scan: m.LaserScan, seen: MessageContext, i_laser: int) -> fox.FrameTransforms | None:
    """base_link -> laser, with each sweep, so that a late client has it with its first sweep."""
    if seen.robot is None or i_laser >= len(seen.robot.all_lasers):
        return None
    mount = seen.robot.all_lasers[i_laser].mount
    return _transform(scan.stamp, BASE, LASERS[i_laser], Pose2(mount.x, mount.y, mount.yaw))


def odom_transform(odometry: m.Odometry, seen: MessageContext) -> fox.FrameTransforms:
    return _transform(odometry.stamp, ODOM, BASE, odometry.odom_from_base)


def map_transform(estimate: m.PoseEstimate, seen: MessageContext) -> fox.FrameTransforms:
    return _transform(estimate.stamp, MAP, ODOM, estimate.map_from_odom)


def odometry(odometry: m.Odometry, seen: MessageContext) -> fox.Odometry:
    covariance = [0.0] * 36
    for place, value in zip(_COVARIANCE, odometry.covariance.tolist(), strict=True):
        covariance[place] = value
    return fox.Odometry(
        timestamp=stamp_of(odometry.stamp),
        frame_id=ODOM,
        body_frame_id=BASE,
        pose=pose_of(odometry.odom_from_base),
        linear_velocity=fox.Vector3(x=odometry.v, y=0.0, z=0.0),
        angular_velocity=fox.Vector3(x=0.0, y=0.0, z=odometry.w),
        pose_covariance=covariance,
    )


def _pose_in_map(stamp: int, pose: Pose2) -> fox.PoseInFrame:
    return fox.PoseInFrame(timestamp=stamp_of(stamp), frame_id=MAP, pose=pose_of(pose))


def pose(estimate: m.PoseEstimate, seen: MessageContext) -> fox.PoseInFrame:
    return _pose_in_map(estimate.stamp, estimate.map_from_base)


def goal(goal: m.Goal, seen: MessageContext) -> fox.PoseInFrame | None:
    return _pose_in_map(goal.stamp, goal.map_from_goal) if goal.active else None


def true_pose(truth: m.Truth, seen: MessageContext) -> fox.PoseInFrame:
    return _pose_in_map(truth.stamp, truth.start.inverse() @ truth.world_from_base)


def robot(status: m.GuardStatus, seen: MessageContext) -> fox.SceneUpdate | None:
    """The outline, in a colour that says whether it may drive."""
    return scene.footprint(status, seen.robot) if seen.robot is not None else None


def plan(path: m.Path, seen: MessageContext) -> fox.PosesInFrame:
    """The way; no poses where there is none, which takes an old one off the screen."""
    places = zip(path.xs.tolist(), path.ys.tolist(), path.yaws.tolist(), strict=True)
    return fox.PosesInFrame(
        timestamp=stamp_of(path.stamp), frame_id=MAP, poses=[pose_of(Pose2(x, y, yaw)) for x, y, yaw in places]
    )


def log(line: m.LogLine, seen: MessageContext) -> fox.Log:
    level = _LEVELS.get(line.level, fox.LogLevel.Unknown)
    return fox.Log(timestamp=stamp_of(line.stamp), level=level, message=line.text, name=seen.publisher)


def _itself(message: Message, seen: MessageContext) -> Message:
    return message


# --- grids ----------------------------------------------------------------------------------------------------------


def _painted(red: float, green: float, blue: float, alpha: float) -> NDArray[np.uint8]:
    return np.array([red, green, blue, alpha], np.uint8)


def _palette(colours: dict[int, NDArray[np.uint8]], between: Callable[[int], NDArray[np.uint8]]) -> NDArray[np.uint8]:
    """(256, 5) uint8 by a cell's byte: red, green, blue, alpha, and the cell's own value."""
    table = np.zeros((256, 5), np.uint8)
    for value in range(-1, 101):
        table[value & 0xFF, :4] = colours[value] if value in colours else between(value)
    table[:, 4] = np.arange(256)
    return table


MAP_COLOURS = _palette({UNKNOWN: _painted(0, 0, 0, 0)}, lambda cell: _painted(*3 * (254 - 2.54 * cell,), 255))
"""White is free, black occupied, unknown transparent."""
COST_COLOURS = _palette(
    {
        UNKNOWN: _painted(0, 0, 0, 0),
        0: _painted(0, 0, 0, 0),
        99: _painted(0, 200, 220, 150),
        100: _painted(220, 0, 160, 200),
    },
    lambda cell: _painted(40 + 2.1 * cell, 60, 250 - 2.3 * cell, 30 + 0.9 * cell),
)
"""As rviz shows a costmap: magenta obstacles, cyan where the robot would touch them, red to blue beyond."""

_BYTE, _SIGNED = fox.PackedElementFieldNumericType.Uint8, fox.PackedElementFieldNumericType.Int8
_FIELDS = [("red", _BYTE), ("green", _BYTE), ("blue", _BYTE), ("alpha", _BYTE), ("cell", _SIGNED)]


def grid_of(
    stamp: int, frame: str, x: float, y: float, resolution: float, cells: NDArray[np.int8], palette: NDArray[np.uint8]
) -> fox.Grid:
    """Cells (h, w) int8, row 0 lowest, with their lower left corner at (x, y) m in `frame`."""
    w, bytes_a_cell = cells.shape[1], palette.shape[1]
    return fox.Grid(
        timestamp=stamp_of(stamp),
        frame_id=frame,
        pose=pose_of(Pose2(x, y, 0.0)),
        column_count=w,
        cell_size=fox.Vector2(x=resolution, y=resolution),
        row_stride=w * bytes_a_cell,
        cell_stride=bytes_a_cell,
        fields=[fox.PackedElementField(name=name, offset=i, type=type_) for i, (name, type_) in enumerate(_FIELDS)],
        data=palette[cells.view(np.uint8)].tobytes(),
    )


def costmap(costmap: m.Costmap, seen: MessageContext) -> fox.Grid:
    return _costs_in(ODOM, costmap)


def global_costmap(costmap: m.Costmap, seen: MessageContext) -> fox.Grid:
    return _costs_in(MAP, costmap)


def _costs_in(frame: str, costmap: m.Costmap) -> fox.Grid:
    x, y = costmap.x, costmap.y
    return grid_of(costmap.stamp, frame, x, y, costmap.resolution, costmap.cells, COST_COLOURS)


class MapPicture:
    """The map's tiles put together, and when the whole is worth showing again: where it changed, once a second."""

    def __init__(self) -> None:
        self._grid = OccupancyGrid()
        self._stamp = self._shown_at = 0
        self._changed = False

    def add(self, update: m.MapUpdate) -> None:
        """Tiles that changed, or all of them."""
        other = update.map_id != self._grid.map_id or update.resolution != self._grid.resolution
        self._changed |= bool(self._grid.apply(update).any()) or other
        self._stamp = update.stamp

    def due(self, now: int) -> fox.Grid | None:
        """The whole, cut to what is known, if it changed and the last one is over a second old at `now` (ns)."""
        if not self._changed or 0 <= now - self._shown_at < MAP_PERIOD:
            return None
        self._changed, self._shown_at = False, now
        return self.whole()

    def last(self) -> fox.Grid | None:
        """What changed since it was shown, however lately that was: for the end of a recording."""
        return self.whole() if self._changed else None

    def whole(self) -> fox.Grid:
        """The map now; one unknown cell, where there is none."""
        cells, row, column = self._grid.cells, 0, 0
        known = cells != UNKNOWN
        if known.any():
            rows, columns = np.flatnonzero(known.any(axis=1)), np.flatnonzero(known.any(axis=0))
            row, column = int(rows[0]), int(columns[0])
            cells = np.ascontiguousarray(cells[row : rows[-1] + 1, column : columns[-1] + 1])
        else:
            cells = np.full((1, 1), UNKNOWN, np.int8)
        resolution = self._grid.resolution
        x, y = self._grid.x0 + column * resolution, self._grid.y0 + row * resolution
        return grid_of(self._stamp, MAP, x, y, resolution, cells, MAP_COLOURS)


# --- the table ------------------------------------------------------------------------------------------------------

TF = "/tf"
MAP_ROW = SchemaRow("/map", fox.Grid, lambda grid, _: grid)
"""Of the pictures that a MapPicture makes."""

ROWS: dict[str, tuple[SchemaRow, ...]] = {
    topics.SCAN.key: (
        SchemaRow(TF, fox.FrameTransforms, lambda scan, seen: laser_transform(scan, seen, 0)),
        SchemaRow("/scan", fox.LaserScan, lambda scan, _: laser_scan(scan, LASERS[0])),
    ),
    topics.SCAN_2.key: (
        SchemaRow(TF, fox.FrameTransforms, lambda scan, seen: laser_transform(scan, seen, 1)),
        SchemaRow("/scan_2", fox.LaserScan, lambda scan, _: laser_scan(scan, LASERS[1])),
    ),
    topics.ODOM.key: (SchemaRow(TF, fox.FrameTransforms, odom_transform), SchemaRow("/odom", fox.Odometry, odometry)),
    topics.POSE.key: (SchemaRow(TF, fox.FrameTransforms, map_transform), SchemaRow("/pose", fox.PoseInFrame, pose)),
    topics.PLAN.key: (SchemaRow("/plan", fox.PosesInFrame, plan),),
    topics.GOAL.key: (SchemaRow("/nav/goal", fox.PoseInFrame, goal),),
    topics.LOG.key: (SchemaRow("/log", fox.Log, log),),
    topics.COSTMAP.key: (SchemaRow("/debug/costmap", fox.Grid, costmap),),
    topics.GLOBAL_COSTMAP.key: (SchemaRow("/debug/global_costmap", fox.Grid, global_costmap),),
    topics.ROLLOUTS.key: (SchemaRow("/debug/rollouts", fox.SceneUpdate, lambda rollouts, _: scene.rollouts(rollouts)),),
    topics.GRAPH.key: (SchemaRow("/debug/graph", fox.SceneUpdate, lambda graph, _: scene.graph(graph)),),
}
"""By the registry's key. What is not here goes out as JSON on its own key."""

STATE = SchemaRow("/diagnostics", Diagnostics, lambda message, seen: diagnostics_of(message))
ALSO: dict[str, tuple[SchemaRow, ...]] = {
    topics.GUARD.key: (SchemaRow("/robot", fox.SceneUpdate, robot), STATE),
    topics.NAV_STATUS.key: (STATE,),
    topics.BASE_STATUS.key: (STATE,),
    topics.HEALTH.key: (STATE,),
    topics.ZONES.key: (SchemaRow("/map/zones", fox.SceneUpdate, lambda zones, _: scene.zones(zones)),),
    topics.RANGES.key: (SchemaRow("/base/cones", fox.SceneUpdate, lambda readings, _: scene.cones(readings)),),
    topics.TRUTH.key: (
        SchemaRow("/sim/pose", fox.PoseInFrame, true_pose),
        SchemaRow("/sim/people", fox.SceneUpdate, lambda truth, _: scene.people(truth)),
    ),
}
"""Beside that."""

LEAVES_OUT = (topics.POSE, topics.PLAN, topics.GOAL)
"""Topics with fields that Foxglove's schema does not have: they go out as JSON too."""
