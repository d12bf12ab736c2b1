# SPDX-License-Identifier: Apache-2.0
"""What Foxglove has no message for, drawn: footprint, rollouts, range cones, people. And its times and poses."""

from math import cos, sin

import numpy as np
from foxglove import messages as fox

from shared.config import Robot
from shared.geometry import Pose2
from shared.messages import GuardState, GuardStatus, KeyframeGraph, RangeReadings, Rollouts, Truth, ZoneKind, Zones

MAP, ODOM, BASE = "map", "odom", "base_link"
LASERS = "laser", "laser_2"
"""Frames, as REP 105 calls them."""

_LATEST = 2**32 - 1  # s: what Foxglove's times can hold, the year 2106
_LIFETIME = fox.Duration(sec=2, nsec=0)  # an entity without update disappears
_FLAT = 0.02  # m above the floor, so that lines lie on the map and not in it
_PERSON_WIDTH, _PERSON_HEIGHT = 0.4, 1.7  # m
_CONE_STEPS = 8

_GUARD_COLOURS = {
    GuardState.ACTIVE: fox.Color(r=0.1, g=0.7, b=0.2, a=1.0),
    GuardState.HOLD: fox.Color(r=0.95, g=0.65, b=0.0, a=1.0),
    GuardState.STOPPED: fox.Color(r=0.9, g=0.1, b=0.1, a=1.0),
    GuardState.FAULT: fox.Color(r=0.9, g=0.1, b=0.1, a=1.0),
    GuardState.IDLE: fox.Color(r=0.2, g=0.4, b=0.9, a=1.0),
}
_ZONE_COLOURS = {
    ZoneKind.KEEP_OUT: fox.Color(r=0.9, g=0.1, b=0.1, a=0.9),
    ZoneKind.SLOW: fox.Color(r=0.95, g=0.8, b=0.1, a=0.9),
}
_CLOSURE_COLOURS = {1: fox.Color(r=0.1, g=0.7, b=0.3, a=0.8), 0: fox.Color(r=0.9, g=0.2, b=0.1, a=0.8)}
_TAKEN, _SOUND = fox.Color(r=0.1, g=0.8, b=0.2, a=1.0), fox.Color(r=0.3, g=0.6, b=0.9, a=0.6)


def stamp_of(ns: int) -> fox.Timestamp:
    sec, nsec = divmod(ns, 10**9)
    return fox.Timestamp(sec=min(sec, _LATEST), nsec=nsec)


def quaternion(yaw: float) -> fox.Quaternion:
    return fox.Quaternion(x=0.0, y=0.0, z=sin(0.5 * yaw), w=cos(0.5 * yaw))


def pose_of(pose: Pose2) -> fox.Pose:
    return fox.Pose(position=fox.Vector3(x=pose.x, y=pose.y, z=0.0), orientation=quaternion(pose.yaw))


def _line(
    points: list[tuple[float, float]], colour: fox.Color, width: float, closed: bool = False
) -> fox.LinePrimitive:
    """width: m."""
    kind = fox.LinePrimitiveLineType.LineLoop if closed else fox.LinePrimitiveLineType.LineStrip
    corners = [fox.Point3(x=x, y=y, z=_FLAT) for x, y in points]
    return fox.LinePrimitive(type=kind, pose=pose_of(Pose2()), thickness=width, points=corners, color=colour)


def _entity(stamp: int, frame: str, name: str, lines: list[fox.LinePrimitive], locked: bool = False) -> fox.SceneUpdate:
    """A scene with one entity of lines. locked: it moves with its frame until its next update."""
    entity = fox.SceneEntity(
        timestamp=stamp_of(stamp), frame_id=frame, id=name, lifetime=_LIFETIME, frame_locked=locked, lines=lines
    )
    return fox.SceneUpdate(entities=[entity])


