# SPDX-License-Identifier: Apache-2.0
"""One YAML a robot, read into strict models. A service gets its own section and the robot's geometry, nothing else."""

import difflib
import logging
from io import StringIO
from math import cos, hypot, pi
from pathlib import Path
from typing import Any, ClassVar, TypeVar, get_args

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field, ValidationError, model_validator
from ruamel.yaml import YAML
from ruamel.yaml.comments import CommentedMap
from ruamel.yaml.error import YAMLError

from shared.polygon import signed_area, signed_distances
from shared.robot_files import ROBOTS_DIR, manual_page, robot_files

CIRCLE_CORNERS = 32  # of the polygon around a round robot: it reaches 0.5 % beyond the circle

_log = logging.getLogger("zenav.config")


class UserError(Exception):
    """Something that the user can fix: shown as one line and a `hint:`, never as a traceback."""

    def __init__(self, what: str, hint: str) -> None:
        super().__init__(what)
        self.what, self.hint = what, hint


class Section(BaseModel):
    """Base of every configuration model: unknown keys are errors, values never change."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)

    RENAMED: ClassVar[dict[str, str]] = {}
    """Former name of a setting: its present name. Robot files and recordings may use either, not both."""

    @model_validator(mode="before")
    @classmethod
    def _rename_settings(cls, values: Any) -> Any:
        """The values under the present names of the settings. Raises ValueError where both names are given."""
        if not isinstance(values, dict) or not cls.RENAMED.keys() & values.keys():
            return values
        for old, new in cls.RENAMED.items():
            if old in values and new in values:
                raise ValueError(f"`{old}` and `{new}` name one setting: give `{new}` only")
        return {cls.RENAMED.get(name, name): value for name, value in values.items()}


class Mount(Section):
    """Where a sensor sits on the robot: `base_from_sensor`."""

    x: float = Field(0.0, ge=-5, le=5, description="m ahead of the wheel axis")
    y: float = Field(0.0, ge=-5, le=5, description="m to the left of the centre line")
    yaw: float = Field(0.0, ge=-2 * pi, le=2 * pi, description="rad, counter-clockwise")


class Drive(Section):
    """The differential drive."""

    wheel_radius: float = Field(gt=0, le=1, description="m, mean of both")
    wheel_radius_ratio: float = Field(1.0, ge=0.8, le=1.25, description="right wheel's radius over the left one's")
    wheel_distance: float = Field(
        gt=0, le=3, description="m between the wheels' contact points, as it acts when turning"
    )
    counts_per_turn: int = Field(gt=0, description="encoder counts a turn of the wheel")
    encoder_wrap: int = Field(gt=0, description="encoder counts at which the counter returns to 0")
    motor_direction: int = Field(1, ge=-1, le=1, description="+1 or -1: sign of both motors, the document's motorDir")
    max_speed: float = Field(gt=0, le=10, description="m/s forward")
    max_reverse_speed: float = Field(0.0, ge=0, le=10, description="m/s backward; 0 forbids reversing")
    max_turn_rate: float = Field(gt=0, le=20, description="rad/s")
    max_acceleration: float = Field(gt=0, le=20, description="m/s^2")
    max_braking: float = Field(gt=0, le=20, description="m/s^2 that the base really reaches")
    max_turn_acceleration: float = Field(gt=0, le=100, description="rad/s^2")
    min_turning_radius: float = Field(0.0, ge=0, le=20, description="m: of the tightest arc that it drives; 0: any")
    turns_in_place: bool = Field(True, description="it may turn on the spot; if not, give min_turning_radius")

    @model_validator(mode="after")
    def _drivable(self) -> "Drive":
        if self.motor_direction == 0:
            raise ValueError("motor_direction is +1 or -1")
        if not self.turns_in_place and self.min_turning_radius < 0.05:
            raise ValueError("a robot that may not turn on the spot needs a min_turning_radius of 0.05 m at least")
        return self

    @property
    def left_radius(self) -> float:
        """m; the two have `wheel_radius` as their mean: Borenstein and Feng 1996, equations 13 and 14."""
        return 2 * self.wheel_radius / (1 + self.wheel_radius_ratio)

    @property
    def right_radius(self) -> float:
        """m"""
        return self.left_radius * self.wheel_radius_ratio

    def clamped(self, v: float, w: float) -> tuple[float, float]:
        """The velocity (m/s, rad/s) scaled down, on its own arc, until it is within the limits.

        An arc tighter than the robot's is opened to that.
        """
        limit = self.max_speed if v >= 0 else self.max_reverse_speed
        w = self.bent(v, w)
        share = min(1.0, limit / abs(v) if v else 1.0, self.max_turn_rate / abs(w) if w else 1.0)
        return v * share, w * share

    def bent(self, v: float, w: float) -> float:
        """The turn rate, rad/s, that is nearest to w at a speed of v m/s and on an arc that the robot drives."""
        if not self.min_turning_radius or (v == 0 and self.turns_in_place):
            return w
        max_turn_rate = abs(v) / self.min_turning_radius
        return min(max(w, -max_turn_rate), max_turn_rate)


class Laser(Section):
    """The laser: its mount and its sweep, in its own frame."""

    mount: Mount = Mount()
    angle_min: float = Field(ge=-2 * pi, le=2 * pi, description="rad, first beam")
    angle_increment: float = Field(ge=-pi, le=pi, description="rad between beams; negative: clockwise")
    n_beams: int = Field(ge=2, le=20000, description="beams a sweep")
    scan_time: float = Field(ge=0, le=2, description="s from the first to the last beam")
    rate: float = Field(gt=0, le=200, description="sweeps a second")
    range_min: float = Field(ge=0, description="m; nearer is no measurement")
    range_max: float = Field(gt=0, le=250, description="m; farther is no echo")


class RangeSensor(Section):
    """One ultrasonic or infrared sensor."""

    kind: str = Field(pattern="^(ultrasonic|infrared)$", description="ultrasonic or infrared")
    mount: Mount
    field_of_view: float = Field(gt=0, le=2 * pi, description="rad, whole cone")
    range_min: float = Field(ge=0, description="m")
    range_max: float = Field(gt=0, description="m")


class Robot(Section):
    """The robot's hardware. Every service may read it."""

    name: str = Field(pattern="^[a-z][a-z0-9_]*$", description="first part of every key")
    footprint: tuple[tuple[float, float], ...] = Field(
        (), description="m, corners in `base`, counter-clockwise, three at least; or give `radius`"
    )
    radius: float | None = Field(None, gt=0, le=5, description="m: of a round robot about `base`; or give `footprint`")
    drive: Drive
    laser: Laser
    ranges: tuple[RangeSensor, ...] = Field((), description="ultrasonic and infrared sensors, in the board's order")

    @model_validator(mode="after")
    def _around_the_origin(self) -> "Robot":
        if bool(self.footprint) == (self.radius is not None):
            raise ValueError("give either footprint, as corners, or radius")
        if self.radius is None and len(self.footprint) < 3:
            raise ValueError("footprint: three corners at least")
        corners = self.corners
        if signed_area(corners) <= 0:
            raise ValueError("footprint: corners must run counter-clockwise and enclose an area")
        if not np.all(np.hypot(*(np.roll(corners, -1, axis=0) - corners).T) > 1e-6):
            raise ValueError("footprint: a corner repeats its neighbour; the outline closes by itself")
        if self.inscribed_radius <= 0:
            raise ValueError("footprint: the origin of `base` must lie inside")
        return self

    @property
    def corners(self) -> NDArray[np.float64]:
        """(n, 2) m, in `base`, counter-clockwise; of a round robot, the regular polygon around the circle."""
        if self.radius is None:
            return np.array(self.footprint, float)
        angles = 2 * pi * (np.arange(CIRCLE_CORNERS) + 0.5) / CIRCLE_CORNERS
        return self.radius / cos(pi / CIRCLE_CORNERS) * np.column_stack((np.cos(angles), np.sin(angles)))

    @property
    def inscribed_radius(self) -> float:
        """m: the largest circle about `base` inside the footprint (negative when base lies outside)."""
        return -float(signed_distances(self.corners, np.zeros((1, 2)))[0])

    @property
    def circumscribed_radius(self) -> float:
        """m: the smallest circle about `base` around the footprint."""
        return max(hypot(x, y) for x, y in self.corners.tolist())


