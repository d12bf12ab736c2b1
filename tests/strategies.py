# SPDX-License-Identifier: Apache-2.0
"""Hypothesis strategies for any message, read from the annotations of its fields; and whether a message is valid.

    @given(messages(LaserScan))
    def test_...(scan): ...

What is drawn satisfies every field's `Within`, `Shape`, `NonZero`, and the message's own `problem()`. Keywords fix or
narrow fields: `messages(Velocity, v=st.just(0.0))`.
"""

import math
import types
from collections.abc import Callable, Iterator
from dataclasses import fields, is_dataclass
from enum import Enum
from typing import Annotated, Any, TypeVar, Union, get_args, get_origin, get_type_hints

import numpy as np
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from shared.geometry import Pose2
from shared.messages import (
    BaseOdometry,
    LaserScan,
    MapUpdate,
    Message,
    NavTask,
    NonZero,
    OtherRobots,
    RobotIntent,
    RuntimeSettings,
    Shape,
    Within,
)
from shared.requests import MIN_TOLERANCE, Navigate, SetSettings, StartMap
from shared.service import handlers
from shared.topics import TOPICS

M = TypeVar("M", bound=Message)

MAX_AXIS = 12  # entries along a named axis: enough for every branch, few enough to shrink
TUPLE_AXES = {
    (OtherRobots, "names"): "k",
    (RuntimeSettings, "names"): "settings",
    (RuntimeSettings, "values"): "settings",
    (SetSettings, "names"): "settings",
    (SetSettings, "values"): "settings",
    (NavTask, "poses"): "poses",
    (NavTask, "dwells"): "poses",
    (Navigate, "poses"): "poses",
    (Navigate, "dwells"): "poses",
}
"""Tuples that have one entry for each entry of another field, and the axis of both. What is drawn is seldom invalid."""


def messages(kind: type[M], **given: st.SearchStrategy[Any]) -> st.SearchStrategy[M]:
    """Valid messages of a class (or any dataclass of annotated fields); keywords replace fields' strategies."""
    return _dataclass(kind, given).filter(lambda message: message.problem() is None)


def publications(service: Any) -> st.SearchStrategy[tuple[str, Message | None]]:
    """Events for a service: a topic's method with a valid message, or a tick's method with None."""
    marks = handlers(type(service) if not isinstance(service, type) else service)
    heard = [st.tuples(st.just(method), _narrowed(topic.type).map(_frozen)) for topic, method in marks.topics.values()]
    ticks = [st.tuples(st.just(method), st.none()) for _, method, _ in marks.ticks]
    asked = [
        st.tuples(st.just(method), messages(request.request).map(_frozen))
        for request, method in marks.requests.values()
    ]
    return st.one_of(*heard, *ticks, *asked)


def faults(message: Any, path: str = "") -> Iterator[str]:
    """Everything about a message that its annotations forbid; nothing for a valid one."""
    path = path or type(message).__name__
    if not is_dataclass(message):
        yield f"{path} is not a message"
        return
    axes: dict[str, int] = {}
    for name, hint in get_type_hints(type(message), include_extras=True).items():
        yield from _value_faults(getattr(message, name), hint, f"{path}.{name}", axes)
    if isinstance(message, Message) and (problem := message.problem()):
        yield f"{path}: {problem}"


def _dataclass(kind: Any, given: dict[str, st.SearchStrategy[Any]]) -> st.SearchStrategy[Any]:
    hints = get_type_hints(kind, include_extras=True)
    unknown = set(given) - set(hints)
    assert not unknown, f"{kind.__name__} has no {unknown}"
    named = {axis for hint in hints.values() for axis in _axes(hint) if not axis.isdigit()}
    axes = sorted(named | {axis for (owner, _), axis in TUPLE_AXES.items() if owner is kind})
    lengths = st.fixed_dictionaries({axis: st.integers(_least(kind), MAX_AXIS) for axis in axes})

    def of_lengths(length: dict[str, int]) -> st.SearchStrategy[Any]:
        drawn = {
            f.name: given[f.name] if f.name in given else _field(kind, f.name, hints[f.name], length)
            for f in fields(kind)
        }
        return st.builds(kind, **drawn)

    return lengths.flatmap(of_lengths)


def _least(kind: Any) -> int:
    return {LaserScan: 2, Navigate: 1}.get(kind, 0)


