# SPDX-License-Identifier: Apache-2.0
"""The static transforms of a driven robot, by which its sensors lie on it."""

from typing import Any

import numpy as np

from shared.ros_frames import Frames
from shared.ros_readings import frame_name, transform_row
from shared.types import Float64s

MAX_FRAMES = 256  # of /tf_static; a robot has some dozens


class StaticFrames:
    """Transforms of /tf_static. base: the robot's frame in ROS."""

    def __init__(self, base: str) -> None:
        self.base = base
        self.n_messages = 0
        self._rows: dict[str, tuple[str, Float64s]] = {}  # parent and transform by child

    def add(self, message: Any) -> None:
        """Takes a tf2_msgs/TFMessage."""
        for row in message.transforms:
            child = frame_name(row.child_frame_id)
            if len(self._rows) < MAX_FRAMES or child in self._rows:
                self._rows[child] = frame_name(row.header.frame_id), transform_row(row.transform)
        self.n_messages += 1

    def base_from(self, sensor: str) -> Float64s | None:
        """(4, 4), or None where no transforms lead to the frame. Raises ValueError where a transform is none."""
        frames = Frames()
        for child, (parent, row) in self._rows.items():
            frames.add(parent, child, 0, row, static=True)
        found = frames.find(self.base, sensor, np.zeros(1, np.int64))
        return None if found is None else np.asarray(found[0])
