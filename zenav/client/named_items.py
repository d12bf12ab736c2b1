# SPDX-License-Identifier: Apache-2.0
"""What has a name on a map, in a YAML file beside it: `name: {settings}`, made to be written by hand too."""

import re
from dataclasses import dataclass
from io import StringIO
from pathlib import Path
from typing import Any, Generic, TypeVar

from ruamel.yaml import YAML
from ruamel.yaml.comments import CommentedMap

from shared.config import RobotFile, Section, UserError, load_yaml, nearest
from zenav.maps.atomic_folder import replace_together
from zenav.maps.map_files import MAPS_FOLDER, find_map

NAME = re.compile(r"[^\W\d][\w-]*")

T = TypeVar("T", bound=Section)


def folder_of(map_name: str) -> Path:
    """Where what belongs to a saved map is; without a name, what is of no particular map. Raises UserError."""
    return find_map(map_name).parent if map_name else MAPS_FOLDER


@dataclass(frozen=True, slots=True)
class NamedItems(Generic[T]):
    """One kind of it. word: what one is called; example: the command that keeps one."""

    file: str
    model: type[T]
    word: str
    example: str

    def read(self, folder: Path) -> dict[str, T]:
        """All by name, in the file's order. Raises UserError on the first that is none."""
        return {str(name): file.section(str(name), self.model) for file in self._file(folder) for name in file.tree}

    def item(self, folder: Path, name: str) -> T:
        """One of them. Raises UserError that names the nearest."""
        items = self.read(folder)
        if name not in items:
            hint = nearest(name, tuple(items)) if items else f"keep one: {self.example}"
            raise UserError(f"{name!r} is no {self.word} in {folder / self.file}", hint)
        return items[name]

    def write(self, folder: Path, name: str, values: dict[str, Any]) -> bool:
        """Writes one; True where it takes the place of one of that name. Comments in the file stay."""
        if not NAME.fullmatch(name):
            raise UserError(
                f"{name!r} is no name for a {self.word.split()[-1]}",
                "begin with a letter; then letters, digits, - and _",
            )
        tree = next((file.tree for file in self._file(folder)), CommentedMap())
        replaced = name in tree
        tree[name] = _in_one_line(values)
        self._write(folder, tree)
        return replaced

    def replace(self, folder: Path, entries: dict[str, dict[str, Any]]) -> None:
        """Writes these instead of all that the file has; without any there is no file."""
        if not entries:
            (folder / self.file).unlink(missing_ok=True)
            return
        self._write(folder, CommentedMap((name, _in_one_line(values)) for name, values in entries.items()))

    def remove(self, folder: Path, name: str) -> None:
        """Takes one out of the file. Raises UserError where there is none of that name."""
        self.item(folder, name)
        tree = next(file.tree for file in self._file(folder))
        del tree[name]
        self._write(folder, tree)

    def _file(self, folder: Path) -> list[RobotFile]:
        """The file, if there is one with anything in it."""
        path = folder / self.file
        return [RobotFile(path, load_yaml(path))] if path.is_file() and path.read_bytes().strip() else []

    def _write(self, folder: Path, tree: CommentedMap) -> None:
        stream = StringIO()
        YAML(typ="rt").dump(tree, stream)
        replace_together(folder, {self.file: stream.getvalue().encode()})


def _in_one_line(values: dict[str, Any]) -> CommentedMap:
    """An item's settings that have a value, as `{a: 1, b: 2}`."""
    entry = CommentedMap((key, value) for key, value in values.items() if value is not None)
    entry.fa.set_flow_style()
    return entry