def _field(kind: Any, name: str, hint: Any, length: dict[str, int]) -> st.SearchStrategy[Any]:
    if kind is LaserScan and name == "angle_increment":  # n beams never cover more than a full turn
        largest = 2 * math.pi / (max(length["n"], 3) - 1)
        return st.floats(1e-4, largest) | st.floats(-largest, -1e-4)
    if kind is LaserScan and name == "range_min":
        return st.floats(0, 1)
    if kind is LaserScan and name == "range_max":
        return st.floats(2, 250)
    if kind is BaseOdometry and name in ("vy", "has_pose"):  # no holonomic base; a pose or a twist
        return st.just(0.0 if name == "vy" else True)
    if kind is RobotIntent and name in ("held", "wanted"):  # held <= wanted <= n
        half = length["n"] // 2
        return st.integers(0, half) if name == "held" else st.integers(half, length["n"])
    if kind is MapUpdate and name in ("rows", "columns"):  # near enough that a dense grid holds them
        return hnp.arrays(np.int32, length["k"], elements=st.integers(-3, 3))
    if kind is Navigate and name in ("tolerance", "yaw_tolerance"):
        return st.just(0.0) | st.floats(MIN_TOLERANCE, 3)
    if kind is StartMap and name == "at":
        return st.lists(_value(get_args(_parts(hint)[0])[0], length), max_size=1).map(tuple)
    if (axis := TUPLE_AXES.get((kind, name))) is not None:
        entries = st.tuples(*[_value(get_args(_parts(hint)[0])[0], length)] * length[axis])
        return st.just(()) | entries if (kind, name) == (Navigate, "dwells") else entries
    return _value(hint, length)


def _value(hint: Any, length: dict[str, int]) -> st.SearchStrategy[Any]:
    base, notes = _parts(hint)
    within = next((n for n in notes if isinstance(n, Within)), None)
    shape = next((n for n in notes if isinstance(n, Shape)), None)
    nonzero = any(isinstance(n, NonZero) for n in notes)
    origin = get_origin(base)
    if origin is np.ndarray:
        return _array(np.dtype(get_args(get_args(base)[1])[0]), within, shape, length)
    if origin is tuple:
        return _tuple(get_args(base), length)
    if origin in (Union, types.UnionType):
        return st.one_of(*(_value(option, length) for option in get_args(base)))
    if base is type(None):
        return st.none()
    if base is Pose2:
        far = st.floats(-1e5, 1e5) | st.floats(-5, 5)
        return st.builds(Pose2, far, far, st.floats(-math.pi, math.pi, exclude_max=True))
    if isinstance(base, type) and issubclass(base, Enum):
        return st.sampled_from(list(base))
    if is_dataclass(base):
        assert isinstance(base, type)
        return messages(base) if issubclass(base, Message) else _dataclass(base, {})
    return _scalar(base, within, nonzero)


def _scalar(base: Any, within: Within | None, nonzero: bool) -> st.SearchStrategy[Any]:
    plain: dict[Any, Callable[[], st.SearchStrategy[Any]]] = {
        bool: st.booleans,
        str: lambda: st.text(st.characters(codec="utf-8"), max_size=12),
        bytes: lambda: st.binary(max_size=24),
        int: lambda: st.integers(int(within.low), int(within.high)) if within else st.integers(-(2**53), 2**53),
        float: lambda: _floats(within, 64),
    }
    drawn = plain[base]()
    return drawn.filter(lambda value: value != 0) if nonzero else drawn


def _floats(within: Within | None, width: int) -> st.SearchStrategy[float]:
    if within is None:
        return st.floats(allow_nan=False, allow_infinity=False, width=width)  # type: ignore[arg-type]  # 32 or 64
    low, high = within.low, within.high
    if width == 32:  # the nearest 32-bit numbers inside the bounds
        low, high = _inside32(low, up=True), _inside32(high, up=False)
    numbers = st.floats(low, high, width=width)  # type: ignore[arg-type]  # 32 or 64
    near = st.floats(max(low, -8.0), min(high, 8.0), width=width)  # type: ignore[arg-type]  # as above
    every = near | numbers if max(low, -8.0) < min(high, 8.0) else numbers
    every = every | st.just(math.nan) if within.nan else every
    return every | st.just(math.inf) if within.inf else every


def _inside32(bound: float, up: bool) -> float:
    nearest = np.float32(bound)
    if (up and nearest < bound) or (not up and nearest > bound):
        nearest = np.nextafter(nearest, np.float32(math.inf if up else -math.inf))
    return float(nearest)


