# SPDX-License-Identifier: Apache-2.0
"""Ways through a made-up building, and what a mapper that drives them makes of it."""

from collections import deque
from collections.abc import Iterator
from math import atan2, ceil, hypot

import numpy as np
from numpy.typing import NDArray

from services.mapper.config import MapperConfig
from services.mapper.maps.map_file import SavedMap
from shared.geometry import Pose2, wrapped
from tests.unit.services.mapper.rooms import RoomDrive, box

CELL, CLEAR = 0.25, 0.45  # m; m to the nearest wall that a way keeps
STEP, TURN = 0.2, 0.35  # m, rad between scans


def room(x: float) -> list[tuple[float, float, float, float]]:
    """With a door to the north, and furniture that is the same in each."""
    walls = [(x, 0, x + 6, 0), (x, 0, x, 5), (x + 6, 0, x + 6, 5), (x, 5, x + 2.4, 5), (x + 3.6, 5, x + 6, 5)]
    return [*walls, *box(x + 1, 1, x + 2, 1.6), (x + 4, 3.6, x + 5, 4.2)]


CORRIDOR = [(-1, 7, 14, 7), (-1, 5, -1, 7), (-1, 5, 0, 5), (6, 5, 7, 5), (13, 5, 14, 5), (14, 5, 14, 7)]
ALIKE = np.array([*room(0), *room(7), *CORRIDOR, *box(11, 6.6, 12, 7)], float)
"""Two rooms that look alike at a corridor that does not."""
SHUT = np.array([*ALIKE, (2.0, 5, 4.0, 5), (9.0, 5, 11, 5)])
"""The same with both doors closed."""
START = Pose2(6.5, 6.0, 0.0)


class Building:
    """Segments (k, 4), and the floor between them that holds `inside`."""

    def __init__(self, segments: NDArray[np.float64], inside: tuple[float, float]) -> None:
        self.segments = segments
        low = segments.reshape(-1, 2).min(axis=0)
        w, h = np.ceil((segments.reshape(-1, 2).max(axis=0) - low) / CELL).astype(int)
        centres = low + (np.stack(np.meshgrid(np.arange(w), np.arange(h)), axis=-1) + 0.5) * CELL
        a, b = segments[:, :2], segments[:, 2:]
        along = b - a
        from_a = centres[:, :, None] - a
        share = np.clip((from_a * along).sum(-1) / np.maximum((along**2).sum(-1), 1e-12), 0, 1)
        free = np.hypot(*np.moveaxis(from_a - share[..., None] * along, -1, 0)).min(axis=-1) > CLEAR
        self.low, self.free = low, free
        self.cells = sorted(self._from(self._cell(*inside)))

    def _cell(self, x: float, y: float) -> tuple[int, int]:
        return int((y - self.low[1]) // CELL), int((x - self.low[0]) // CELL)

    def _from(self, cell: tuple[int, int]) -> dict[tuple[int, int], tuple[int, int]]:
        """Each cell that can be reached, and the one before it."""
        before = {cell: cell}
        queue = deque([cell])
        while queue:
            r, c = queue.popleft()
            for near in ((r + 1, c), (r - 1, c), (r, c + 1), (r, c - 1)):
                if near not in before and all(0 <= n < m for n, m in zip(near, self.free.shape)) and self.free[near]:
                    before[near] = (r, c)
                    queue.append(near)
        return before

    def anywhere(self, rng: np.random.Generator) -> Pose2:
        row, column = self.cells[int(rng.integers(len(self.cells)))]
        return self._place((row, column), float(rng.uniform(-3.1, 3.1)))

    def _place(self, cell: tuple[int, int], yaw: float) -> Pose2:
        x, y = self.low + (np.array(cell[::-1]) + 0.5) * CELL
        return Pose2(float(x), float(y), yaw)

    def way(self, pose: Pose2, rng: np.random.Generator) -> Iterator[Pose2]:
        """Motions from a pose to one place after the other, for ever."""
        while True:
            goal = self.cells[int(rng.integers(len(self.cells)))]
            before = self._from(goal)
            cell = self._cell(pose.x, pose.y)
            while cell != goal and cell in before:
                for _ in range(3):
                    cell = before[cell]
                for motion in towards(pose, self._place(cell, 0.0)):
                    pose = pose @ motion
                    yield motion


def towards(pose: Pose2, place: Pose2) -> list[Pose2]:
    """A turn, then straight on."""
    turn = wrapped(atan2(place.y - pose.y, place.x - pose.x) - pose.yaw)
    away = hypot(place.y - pose.y, place.x - pose.x)
    if away < 1e-6:
        return []
    n_turns, n_steps = max(ceil(abs(turn) / TURN), 1), ceil(away / STEP)
    return [Pose2(0, 0, turn / n_turns)] * n_turns + [Pose2(away / n_steps, 0, 0)] * n_steps


def drives(driven: RoomDrive, building: Building, metres: float, rng: np.random.Generator) -> Iterator[float]:
    """Drives so far; after each scan, m driven."""
    way = 0.0
    for motion in building.way(driven.true, rng):
        driven.step(motion)
        way += hypot(motion.x, motion.y)
        yield way
        if way >= metres:
            return


def saved_by(driven: RoomDrive) -> SavedMap:
    """The map that a mapper has made."""
    driven.now += 3600_000_000_000
    driven.mapper.now = driven.now
    driven.take(driven.mapper.slam.jobs.optimize())
    driven.publish_map()
    driven.publish_map()
    return driven.mapper.slam.snapshot()


def put(segments, saved, pose, fixed=True, **config):
    """A robot at `pose` on a saved map, whose pose it is not given."""
    driven = RoomDrive(segments, MapperConfig.model_validate(config), noise=0.01)
    driven.true = pose
    driven.take(driven.mapper.use_map(saved, fixed))
    return driven


def off(driven, first):
    """Error of the published pose: m, rad."""
    rest = (first.inverse() @ driven.true).inverse() @ driven.poses[-1].map_from_base
    return hypot(rest.x, rest.y), abs(rest.yaw)
