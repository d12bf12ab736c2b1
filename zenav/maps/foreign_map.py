# SPDX-License-Identifier: Apache-2.0
"""A map to go on with, from whatever lies in a folder: the stack's own, or one of ROS map_server."""

from pathlib import Path

from services.mapper.localization.grid_keyframes import saved_map_from_tiles
from services.mapper.maps.map_file import SavedMap
from shared.config import UserError
from zenav.maps.atomic_folder import settle
from zenav.maps.map_files import YAML, update_of
from zenav.maps.saved_map import GRAPH, read_saved_map


def read_map(place: Path, resolution: float) -> SavedMap:
    """The map of a folder with its pose graph; without one, or of a YAML, its cells with keyframes cast in them.

    resolution: m a cell, of a map that comes without a graph.  Raises UserError where there is no map, or it is
    damaged, foreign or a newer program's, or holds nothing to find a robot by.
    """
    picture = place if is_picture(place) else place / YAML
    if picture.name == YAML:
        settle(picture.parent)
    if picture is not place and ((place / GRAPH).is_file() or not picture.is_file()):
        return read_saved_map(place)
    try:
        return saved_map_from_tiles(update_of(picture), resolution)
    except UserError as error:
        raise error if str(picture) in error.what else UserError(f"{picture}: {error.what}", error.hint) from None


def is_picture(place: Path) -> bool:
    """Whether a path names the YAML of a map, and not its folder."""
    return place.suffix in (".yaml", ".yml")
