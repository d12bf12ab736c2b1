# SPDX-License-Identifier: Apache-2.0
"""`zenav places`. Only parsing; work is imported when it is due."""

from typing import Annotated

import typer

from zenav.cli.parts import Command, Json, MapName, RobotName, Stack, group

places = group("Places on a map by name: zenav goto kitchen.")

PlaceName = Annotated[str, typer.Argument(help="A letter first; then letters, digits, - and _.")]


@places.command("list", cls=Command)
def list_(map_: MapName = "", as_json: Json = False) -> None:
    """List the places: name, m, m, degrees.

    Example: zenav places list --map office
    """
    from zenav.client.places import show_places

    show_places(map_, as_json)


@places.command(cls=Command)
def save(
    name: PlaceName,
    x: Annotated[float | None, typer.Argument(help="m, on the map; without it: where the robot stands.")] = None,
    y: Annotated[float | None, typer.Argument(help="m, on the map.")] = None,
    yaw: Annotated[float | None, typer.Argument(help="Degrees; without it any heading will do.")] = None,
    map_: MapName = "",
    robot: RobotName = "x80sv",
    stack: Stack = "0",
) -> None:
    """Keep a place: X Y [YAW], or where the robot stands now.

    Example: zenav places save kitchen 3.5 -1.2 90
    """
    from shared.config import UserError
    from zenav.client.places import place_at, save_place

    if x is not None and y is None:
        raise UserError("a place has two coordinates", "write X Y, or X Y YAW")
    save_place(robot, stack, name, None if x is None or y is None else place_at(x, y, yaw), map_)


@places.command(cls=Command)
def remove(name: PlaceName, map_: MapName = "") -> None:
    """Forget a place.

    Example: zenav places remove kitchen
    """
    from zenav.client.places import remove_place

    remove_place(name, map_)
