# SPDX-License-Identifier: Apache-2.0
"""Zones, places and moving obstacles as visualization_msgs/MarkerArray. The first marker removes the former ones."""

from dataclasses import dataclass
from math import cos, sin
from typing import Any

import numpy as np

from shared.geometry import Pose2
from shared.messages import MovingObstacles, ZoneKind, Zones
from shared.ros_messages import RosMessages
from shared.types import NS_PER_S

MARKERS = "visualization_msgs/msg/MarkerArray"
ARROW, CYLINDER, LINE_STRIP, TEXT = 0, 3, 4, 9  # types of visualization_msgs/Marker
ADD, DELETE_ALL = 0, 3  # its actions
Colour = tuple[float, float, float]
ZONE_COLOURS: dict[ZoneKind, Colour] = {ZoneKind.KEEP_OUT: (0.9, 0.1, 0.1), ZoneKind.SLOW: (0.95, 0.7, 0.1)}
PLACE_COLOUR, OBSTACLE_COLOUR = (0.1, 0.4, 0.9), (0.8, 0.2, 0.8)
LINE_M, TEXT_M, ARROW_M, HEIGHT_M = 0.05, 0.25, 0.4, 0.5  # of outlines, letters, headings and obstacles
TEXT_ABOVE_M = 0.3
OBSTACLE_LIFETIME_NS = NS_PER_S
"""After which an obstacle disappears where no message follows: they come five times a second."""


@dataclass(frozen=True, slots=True)
class Place:
    """A named pose in `map`, m. yaw: rad; None: any heading."""

    name: str
    x: float
    y: float
    yaw: float | None


def zone_markers(make: RosMessages, zones: Zones) -> Any:
    """The outline of each zone in `map`."""
    drawing = _Drawing(make, make.frames.map, "zones", zones.stamp)
    for zone in zones.zones:
        points = [(x, y) for x, y in zip(zone.xs.tolist(), zone.ys.tolist())]
        drawing.add(LINE_STRIP, ZONE_COLOURS[zone.kind], (LINE_M, 0.0, 0.0), points=[*points, points[0]])
    return drawing.message


def place_markers(make: RosMessages, places: tuple[Place, ...], stamp: int) -> Any:
    """Name and heading of each place in `map`. stamp: ns."""
    drawing = _Drawing(make, make.frames.map, "places", stamp)
    for place in places:
        x, y, yaw = place.x, place.y, place.yaw
        drawing.add(TEXT, PLACE_COLOUR, (0.0, 0.0, TEXT_M), at=(x, y, TEXT_ABOVE_M), text=place.name)
        if yaw is None:
            drawing.add(CYLINDER, PLACE_COLOUR, (LINE_M, LINE_M, LINE_M), at=(x, y, 0.0))
        else:
            end = x + ARROW_M * cos(yaw), y + ARROW_M * sin(yaw)
            drawing.add(ARROW, PLACE_COLOUR, (LINE_M, 2 * LINE_M, 0.0), points=[(x, y), end])
    return drawing.message


def obstacle_markers(make: RosMessages, obstacles: MovingObstacles) -> Any:
    """The disc of each moving obstacle in `odom`, and its way in the next second."""
    drawing = _Drawing(make, make.frames.odom, "dynamic_obstacles", obstacles.stamp, OBSTACLE_LIFETIME_NS)
    columns = obstacles.xs, obstacles.ys, obstacles.vxs, obstacles.vys, obstacles.radii
    for x, y, vx, vy, radius in zip(*(column.tolist() for column in columns), strict=True):
        size = 2 * radius, 2 * radius, HEIGHT_M
        drawing.add(CYLINDER, OBSTACLE_COLOUR, size, at=(x, y, HEIGHT_M / 2))
        drawing.add(ARROW, OBSTACLE_COLOUR, (LINE_M, 2 * LINE_M, 0.0), points=[(x, y), (x + vx, y + vy)])
    return drawing.message


class _Drawing:
    """Markers of one namespace, after one that removes all. lifetime: ns; 0: for ever."""

    def __init__(self, make: RosMessages, frame: str, namespace: str, stamp: int, lifetime: int = 0) -> None:
        self._make, self._frame, self._namespace = make, frame, namespace
        self._stamp, self._lifetime = stamp, lifetime
        self._markers: list[Any] = []
        self.add(LINE_STRIP, (0.0, 0.0, 0.0), (0.0, 0.0, 0.0), action=DELETE_ALL)

    @property
    def message(self) -> Any:
        """The MarkerArray."""
        return self._make.new(MARKERS, markers=self._markers)

    def add(
        self,
        type_: int,
        colour: Colour,
        scale: tuple[float, float, float],
        at: tuple[float, float, float] = (0.0, 0.0, 0.0),
        points: list[tuple[float, float]] | None = None,
        text: str = "",
        action: int = ADD,
    ) -> None:
        """Adds a marker. scale, at, points: m in the frame."""
        make, (red, green, blue), (width, depth, height), (x, y, z) = self._make, colour, scale, at
        pose, size = make.pose(Pose2(x, y, 0.0)), make.vector(width, depth)
        pose.position.z, size.z = z, height
        duration = make.new("builtin_interfaces/msg/Duration", sec=self._lifetime // NS_PER_S, nanosec=0)
        marker = make.new(
            "visualization_msgs/msg/Marker",
            header=make.header(self._stamp, self._frame), ns=self._namespace, id=len(self._markers), type=type_,
            action=action, pose=pose, scale=size, lifetime=duration,
            color=make.new("std_msgs/msg/ColorRGBA", r=red, g=green, b=blue, a=1.0),
            frame_locked=False, points=[make.point(*point) for point in points or ()], colors=[],
            texture_resource="", texture=self._no_image(), uv_coordinates=[], text=text, mesh_resource="",
            mesh_file=make.new("visualization_msgs/msg/MeshFile", filename="", data=np.empty(0, np.uint8)),
            mesh_use_embedded_materials=False,
        )  # fmt: skip
        self._markers.append(marker)

    def _no_image(self) -> Any:
        make = self._make
        data = np.empty(0, np.uint8)
        return make.new("sensor_msgs/msg/CompressedImage", header=make.header(0, ""), format="", data=data)
