# SPDX-License-Identifier: Apache-2.0
"""`zenav zones`: keep-out and speed zones, polygons on a map, by name, in a zones.yaml beside the map or of their own.

stairs: {corners: [[3, 0], [5, 0], [5, 2]]}            # m: the robot keeps out
hall: {corners: [[0, 4], [8, 4], [8, 7]], speed: 0.3}   # m/s at most; or percent: 50, of the robot's top speed
"""

import sys
from pathlib import Path

from pydantic import ValidationError

from shared import requests, topics
from shared.config import UserError, load_robot
from shared.messages import Zone, ZoneKind
from shared.requests import SetZones
from shared.runners.transport import stack_address
from shared.zones import ZoneConfig
from zenav.client import Client
from zenav.client.named_items import NamedItems, folder_of
from zenav.client.navigation_client import poses_from, refusal_error

FILE = "zones.yaml"
ZONES = NamedItems(FILE, ZoneConfig, "zone", "zenav zones add stairs 3,0 5,0 5,2")
RUNS = 1.0  # s within which a navigator that runs is heard


def zone_of(corners: list[str], speed: float | None, percent: float | None) -> ZoneConfig:
    """A zone from corners `X,Y`. Raises UserError where they are none."""
    for corner in corners:
        if corner.count(",") != 1:
            raise UserError(f"{corner.strip()!r} is no corner", "write X,Y: m, m on the map")
    points = tuple((x, y) for x, y, _ in poses_from(corners))
    try:
        return ZoneConfig(corners=points, speed=speed, percent=percent)
    except ValidationError as errors:
        error = errors.errors()[0]
        what = error["msg"].removeprefix("Value error, ")
        if error["loc"]:
            raise UserError(
                f"{error['loc'][0]} {error['input']}: {what}", "--speed takes 0.01 to 20 m/s, --percent 1 to 100"
            ) from None
        raise UserError(what, "give three corners or more in order around it: 3,0 5,0 5,2") from None


def zones_in(folder: Path) -> tuple[Zone, ...]:
    """The zones beside a map. Raises UserError on the first that is none."""
    return tuple(config.zone(name) for name, config in ZONES.read(folder).items())


def show_zones(map_name: str) -> None:
    """Every zone of the file, one a line."""
    folder = folder_of(map_name)
    zones = zones_in(folder)
    for zone in zones:
        sys.stdout.write(f"{zone_text(zone)}\n")
    if not zones:
        sys.stderr.write(f"no zones in {folder / FILE} yet; keep one: {ZONES.example}\n")


def show_active(robot: str, stack: str) -> None:
    """Every zone that the running stack keeps, one a line."""
    with _connected(robot, stack) as client:
        _running(client)
        active = client.latched_value(topics.ZONES)
    for zone in active.zones if active is not None else ():
        sys.stdout.write(f"{zone_text(zone)}\n")
    if active is None or not active.zones:
        sys.stderr.write("no zones hold; give it those of a map: zenav zones use --map NAME\n")


def add_zone(robot: str, stack: str, name: str, zone: ZoneConfig, map_name: str) -> None:
    """Keeps a zone, and lets it hold at once where the stack runs, beside those that hold already."""
    folder = folder_of(map_name)
    values = zone.model_dump()
    replaced = ZONES.write(folder, name, {**values, "corners": [list(corner) for corner in values["corners"]]})
    sys.stdout.write(f"{zone_text(zone.zone(name))}{', no longer what it was' if replaced else ''}\n")
    _change_active(robot, stack, name, zone.zone(name))


def remove_zone(robot: str, stack: str, name: str, map_name: str) -> None:
    """Forgets a zone, also where the stack runs. The others hold on."""
    folder = folder_of(map_name)
    ZONES.remove(folder, name)
    sys.stdout.write(f"{name} is forgotten\n")
    _change_active(robot, stack, name, None)


def use_zones(robot: str, stack: str, map_name: str) -> None:
    """Lets the zones of a file hold instead of those that a person set before. Raises UserError where no stack runs."""
    zones = zones_in(folder_of(map_name))
    with _connected(robot, stack) as client:
        _running(client)
        give_zones(client, zones)
    sys.stdout.write(f"{_number(zones)} of {folder_of(map_name) / FILE}\n")


def give_zones(client: Client, zones: tuple[Zone, ...]) -> None:
    """Lets these zones hold. Raises UserError where the navigator refuses."""
    reply = client.ask(requests.SET_ZONES, SetZones(client.now(), zones))
    if not reply.accepted:
        raise refusal_error(reply)


def follow_map(client: Client, folder: Path | None) -> None:
    """Another map is in use: the zones beside it hold, and none of the map before. None: a new map has none yet."""
    zones = zones_in(folder) if folder is not None else ()
    if client.answers(requests.SET_ZONES, RUNS):
        give_zones(client, zones)
        if zones:
            sys.stderr.write(f"{_number(zones)} of {folder}\n")
    elif zones:
        sys.stderr.write(
            "the navigator does not run: no zones hold\nhint: start it, then: zenav zones use --map NAME\n"
        )


def zone_text(zone: Zone) -> str:
    """A zone for people: name, what it asks, its corners."""
    rule = "keep out"
    if zone.kind is ZoneKind.SLOW:
        rule = f"{zone.speed:g} m/s" if zone.share == 1 else f"{100 * zone.share:g} percent"
    corners = " ".join(f"{x:g},{y:g}" for x, y in zip(zone.xs.tolist(), zone.ys.tolist(), strict=True))
    return f"{zone.name:<16}{rule:<12}{corners}"


def _number(zones: tuple[Zone, ...]) -> str:
    return f"{len(zones)} zone{'' if len(zones) == 1 else 's'}"


def _change_active(robot: str, stack: str, name: str, zone: Zone | None) -> None:
    """Sets or, with None, removes one zone of a running stack.

    The others stay: they may be of a loaded map, whose file is another one.
    """
    with _connected(robot, stack) as client:
        if client.answers(requests.SET_ZONES, RUNS):
            active = client.latched_value(topics.ZONES)
            zones = {other.name: other for other in active.zones} if active is not None else {}
            zones.pop(name, None)
            give_zones(client, (*zones.values(), *([zone] if zone is not None else [])))
        else:
            sys.stderr.write("no stack runs here: it holds from the next time that its map is loaded\n")


def _running(client: Client) -> None:
    if not client.answers(requests.SET_ZONES, RUNS):
        raise UserError("the navigator does not run", "start the stack: zenav up")


def _connected(robot: str, stack: str) -> Client:
    return Client(load_robot(robot).robot.name, stack_address(stack))