T = TypeVar("T", bound=Section)


class RobotFile:
    """A robot's YAML, parsed once; `section` reads one by name and type."""

    def __init__(self, path: Path, tree: CommentedMap) -> None:
        self.path, self.tree = path, tree
        self.overridden: dict[tuple[str, ...], str] = {}  # path of a setting -> where its value comes from

    def section(self, name: str, model: type[T]) -> T:
        """The section `name` as `model`; a missing one is the model's defaults. Raises UserError on the first fault."""
        values = self.tree.get(name)
        if values is None:
            values = CommentedMap()
        if not isinstance(values, dict):
            raise UserError(
                f"{self.place((name,))}: {name} is not a section", f"write `{name}:` and its settings below"
            )
        self._warn_of_renamed((name,), model, values)
        try:
            return model.model_validate(_plain(values))
        except ValidationError as errors:
            raise self._validation_error((name,), model, errors) from None

    def whole(self, model: type[T]) -> T:
        """The whole file as one `model`, for files without sections. Raises UserError on the first fault."""
        self._warn_of_renamed((), model, self.tree)
        try:
            return model.model_validate(_plain(self.tree))
        except ValidationError as errors:
            raise self._validation_error((), model, errors) from None

    def override(self, assignment: str) -> None:
        """Sets one value from `section.key=value`, the value as YAML. Raises UserError where it does not read so."""
        path, equals, text = assignment.partition("=")
        keys = path.strip().split(".")
        if not equals or len(keys) < 2 or not all(keys):
            raise UserError(f"{assignment!r} sets nothing", "write section.key=value, like sim.world=office")
        self.put(tuple(keys), yaml_value(text), "--set")

    def put(self, keys: tuple[str, ...], value: Any, origin: str) -> None:
        """Sets one value by its path. origin: where it comes from, in place of `file:line`. Raises UserError."""
        node = self.tree
        for key in keys[:-1]:
            node = node.setdefault(key, CommentedMap())
            if not isinstance(node, dict):
                raise UserError(f"{'.'.join(keys)}: {key} is not a section", "name a setting: zenav config show")
        node[keys[-1]] = value
        self.overridden[keys] = origin

    @property
    def text(self) -> str:
        """The file as YAML, with what was overridden."""
        stream = StringIO()
        YAML(typ="rt").dump(self.tree, stream)
        return stream.getvalue()

    @property
    def robot(self) -> Robot:
        """The `robot` section."""
        return self.section("robot", Robot)

    def unknown_sections(self, names: tuple[str, ...]) -> None:
        """Raises UserError where the file has a section outside `names`."""
        for name in self.tree:
            if name not in names:
                raise UserError(f"{self.place((name,))}: {name} is not a section", nearest(str(name), names))

    def place(self, location: tuple[Any, ...]) -> str:
        """`file:line` of a key given as its path in the tree; the origin, as `--set`, where it was overridden."""
        for path, origin in self.overridden.items():
            if location[: len(path)] == path:
                return origin
        node, line = self.tree, 0
        for key in location:
            try:
                line = node.lc.key(key)[0] if isinstance(node, CommentedMap) else node.lc.item(key)[0]
                node = node[key]
            except (KeyError, IndexError, AttributeError, TypeError):
                break
        return f"{_short(self.path)}:{line + 1}"

    def _warn_of_renamed(self, location: tuple[Any, ...], model: Any, values: Any) -> None:
        """Logs a warning for each setting at or below `location` that has its former name, with the present one."""
        if isinstance(values, list):
            for i, value in enumerate(values):
                self._warn_of_renamed((*location, i), model, value)
            return
        if not isinstance(values, dict):
            return
        renamed = getattr(model, "RENAMED", {})
        for key, value in values.items():
            here, name = (*location, key), renamed.get(key, key)
            if name != key:
                _log.warning("%s: %s is now `%s`", self.place(here), ".".join(map(str, here)), name)
            field = getattr(model, "model_fields", {}).get(name)
            if field is not None:
                self._warn_of_renamed(here, _item_type(field.annotation), value)

    def _validation_error(self, above: tuple[str, ...], model: type[Section], errors: ValidationError) -> UserError:
        # a mistyped name of a setting that must be there is two errors: the name is the one that helps
        error = min(errors.errors(), key=lambda e: e["type"] != "extra_forbidden")
        location = (*above, *error["loc"])
        key = ".".join(str(part) for part in location)
        if error["type"] == "extra_forbidden":
            fields = _fields_at(model, error["loc"][:-1])
            return UserError(f"{self.place(location)}: {key} is not a setting", nearest(str(error["loc"][-1]), fields))
        wrong = "" if isinstance(error["input"], dict) else f" (it is {error['input']!r})"  # a section is no value
        hint = _description_at(model, error["loc"]) or f"see {manual_page('configuration.md')}"
        return UserError(f"{self.place(location)}: {key}: {error['msg'][:1].lower()}{error['msg'][1:]}{wrong}", hint)