def _array(
    dtype: np.dtype[Any], within: Within | None, shape: Shape | None, length: dict[str, int]
) -> st.SearchStrategy[Any]:
    sizes = tuple(int(a) if a.isdigit() else length[a] for a in (shape.axes.split() if shape else ["9"]))
    if dtype.kind == "f":
        elements: st.SearchStrategy[Any] = _floats(within, dtype.itemsize * 8)
    else:
        bounds = within or Within(np.iinfo(dtype).min, np.iinfo(dtype).max)
        elements = st.integers(int(bounds.low), int(bounds.high))
    fill = elements if math.prod(sizes) > 256 else st.nothing()
    return hnp.arrays(dtype, sizes, elements=elements, fill=fill)


def _tuple(arguments: tuple[Any, ...], length: dict[str, int]) -> st.SearchStrategy[Any]:
    if len(arguments) == 2 and arguments[1] is Ellipsis:
        return st.lists(_value(arguments[0], length), max_size=4).map(tuple)
    return st.tuples(*(_value(argument, length) for argument in arguments))


def _parts(hint: Any) -> tuple[Any, tuple[Any, ...]]:
    """The bare type and its notes; the outermost Annotated is flattened by typing already."""
    return (get_args(hint)[0], hint.__metadata__) if get_origin(hint) is Annotated else (hint, ())


def _axes(hint: Any) -> list[str]:
    return [axis for note in _parts(hint)[1] if isinstance(note, Shape) for axis in note.axes.split()]


def _narrowed(kind: type[M]) -> st.SearchStrategy[M]:
    """Messages whose stamps often lie within the same few seconds, so that ages and orders matter."""
    return messages(kind, stamp=st.integers(0, 4_000_000_000) | st.integers(0, 2**62))


def _frozen(message: M) -> M:
    """The same message with read-only arrays, as they arrive."""
    for f in fields(message):
        value = getattr(message, f.name)
        if isinstance(value, np.ndarray):
            value.setflags(write=False)
        elif isinstance(value, Message):
            _frozen(value)
    return message


def _value_faults(value: Any, hint: Any, path: str, axes: dict[str, int]) -> Iterator[str]:
    base, notes = _parts(hint)
    origin = get_origin(base)
    if origin is tuple:
        yield from _tuple_faults(value, get_args(base), path)
    elif origin is np.ndarray:
        dtype = np.dtype(get_args(get_args(base)[1])[0])
        if not isinstance(value, np.ndarray) or value.dtype != dtype:
            yield f"{path} is not an array of {dtype}"
            return
        yield from _shape_faults(value, notes, path, axes)
    elif is_dataclass(base):
        if type(value) is base:
            yield from faults(value, path)
        else:
            yield f"{path} is not a {base}"
    elif base is float:
        if not isinstance(value, (float, int)) or isinstance(value, (bool, np.generic)):
            yield f"{path} is {type(value).__name__}, not a plain float"
    elif type(value) is not base:
        yield f"{path} is {type(value).__name__}, not {base}"
        return
    for note in notes:
        if isinstance(note, Within):
            array = np.asarray(value)
            fits = (array >= note.low) & (array <= note.high)
            fits |= (note.nan & np.isnan(array)) | (note.inf & np.isposinf(array))
            if not np.all(fits):
                yield f"{path} = {value!r} is not within {note.low} .. {note.high}"
        if isinstance(note, NonZero) and value == 0:
            yield f"{path} is 0"
    if base is Pose2 and not (abs(value.x) <= 1e6 and abs(value.y) <= 1e6 and math.isfinite(value.yaw)):
        yield f"{path} = {value!r} is out of bounds"


def _shape_faults(value: Any, notes: tuple[Any, ...], path: str, axes: dict[str, int]) -> Iterator[str]:
    for note in notes:
        if isinstance(note, Shape):
            names = note.axes.split()
            if value.ndim != len(names):
                yield f"{path} has {value.ndim} axes, not {len(names)}"
                return
            for axis, size in zip(names, value.shape, strict=True):
                expected = int(axis) if axis.isdigit() else axes.setdefault(axis, size)
                if size != expected:
                    yield f"{path}: axis {axis} is {size}, not {expected}"


def _tuple_faults(value: Any, arguments: tuple[Any, ...], path: str) -> Iterator[str]:
    if not isinstance(value, tuple):
        yield f"{path} is not a tuple"
        return
    endless = len(arguments) == 2 and arguments[1] is Ellipsis
    kinds = [arguments[0]] * len(value) if endless else list(arguments)
    if len(kinds) != len(value):
        yield f"{path} has {len(value)} entries, not {len(kinds)}"
        return
    for i, (part, hint) in enumerate(zip(value, kinds, strict=True)):
        yield from _value_faults(part, hint, f"{path}[{i}]", {})


MESSAGES = sorted({topic.type for topic in TOPICS}, key=lambda kind: kind.__name__)
"""Every class that some topic carries."""
