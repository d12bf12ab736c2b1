# SPDX-License-Identifier: Apache-2.0
"""Named places for pages: poses in m, m, rad; without yaw any heading will do."""

from math import degrees, radians

from zenav.client.named_items import folder_of
from zenav.client.places import drop, place_at, read, write_place
from zenav.maps.map_files import MAPS_FOLDER
from zenav.page.target import PageTarget, Values


def places(target: PageTarget, values: Values) -> list[Values]:
    """The places of a map; without a map, those of no map and of every map."""
    if values.get("map"):
        names = [values["map"]]
    else:
        names = ["", *sorted(path.parent.name for path in MAPS_FOLDER.glob("*/map.yaml"))]
    return [
        {"name": name, "x": place.x, "y": place.y, "yaw": _radians(place.yaw), "map": map_name}
        for map_name in names
        for name, place in read(folder_of(map_name)).items()
    ]


def set_place(target: PageTarget, values: Values) -> None:
    """Keeps a place, instead of one of the same name."""
    x, y, yaw = values["pose"]
    place = place_at(round(x, 3), round(y, 3), round(degrees(yaw) % 360, 1))
    write_place(folder_of(values.get("map", "")), values["name"], place)


def delete(target: PageTarget, values: Values) -> None:
    """Removes a place."""
    drop(folder_of(values.get("map", "")), values["name"])


def _radians(yaw: float | None) -> float | None:
    return None if yaw is None else radians(yaw)
