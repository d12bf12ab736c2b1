# SPDX-License-Identifier: Apache-2.0
"""The edits of the present map, which move with the keyframes that they were drawn beside.

This is our own; Cartographer anchors a landmark to a trajectory node in a similar way.
"""

from collections.abc import Collection, Iterable, Sequence
from dataclasses import replace

import numpy as np

from services.mapper.back_end.pose_graph import pose_of
from services.mapper.grid.edit_cells import edit_masks, edits_problem, is_outside
from services.mapper.grid.occupancy import Occupancy
from shared.geometry import Pose2
from shared.messages import MapEdit
from shared.types import Float64s, Int64s


class MapEdits:
    """Edits in `map`, each rigidly anchored to its nearest keyframe, as soon as there is one.

    n_changes: rises with each change.
    """

    def __init__(self, edits: Iterable[MapEdit] = ()) -> None:
        self.edits = tuple(edits)
        self.n_changes = 0
        self._anchors: dict[int, tuple[int, Pose2]] = {}  # edit -> node, and its pose at which the edit was placed

    @property
    def anchor_nodes(self) -> frozenset[int]:
        """Names of the nodes that edits are anchored to."""
        return frozenset(node for node, _ in self._anchors.values())

    def change(
        self, add: Sequence[MapEdit], remove: Collection[int], tiles: Collection[tuple[int, int]], resolution: float
    ) -> str | None:
        """Removes edits by their ids, and adds others; returns what is wrong with them, and then changes nothing.

        tiles: of the map, by row and column.  resolution: m per cell.
        """
        remaining = [edit for edit in self.edits if edit.id not in remove]
        problem = edits_problem([*remaining, *add])
        if problem is None and any(is_outside(edit, tiles, resolution) for edit in add):
            problem = "the edit lies outside the map"
        if problem is None:
            self.remove(remove)
            self.add(add)
        return problem

    def add(self, edits: Iterable[MapEdit]) -> None:
        """Adds edits under ids of their own."""
        first = max((edit.id for edit in self.edits), default=0) + 1
        self.edits += tuple(replace(edit, id=first + k) for k, edit in enumerate(edits))
        self.n_changes += 1

    def remove(self, ids: Iterable[int]) -> None:
        """Removes edits; an id that no edit has is no error."""
        removed = frozenset(ids)
        self.edits = tuple(edit for edit in self.edits if edit.id not in removed)
        self._anchors = {id_: anchor for id_, anchor in self._anchors.items() if id_ not in removed}
        self.n_changes += 1

    def anchor(self, nodes: Int64s, poses: Float64s) -> None:
        """Anchors every edit to the nearest of these nodes.  nodes: (n,) names.  poses: (n, 3) of them in `map`."""
        self._anchors = {}
        self.follow(nodes, poses)

    def follow(self, nodes: Int64s, poses: Float64s) -> bool:
        """Moves the edits with their nodes; returns whether any moved. An edit without a node is anchored."""
        rows = {node: row for row, node in enumerate(nodes.tolist())}
        edits = []
        for edit in self.edits:
            node, placed_at = self._anchors.get(edit.id, (-1, Pose2()))
            if node not in rows and rows:
                middle = np.array((edit.xs.mean(), edit.ys.mean()))
                node = int(nodes[np.argmin(np.hypot(*(poses[:, :2] - middle).T))])
                placed_at = pose_of(poses[rows[node]])
            if node in rows:
                pose = pose_of(poses[rows[node]])
                edit = edit if pose == placed_at else _moved(edit, pose @ placed_at.inverse())
                self._anchors[edit.id] = node, pose
            edits.append(edit)
        has_moved = any(a is not b for a, b in zip(edits, self.edits))
        self.edits = tuple(edits)
        self.n_changes += has_moved
        return has_moved

    def show(self, grid: Occupancy) -> None:
        """Lays the edits over a grid, instead of those that it had."""
        grid.set_edits(edit_masks(self.edits, grid.resolution))


def _moved(edit: MapEdit, correction: Pose2) -> MapEdit:
    xs, ys = (correction @ np.column_stack((edit.xs, edit.ys))).T
    return replace(edit, xs=np.ascontiguousarray(xs), ys=np.ascontiguousarray(ys))
