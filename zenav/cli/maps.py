# SPDX-License-Identifier: Apache-2.0
"""`zenav map`. Only parsing; work is imported when it is due."""

from pathlib import Path
from typing import Annotated, Literal

import typer

from zenav.cli.parts import At, Command, RobotName, SavedMapMode, Stack, group

map_ = group("Save, load and look at maps.")

SavedMap = Annotated[
    str, typer.Option("--map", help="A saved map to edit; without it: the map of the running stack, at once.")
]


@map_.command(cls=Command)
def save(
    place: Annotated[str, typer.Argument(help="Name below maps/, or a folder.")],
    force: Annotated[
        bool, typer.Option("--force", help="Overwrite another map of that name, and delete its places and zones.")
    ] = False,
    robot: RobotName = "x80sv",
    stack: Stack = "0",
) -> None:
    """Write the present map: map.pgm + map.yaml (ROS map_server), graph.msgpack to go on from, and map.png.

    Example: zenav map save office
    """
    from zenav.client.map_modes import save_map

    save_map(robot, stack, place, force)


@map_.command(cls=Command)
def load(
    place: Annotated[str, typer.Argument(help="Name below maps/, a folder, or a map's YAML.")],
    at: At = None,
    mode: SavedMapMode = "localise",
    robot: RobotName = "x80sv",
    stack: Stack = "0",
) -> None:
    """Give a saved map to the mapper, which finds the robot on it.

    Example: zenav map load office --at 2 -1 90
    """
    from shared.messages import MapMode
    from zenav.client.map_modes import load_map

    raise typer.Exit(load_map(robot, stack, place, MapMode(mode), at))


@map_.command(cls=Command)
def new(robot: RobotName = "x80sv", stack: Stack = "0") -> None:
    """Begin a new, empty map where the robot is.

    Example: zenav map new
    """
    from shared.messages import MapMode
    from zenav.client.map_modes import change_mode

    raise typer.Exit(change_mode(robot, stack, MapMode.MAP, None))


@map_.command(cls=Command)
def mode(
    mode: Annotated[Literal["map", "localise"], typer.Argument(help="Go on mapping, or leave the map as it is.")],
    at: At = None,
    robot: RobotName = "x80sv",
    stack: Stack = "0",
) -> None:
    """Go on with the present map in another mode.

    Example: zenav map mode localise
    """
    from shared.messages import MapMode
    from zenav.client.map_modes import change_mode

    raise typer.Exit(change_mode(robot, stack, MapMode.CONTINUE if mode == "map" else MapMode.LOCALISE, at))


@map_.command(cls=Command)
def show(
    place: Annotated[str, typer.Argument(help="Name, folder or YAML; without it: the map of the running stack.")] = "",
    robot: RobotName = "x80sv",
    stack: Stack = "0",
) -> None:
    """Show a map in the terminal.

    Example: zenav map show office
    """
    from zenav.client.map_view import show_map

    show_map(robot, stack, place)


@map_.command(cls=Command)
def erase(
    points: Annotated[list[str], typer.Argument(metavar="X,Y...", help="m, m on the map: corners, in order.")],
    width: Annotated[float, typer.Option(help="m, of a brush along the points; without it: all inside them.")] = 0.0,
    map_: SavedMap = "",
    robot: RobotName = "x80sv",
    stack: Stack = "0",
) -> None:
    """Erase obstacles that are not there: cells inside become free. Unknown cells stay unknown.

    Example: zenav map erase 3,-1 5,-1 5,1 3,1
    """
    from shared.messages import EditKind
    from zenav.client.map_edits import add_edit, edit_of

    add_edit(robot, stack, map_, edit_of(EditKind.ERASE, points, width))


@map_.command(cls=Command)
def wall(
    points: Annotated[
        list[str], typer.Argument(metavar="X,Y...", help="m, m on the map: a line, from point to point.")
    ],
    width: Annotated[float, typer.Option(help="m.")] = 0.1,
    map_: SavedMap = "",
    robot: RobotName = "x80sv",
    stack: Stack = "0",
) -> None:
    """Draw a virtual wall, which the robot does not cross on its way to a goal.

    Example: zenav map wall 2,0.5 2,3
    """
    from shared.messages import EditKind
    from zenav.client.map_edits import add_edit, edit_of

    add_edit(robot, stack, map_, edit_of(EditKind.WALL, points, width))


@map_.command(cls=Command)
def edits(map_: SavedMap = "", robot: RobotName = "x80sv", stack: Stack = "0") -> None:
    """List the edits: number, kind, width, points.

    Example: zenav map edits --map office
    """
    from zenav.client.map_edits import list_edits

    list_edits(robot, stack, map_)


@map_.command(cls=Command)
def undo(
    numbers: Annotated[list[int] | None, typer.Argument(help="Of the edits; without one: the last.")] = None,
    all_: Annotated[bool, typer.Option("--all", help="Every edit.")] = False,
    map_: SavedMap = "",
    robot: RobotName = "x80sv",
    stack: Stack = "0",
) -> None:
    """Remove edits: the map shows again what the laser saw.

    Example: zenav map undo 3
    """
    from zenav.client.map_edits import undo_edits

    undo_edits(robot, stack, map_, numbers or [], all_)


@map_.command("convert", cls=Command)
def map_convert(
    place: Annotated[str, typer.Argument(help="Name below maps/, a folder, or the YAML of a ROS map_server map.")],
    out: Annotated[Path, typer.Argument(help="Folder for map.yaml and its picture.")],
    mode: Annotated[
        Literal["trinary", "scale", "raw"], typer.Option(help="Free, occupied, unknown; or every percent, in two ways.")
    ] = "trinary",
    negate: Annotated[bool, typer.Option("--negate", help="White is occupied.")] = False,
    force: Annotated[bool, typer.Option("--force", help="Overwrite a map that is there.")] = False,
) -> None:
    """Bring a map of ROS map_server into a folder that `zenav map load` takes, or the stack's to map_server.

    Example: zenav map convert ros/office.yaml maps/office
    """
    from zenav.maps.conversion import convert

    convert(place, out, mode, negate, force)


@map_.command(cls=Command)
def merge(
    names: Annotated[list[str], typer.Argument(help="Saved maps of one building; the frame of the first stays.")],
    out: Annotated[str, typer.Option(help="Name below maps/, or a folder.")],
    robot: RobotName = "x80sv",
    force: Annotated[bool, typer.Option("--force", help="Overwrite a map that is there.")] = False,
) -> None:
    """Join saved maps of one building, of one robot or several, into one map with their places, zones and edits.

    Example: zenav map merge red blue --out office
    """
    from zenav.client.map_merge import merge as merge_maps

    merge_maps(names, out, robot, force)
