# SPDX-License-Identifier: Apache-2.0
"""One YAML a robot, read into strict models. A service gets its own section and the robot's geometry, nothing else."""

import difflib
import logging
import pickle
from functools import lru_cache
from io import StringIO
from pathlib import Path
from typing import Any, TypeVar, get_args

from pydantic import ValidationError
from ruamel.yaml import YAML
from ruamel.yaml.comments import CommentedMap
from ruamel.yaml.error import YAMLError

from shared.robot import Drive, Laser, Mount, RangeSensor, Robot
from shared.robot_files import ROBOTS_DIR, manual_page, own_name_and_kind, robot_files
from shared.section import Section
from shared.user_error import UserError

__all__ = [
    "LASER_KEYS",
    "Drive",
    "Laser",
    "Mount",
    "RangeSensor",
    "Robot",
    "RobotFile",
    "Section",
    "UserError",
    "configured",
    "load_robot",
    "load_yaml",
    "nearest",
    "robot_path",
    "section_of",
    "yaml_value",
]  # fmt: skip

_log = logging.getLogger("zenav.config")


LASER_KEYS = ("laser", "laser_2")
"""Names of the lasers in `robot.lasers` as sections, by their places."""

T = TypeVar("T", bound=Section)


class RobotFile:
    """A robot's YAML, parsed once; `section` reads one by name and type."""

    def __init__(self, path: Path, tree: CommentedMap) -> None:
        self.path, self.tree = path, tree
        self.overridden: dict[tuple[str, ...], str] = {}  # path of a setting -> where its value comes from
        self.has_former_names = False  # of settings, in a section that was read

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
            node = section_of(node, key)
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
                self.has_former_names = True
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

    Raises UserError where there is none. What stands before an @ is the robot's own name.
    """
    _, robot = own_name_and_kind(robot)
    if robot.endswith((".yaml", ".yml")):
        path = Path(robot)
    else:
        path = next((p for p in (Path(f"{robot}.yaml"), ROBOTS_DIR / f"{robot}.yaml") if p.is_file()), Path(robot))
    if not path.is_file():
        names = tuple(sorted(robot_files()))
        raise UserError(f"there is no robot {robot}", nearest(robot, names))
    return path


def robot_source(robot: str) -> str:
    """Path and text of a robot's file; empty where it cannot be read: `load_robot` says what is wrong."""
    try:
        path = robot_path(robot)
        return f"{path}\n{path.read_text(encoding='utf-8')}"
    except (OSError, ValueError, UserError):
        return ""


def load_robot(robot: str) -> RobotFile:
    """A robot's file, by name or path. Raises UserError where it is missing or no YAML.

    `red@x80sv` is the file of x80sv with `red` for the robot's name: robots of one kind have keys of their own.
    """
    path = robot_path(robot)
    file = RobotFile(path, load_yaml(path))
    own, _ = own_name_and_kind(robot)
    if own:
        file.put(("robot", "name"), own, "--name")
    return file


def configured(robot: str, overrides: list[str]) -> RobotFile:
    """A robot's file with overrides (`section.key=value`) applied. Raises UserError."""
    file = load_robot(robot)
    for assignment in overrides:
        file.override(assignment)
    return file


def section_of(node: Any, key: str) -> Any:
    """The section of a mapping under a key, made where there is none. `laser`, `laser_2` are places in `lasers`."""
    if key in LASER_KEYS and key not in node and len(node.get("lasers") or ()) > LASER_KEYS.index(key):
        return node["lasers"][LASER_KEYS.index(key)]
    return node.setdefault(key, CommentedMap())


def yaml_value(text: str) -> Any:
    """The value of a setting from its text. Raises UserError where it is not valid YAML."""
    try:
        return YAML(typ="safe").load(text)
    except Exception:  # beside YAMLError a ValueError, as for 2001-99-99, or a RecursionError
        raise UserError(f"{text!r} is not valid YAML", "quote it") from None


def load_yaml(path: Path) -> CommentedMap:
    """A YAML file whose top level is a mapping. Raises UserError where it cannot be read."""
    try:
        tree = pickle.loads(_parsed(path.read_text(encoding="utf-8")))
    except OSError as error:
        raise UserError(f"cannot read {_short(path)}: {error.strerror}", "check the path and its permissions") from None
    except (YAMLError, ValueError, RecursionError) as error:  # no text, a month 99; thousands of open brackets
        mark = getattr(error, "problem_mark", None)
        line = f":{mark.line + 1}" if mark else ""
        raise UserError(
            f"{_short(path)}{line}: not valid YAML", getattr(error, "problem", None) or str(error).partition("\n")[0]
        ) from None
    if not isinstance(tree, CommentedMap):
        raise UserError(f"{_short(path)}: the top level is not a mapping", "write `key: value` lines")
    return tree


@lru_cache(maxsize=32)
def _parsed(text: str) -> bytes:
    """A YAML text's tree, pickled: each caller has one of its own. Parsing takes 30 times as long as unpickling."""
    return pickle.dumps(YAML(typ="rt").load(text))


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