def robot_path(robot: str) -> Path:
    """The file of a robot given as a path, or by name (`x80sv`): NAME.yaml in the current folder, else a built-in one.

    Raises UserError where there is none.
    """
    if robot.endswith((".yaml", ".yml")):
        path = Path(robot)
    else:
        path = next((p for p in (Path(f"{robot}.yaml"), ROBOTS_DIR / f"{robot}.yaml") if p.is_file()), Path(robot))
    if not path.is_file():
        names = tuple(sorted(robot_files()))
        raise UserError(f"there is no robot {robot}", nearest(robot, names))
    return path


def load_robot(robot: str) -> RobotFile:
    """A robot's file, by name or path. Raises UserError where it is missing or no YAML."""
    path = robot_path(robot)
    return RobotFile(path, load_yaml(path))


def configured(robot: str, overrides: list[str]) -> RobotFile:
    """A robot's file with overrides (`section.key=value`) applied. Raises UserError."""
    file = load_robot(robot)
    for assignment in overrides:
        file.override(assignment)
    return file


def yaml_value(text: str) -> Any:
    """The value of a setting from its text. Raises UserError where it is not valid YAML."""
    try:
        return YAML(typ="safe").load(text)
    except Exception:  # beside YAMLError a ValueError, as for 2001-99-99, or a RecursionError
        raise UserError(f"{text!r} is not valid YAML", "quote it") from None


