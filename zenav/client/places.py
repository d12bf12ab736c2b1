# SPDX-License-Identifier: Apache-2.0
"""Named places: poses on a map, by name, in a places.yaml beside the map or of their own.

kitchen: {x: 3.5, y: -1.2, yaw: 90}   # m, m, degrees; without yaw any heading will do
"""

import json
import sys
from math import degrees
from pathlib import Path

from pydantic import Field, ValidationError

from shared import topics
from shared.config import Section, UserError, load_robot
from shared.messages import Localization, PoseEstimate
from shared.reasons import POSE_LOST, POSE_OLD
from shared.runners.transport import stack_address
from zenav.client import Client
from zenav.client.named_items import NAME, NamedItems, folder_of
from zenav.client.navigation_client import Target, poses_from

FILE = "places.yaml"


class NamedPlace(Section):
    """A pose on a map."""

    x: float = Field(ge=-1e6, le=1e6, description="m, on the map")
    y: float = Field(ge=-1e6, le=1e6, description="m, on the map")
    yaw: float | None = Field(None, ge=-360, le=360, description="degrees, counter-clockwise; none: any heading")

    @property
    def target(self) -> Target:
        return self.x, self.y, self.yaw


def place_at(x: float, y: float, yaw: float | None) -> NamedPlace:
    """A place of these numbers. Raises UserError where they are none of a map."""
    try:
        return NamedPlace(x=x, y=y, yaw=yaw)
    except ValidationError:
        raise UserError("that is no place on a map", "give m, m, degrees within a turn") from None


PLACES = NamedItems(FILE, NamedPlace, "pose and no place", "zenav places save kitchen")
read, place, drop = PLACES.read, PLACES.item, PLACES.remove


def write_place(folder: Path, name: str, place: NamedPlace) -> bool:
    """Writes a place; True where it takes the place of one of that name. Comments in the file stay."""
    return PLACES.write(folder, name, place.model_dump())


def show_places(map_name: str, as_json: bool) -> None:
    """Every place, one a line."""
    folder = folder_of(map_name)
    places = read(folder)
    for name, target in places.items():
        row = json.dumps({"name": name, **target.model_dump()}) if as_json else f"{name:<16}{_place_text(target)}"
        sys.stdout.write(f"{row}\n")
    if not places:
        sys.stderr.write(f"no places in {folder / FILE} yet; keep one: zenav places save NAME\n")


def save_place(robot: str, stack: str, name: str, at: NamedPlace | None, map_name: str) -> None:
    """Keeps a place: the given one, or where the robot stands now."""
    folder = folder_of(map_name)
    saved = at or _here(robot, stack)
    replaced = write_place(folder, name, saved)
    sys.stdout.write(f"{name} is {_place_text(saved)}{', no longer what it was' if replaced else ''}\n")


def remove_place(name: str, map_name: str) -> None:
    """Forgets a place."""
    drop(folder_of(map_name), name)
    sys.stdout.write(f"{name} is forgotten\n")


def target_from(text: str, map_name: str) -> Target:
    """A target from `X,Y[,YAW]` or a place's name. Raises UserError."""
    name = text.strip()
    return place(folder_of(map_name), name).target if NAME.fullmatch(name) else poses_from([name])[0]


def goal_from(arguments: list[str], map_name: str) -> Target:
    """The goal of `zenav goto`: X Y [YAW], or a place's name. Raises UserError."""
    if NAME.fullmatch(arguments[0].strip()) and len(arguments) == 1:
        return target_from(arguments[0], map_name)
    hint = "write X Y or X Y YAW: m, m, degrees; or the name of a place"
    if not 2 <= len(arguments) <= 3:
        raise UserError("a goal needs 'x' and 'y', and takes 'yaw'", hint)
    numbers = []
    for axis, argument in zip(("x", "y", "yaw"), arguments, strict=False):
        try:
            numbers.append(float(argument))
        except ValueError:
            raise UserError(f"{argument.strip()!r} is no number for '{axis}'", hint) from None
    return numbers[0], numbers[1], numbers[2] if len(numbers) == 3 else None


def dwell_times(texts: list[str], dwell: float, map_name: str) -> tuple[list[Target], tuple[float, ...]]:
    """Targets of a route whose items are `X,Y[,YAW]` or names, and stays, s, where one has its own by `@SECONDS`."""
    targets, stays = [], []
    for text in texts:
        where, own, seconds = text.partition("@")
        try:
            stay = float(seconds) if own else dwell
        except ValueError:
            stay = -1.0
        if not 0 <= stay <= 1e7:
            raise UserError(f"{text.strip()!r}: {seconds!r} is no time to stay", "write s after the @, like kitchen@5")
        targets.append(target_from(where, map_name))
        stays.append(stay)
    return targets, tuple(stays) if any("@" in text for text in texts) else ()


def _here(robot: str, stack: str) -> NamedPlace:
    with Client(load_robot(robot).robot.name, stack_address(stack)) as client:
        estimate: PoseEstimate | None = client.latched_value(topics.POSE)
    if estimate is None:
        raise UserError(POSE_OLD.text, POSE_OLD.hint)
    if estimate.state is Localization.LOST:
        raise UserError(POSE_LOST.text, POSE_LOST.hint)
    pose = estimate.map_from_base
    return NamedPlace(x=round(pose.x, 3), y=round(pose.y, 3), yaw=round(degrees(pose.yaw), 1))


def _place_text(place: NamedPlace) -> str:
    heading = "" if place.yaw is None else f" {place.yaw:g}"
    return f"{place.x:g} {place.y:g}{heading}"