def footprint(status: GuardStatus, robot: Robot) -> fox.SceneUpdate:
    """The robot's outline: green drives, blue idle, orange holds, red stopped."""
    outline = _line([(x, y) for x, y in robot.corners.tolist()], _GUARD_COLOURS[status.state], 0.03, closed=True)
    return _entity(status.stamp, BASE, "footprint", [outline], locked=True)


def rollouts(rollouts: Rollouts) -> fox.SceneUpdate:
    """The ways that were weighed up, good ones green and bad ones red, and the one that was taken, broad."""
    order = np.argsort(np.argsort(rollouts.costs)) / max(1, len(rollouts.costs) - 1)
    lines = [
        _line(list(zip(xs, ys, strict=True)), fox.Color(r=rank, g=1.0 - rank, b=0.1, a=0.35), 0.005)
        for xs, ys, rank in zip(rollouts.xs[1:].tolist(), rollouts.ys[1:].tolist(), order[1:].tolist(), strict=True)
    ]
    if len(rollouts.xs):
        lines.append(_line(list(zip(rollouts.xs[0].tolist(), rollouts.ys[0].tolist(), strict=True)), _TAKEN, 0.03))
    return _entity(rollouts.stamp, ODOM, "rollouts", lines)


def graph(graph: KeyframeGraph) -> fox.SceneUpdate:
    """The loop closures between keyframes in `map`: accepted ones green, rejected ones red."""
    columns = (graph.from_xs, graph.from_ys, graph.to_xs, graph.to_ys, graph.accepted)
    lines = [
        _line([(x, y), (to_x, to_y)], _CLOSURE_COLOURS[accepted], 0.02)
        for x, y, to_x, to_y, accepted in zip(*(column.tolist() for column in columns), strict=True)
    ]
    return _entity(graph.stamp, MAP, "graph", lines)


def cones(readings: RangeReadings) -> fox.SceneUpdate:
    """The cones of ultrasonic and infrared that saw something, each to its echo."""
    lines = []
    columns = (readings.x, readings.y, readings.yaw, readings.field_of_view, readings.ranges)
    for x, y, yaw, view, reach in zip(*(column.tolist() for column in columns), strict=True):
        if np.isfinite(reach):
            edge = [yaw + view * (i / _CONE_STEPS - 0.5) for i in range(_CONE_STEPS + 1)]
            lines.append(_line([(x, y), *((x + reach * cos(a), y + reach * sin(a)) for a in edge)], _SOUND, 0.01, True))
    return _entity(readings.stamp, BASE, "cones", lines, locked=True)


def zones(message: Zones) -> fox.SceneUpdate:
    """The zones' outlines in `map`: keep-out zones are red, speed zones yellow. They stay until the next update."""
    lines = [
        _line(list(zip(z.xs.tolist(), z.ys.tolist(), strict=True)), _ZONE_COLOURS[z.kind], 0.05, closed=True)
        for z in message.zones
    ]
    entity = fox.SceneEntity(timestamp=stamp_of(message.stamp), frame_id=MAP, id="zones", lines=lines)
    return fox.SceneUpdate(entities=[entity])


def people(truth: Truth) -> fox.SceneUpdate:
    """The simulator's people as cylinders in `map`."""
    in_map = truth.start.inverse() @ np.column_stack((truth.people_x, truth.people_y)).astype(float)
    bodies = [
        fox.CylinderPrimitive(
            pose=fox.Pose(position=fox.Vector3(x=x, y=y, z=0.5 * _PERSON_HEIGHT), orientation=quaternion(0.0)),
            size=fox.Vector3(x=_PERSON_WIDTH, y=_PERSON_WIDTH, z=_PERSON_HEIGHT),
            bottom_scale=1.0,
            top_scale=1.0,
            color=fox.Color(r=0.6, g=0.3, b=0.7, a=0.8),
        )
        for x, y in in_map.tolist()
    ]
    entity = fox.SceneEntity(
        timestamp=stamp_of(truth.stamp), frame_id=MAP, id="people", lifetime=_LIFETIME, cylinders=bodies
    )
    return fox.SceneUpdate(entities=[entity])
