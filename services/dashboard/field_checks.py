# SPDX-License-Identifier: Apache-2.0
"""Checks of values that a browser sent: type, bounds and length. A check raises FrameError, and nothing else."""

import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from math import isfinite
from typing import Any

Check = Callable[[Any], Any]
"""Returns the value, or raises FrameError."""

MAX_INTEGER = 2**53  # a browser's numbers are exact up to here
MAX_ID = 64  # characters
MAX_COORDINATE_M = 1e6
MAX_YAW_RAD = 10.0
ITEM_NAME = re.compile(r"[^\W\d][\w-]{0,63}")
RECORDING_NAME = re.compile(r"[\w][\w.-]{0,127}\.mcap")


class FrameError(ValueError):
    """What a browser sent cannot be used; the text says why, for users."""


@dataclass(frozen=True, slots=True)
class Fields:
    """The fields of a frame, or of an operation's arguments, with their checks."""

    required: Mapping[str, Check] = field(default_factory=dict)
    optional: Mapping[str, Check] = field(default_factory=dict)

    def checked(self, values: Mapping[Any, Any], name: str) -> dict[str, Any]:
        """The values, checked; an optional one that is missing is missing. Raises FrameError."""
        missing = next((key for key in self.required if key not in values), None)
        if missing is not None:
            raise FrameError(f"{name}: {missing} is missing")
        result = {}
        for key, value in values.items():
            check = self.required.get(key) or self.optional.get(key)
            if check is None:
                raise FrameError(f"{name}: {str(key)[:MAX_ID]!r} is not a field of it")
            try:
                result[key] = check(value)
            except FrameError as error:
                raise FrameError(f"{name}: {key} {error}") from None
        return result


def number(low: float, high: float) -> Check:
    """A finite number within bounds, both inclusive."""

    def check(value: Any) -> float:
        if type(value) not in (int, float) or not isfinite(value):
            raise FrameError("is not a finite number")
        if not low <= value <= high:
            raise FrameError(f"is not within {low:g} .. {high:g}")
        return float(value)

    return check


def whole_number(value: Any) -> int:
    """A whole number from 0 on that a browser can hold."""
    if type(value) is not int or not 0 <= value <= MAX_INTEGER:
        raise FrameError("is not a whole number from 0 on")
    return value


def boolean(value: Any) -> bool:
    """True or false."""
    if type(value) is not bool:
        raise FrameError("is not a boolean")
    return value


def text(most: int) -> Check:
    """A text of at most so many characters, all printable."""

    def check(value: Any) -> str:
        if type(value) is not str or len(value) > most or not value.isprintable():
            raise FrameError(f"is not a text of at most {most} printable characters")
        return value

    return check


def matching(pattern: re.Pattern[str], what: str) -> Check:
    """A text that the whole pattern matches."""

    def check(value: Any) -> str:
        if type(value) is not str or not pattern.fullmatch(value):
            raise FrameError(f"is not {what}")
        return value

    return check


def one_of(*words: str) -> Check:
    """One of these words."""

    def check(value: Any) -> str:
        if type(value) is not str or value not in words:
            raise FrameError(f"is not one of {', '.join(words)}")
        return value

    return check


def identifier(value: Any) -> int | str:
    """A frame's `id`, which its reply repeats."""
    if type(value) is str and len(value) <= MAX_ID:
        return value
    return whole_number(value)


def mapping(value: Any) -> dict[Any, Any]:
    """A map."""
    if type(value) is not dict:
        raise FrameError("is not a map")
    return value


def texts(most: int) -> Check:
    """A list of at most so many short texts."""

    def check(value: Any) -> list[str]:
        if type(value) is not list or len(value) > most:
            raise FrameError(f"is not a list of at most {most} texts")
        return [text(MAX_ID)(item) for item in value]

    return check


def pose(value: Any) -> list[float]:
    """[x, y, yaw] in `map`: m, m, rad."""
    if type(value) is not list or len(value) != 3:
        raise FrameError("is not [x, y, yaw]")
    coordinate, angle = number(-MAX_COORDINATE_M, MAX_COORDINATE_M), number(-MAX_YAW_RAD, MAX_YAW_RAD)
    return [coordinate(value[0]), coordinate(value[1]), angle(value[2])]


item_name = matching(ITEM_NAME, "a name: begin with a letter; then letters, digits, - and _")
recording_name = matching(RECORDING_NAME, "the name of a recording")
