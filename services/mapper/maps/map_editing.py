# SPDX-License-Identifier: Apache-2.0
"""Requests of users that edit or name the present map, and the message that shows its name and edits."""

from dataclasses import replace

from services.mapper.slam import Slam
from shared import topics
from shared.messages import MapState, Stamp
from shared.reasons import BAD_REQUEST, BUSY, NO_MAP, OTHER_MAP, Reason
from shared.requests import EditMap, NameMap, Reply
from shared.service import Answer, Out

MAX_NAME = 200  # characters, of a map


class MapEditing:
    """Applies edits and names to the present map, and publishes them when they change."""

    def __init__(self) -> None:
        self._published: tuple[int, str, int] | None = None  # map id, name, and number of changes of the edits

    def edit(self, request: EditMap, slam: Slam, now: Stamp) -> Answer[Reply]:
        """Removes and adds edits."""
        if not slam.grid.tile_index:
            return _refusal(now, NO_MAP, "")
        if request.map_id not in (0, slam.grid.map_id):
            return _refusal(now, OTHER_MAP, "the edit was drawn on another map")
        if slam.is_drawing:
            return _refusal(now, BUSY, "the map is being redrawn")
        removed = {edit.id for edit in slam.edits.edits} if request.clear else set(request.remove)
        problem = slam.edits.change(request.add, removed, slam.grid.tile_index, slam.grid.resolution)
        if problem is not None:
            return _refusal(now, BAD_REQUEST, problem)
        _show_edits(slam)
        yield from slam.changed_tiles(now)
        yield from self.changes(slam, now)
        return Reply(now, True, "", f"{len(slam.edits.edits)} edits")

    def name(self, request: NameMap, slam: Slam, now: Stamp) -> Answer[Reply]:
        """Gives the present map a name, or none."""
        if len(request.name) > MAX_NAME:
            return _refusal(now, BAD_REQUEST, f"a name has at most {MAX_NAME} characters")
        slam.name = request.name
        yield from self.changes(slam, now)
        return Reply(now, True, "", request.name)

    def changes(self, slam: Slam, now: Stamp) -> Out:
        """Publishes name and edits if they changed. A map that never had any is not published."""
        state = slam.grid.map_id, slam.name, slam.edits.n_changes
        is_known = bool(slam.name or slam.edits.edits) or self._published is not None
        if is_known and state != self._published:
            self._published = state
            yield topics.MAP_STATE(MapState(now, slam.grid.map_id, slam.name, slam.edits.edits))


def _show_edits(slam: Slam) -> None:
    """Shows edits that have changed to everything that uses the map."""
    slam.edits.follow(slam.back_end.graph.nodes, slam.back_end.graph.poses)
    slam.back_end.edit_nodes = slam.edits.anchor_nodes
    slam.edits.show(slam.grid)
    if slam.saved is not None:
        slam.saved = replace(slam.saved, edits=slam.edits.edits)
        slam.localizer.edit(slam.saved)


def _refusal(now: Stamp, reason: Reason, detail: str) -> Reply:
    return Reply(now, False, reason.code, detail)