def load_yaml(path: Path) -> CommentedMap:
    """A YAML file whose top level is a mapping. Raises UserError where it cannot be read."""
    try:
        tree = YAML(typ="rt").load(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise UserError(f"cannot read {_short(path)}: {error.strerror}", "check the path and its permissions") from None
    except (YAMLError, UnicodeDecodeError, RecursionError) as error:  # the last: thousands of open brackets
        mark = getattr(error, "problem_mark", None)
        line = f":{mark.line + 1}" if mark else ""
        raise UserError(
            f"{_short(path)}{line}: not valid YAML", getattr(error, "problem", None) or "check this line"
        ) from None
    if not isinstance(tree, CommentedMap):
        raise UserError(f"{_short(path)}: the top level is not a mapping", "write `key: value` lines")
    return tree


def nearest(wrong: str, valid: tuple[str, ...]) -> str:
    """A hint that names the valid word nearest to a wrong one."""
    close = difflib.get_close_matches(wrong, valid, n=1, cutoff=0.5)
    return f"did you mean `{close[0]}`?" if close else f"known: {', '.join(valid) or 'nothing'}"


def _plain(node: Any) -> Any:
    if isinstance(node, dict):
        return {str(key): _plain(value) for key, value in node.items()}
    return [_plain(value) for value in node] if isinstance(node, list) else node


def _short(path: Path) -> str:
    try:
        return str(path.resolve().relative_to(Path.cwd()))
    except ValueError:
        return str(path)


def _fields_at(model: Any, location: tuple[Any, ...]) -> tuple[str, ...]:
    for part in location:
        field = getattr(model, "model_fields", {}).get(part)
        if field is not None:
            model = _item_type(field.annotation)
    return tuple(getattr(model, "model_fields", {}))


def _description_at(model: Any, location: tuple[Any, ...]) -> str:
    text = ""
    for part in location:
        field = getattr(model, "model_fields", {}).get(part)
        if field is None:
            continue
        text, model = field.description or "", _item_type(field.annotation)
    return text


def _item_type(annotation: Any) -> Any:
    """The model inside `tuple[Model, ...]` or `Model | None`; the annotation itself where there is none inside."""
    return next((a for a in get_args(annotation) if hasattr(a, "model_fields")), annotation)
