# SPDX-License-Identifier: Apache-2.0
"""Messages to msgpack and back, validated from the annotations of messages.py at the boundary.

On the wire: a msgpack map of the fields, and under "@" the envelope [publisher, session, sequence, sent]. An array is
one bin: 16 bytes of header (dtype, axes, three lengths), then its little-endian bytes; it decodes to a read-only view.
Unknown fields are ignored, so that messages can grow (shared/unknown_fields.py names them).
"""

import struct
import sys
from collections.abc import Callable
from dataclasses import MISSING, fields, replace
from enum import StrEnum
from functools import cache
from math import inf, isfinite, isnan, nan, prod
from typing import Any, NamedTuple, TypeVar, cast, get_args, get_origin, get_type_hints

import msgpack
import numpy as np

from shared.geometry import Pose2
from shared.messages import Message, NonZero, Shape, Unit, Within

M = TypeVar("M", bound=Message)
F = TypeVar("F", bound=Callable[..., Any])

_HEADER = struct.Struct("<BBxxIII")
DTYPES: dict[int, np.dtype[Any]] = {
    0: np.dtype("<f4"),
    1: np.dtype("<f8"),
    2: np.dtype("i1"),
    3: np.dtype("u1"),
    4: np.dtype("<i4"),
}
_CODES = {dtype: code for code, dtype in DTYPES.items()}
MAX_COORDINATE, MAX_YAW = 1e6, 1000  # m, rad: a pose farther out is a fault of its sender
MAX_NUMBER = sys.float_info.max
FEW = 16  # numbers of an array, up to which Python checks them faster than numpy


class CodecError(ValueError):
    """The bytes are not a valid message of this type; the text says which field and why."""


class Envelope(NamedTuple):
    """Sender and send time of a message: `sent` ns on the stack's clock, `sequence` from 0 per key and session."""

    publisher: str
    session: str
    sequence: int
    sent: int


Check = Callable[[Any], Any]
Axes = tuple[int | str, ...]
"""Of each axis its length, or the name that it has in common with other axes of the message."""


def once_per_class(function: F) -> F:
    """functools.cache with a type that accepts dataclass classes as arguments."""
    return cast(F, cache(function))


class Field(NamedTuple):
    """A declared field: its plain type and its annotations."""

    name: str
    kind: Any
    unit: str
    within: Within | None
    shape: Shape | None
    nonzero: bool
    default: Any

    @property
    def required(self) -> bool:
        return self.default is MISSING


@once_per_class
def fields_of(type_: type[Any]) -> tuple[Field, ...]:
    """The declared fields of a message class, in order."""
    hints = get_type_hints(type_, include_extras=True)
    declared = []
    for field in fields(type_):
        hint = hints[field.name]
        marks: tuple[Any, ...] = getattr(hint, "__metadata__", ())
        kind = get_args(hint)[0] if marks else hint

        def mark(wanted: type[Any], marks: tuple[Any, ...] = marks) -> Any:
            return next((m for m in reversed(marks) if isinstance(m, wanted)), None)

        unit = mark(Unit)
        default = field.default if field.default_factory is MISSING else field.default_factory()
        declared.append(
            Field(
                name=field.name,
                kind=kind,
                unit=unit.name if unit else "",
                within=mark(Within),
                shape=mark(Shape),
                nonzero=mark(NonZero) is not None,
                default=default,
            )
        )
    return tuple(declared)


def encode(message: Message, envelope: Envelope) -> bytes:
    """The message as bytes. Raises TypeError, ValueError or AttributeError where a field has a wrong type."""
    tree = {"@": (envelope.publisher, envelope.session, envelope.sequence, envelope.sent)}
    for name, pack, optional in _packers(type(message)):
        value = getattr(message, name)
        if not optional or len(value):
            tree[name] = value if pack is None else pack(value)
    return bytes(msgpack.packb(tree))


def decode(type_: type[M], payload: bytes) -> tuple[M, Envelope]:
    """The message and its envelope. Raises CodecError, never anything else, whatever the bytes."""
    tree = _tree(payload)
    return _checked(type_, tree), _envelope(tree.pop("@", None))


def envelope_of(payload: bytes) -> Envelope:
    """The envelope alone, of a message of any type. Raises CodecError."""
    return _envelope(_tree(payload).get("@"))


def _tree(payload: bytes) -> dict[str, Any]:
    try:
        tree = msgpack.unpackb(payload)
    except Exception as error:  # msgpack raises a dozen kinds on foreign bytes: all mean the same here
        raise CodecError(f"not msgpack: {type(error).__name__}") from None
    if type(tree) is not dict:
        raise CodecError("not a map")
    return tree


def _envelope(value: Any) -> Envelope:
    if type(value) is not list or len(value) != 4:
        raise CodecError("no envelope")
    publisher, session, sequence, sent = value
    if not (type(publisher) is str and type(session) is str and type(sequence) is int and type(sent) is int):
        raise CodecError("the envelope is not [publisher, session, sequence, sent]")
    return Envelope(publisher, session, sequence, sent)


def _checked(type_: type[M], tree: dict[str, Any]) -> M:
    values = []
    lengths: dict[str, int] = {}
    for name, default, axes, check in _checkers(type_):
        value = tree.get(name, MISSING)
        if value is MISSING:
            if default is MISSING:
                raise CodecError(f"{name}: missing")
            values.append(default)
            continue
        try:
            value = check(value)
        except CodecError as error:
            raise CodecError(f"{name}: {error}") from None
        if axes:
            _check_shape(name, axes, value, lengths)
        values.append(value)
    message = type_(*values)
    problem = message.problem()
    if problem is not None:
        raise CodecError(problem)
    return message


def _check_shape(name: str, axes: Axes, array: Any, lengths: dict[str, int]) -> None:
    if array.ndim != len(axes):
        raise CodecError(f"{name}: {array.ndim} axes, not {len(axes)}")
    for axis, length in zip(axes, array.shape):
        expected = lengths.setdefault(axis, length) if type(axis) is str else axis
        if length != expected:
            raise CodecError(f"{name}: {length} long, not {expected}")


@once_per_class
def _packers(type_: type[Message]) -> tuple[tuple[str, Callable[[Any], Any] | None, bool], ...]:
    """Name, packer, and whether it may be left out: an array with a default is not sent while it is empty."""
    return tuple(
        (f.name, _packer(f.kind), get_origin(f.kind) is np.ndarray and not f.required) for f in fields_of(type_)
    )


def _packer(kind: Any) -> Callable[[Any], Any] | None:
    """How a value goes into the msgpack tree; None: as it is."""
    if get_origin(kind) is np.ndarray:
        dtype = wire_dtype(kind)
        return lambda array: packed_array(array, dtype)
    if kind is Pose2:
        return lambda pose: (float(pose.x), float(pose.y), float(pose.yaw))
    if kind is float:
        return float
    if kind is int:
        return int
    if kind is bool:
        return bool
    if get_origin(kind) is tuple:
        inner = get_args(kind)
        if inner[-1] is Ellipsis:
            pack = _packer(plain_kind(inner[0]))
            return None if pack is None else lambda values: tuple(pack(v) for v in values)
        packs = [_packer(plain_kind(k)) for k in inner]
        return lambda values: tuple(v if p is None else p(v) for p, v in zip(packs, values, strict=True))
    if isinstance(kind, type) and issubclass(kind, Message):
        packers = _packers(kind)
        return lambda m: {n: getattr(m, n) if p is None else p(getattr(m, n)) for n, p, _ in packers}
    return None


def wire_dtype(kind: Any) -> np.dtype[Any]:
    """The dtype of an NDArray[...] on the wire: little-endian."""
    _, dtype = get_args(kind)
    (scalar,) = get_args(dtype)
    return cast(np.dtype[Any], np.dtype(scalar).newbyteorder("<"))


def packed_array(array: Any, dtype: np.dtype[Any]) -> bytes:
    """An array as it is on the wire. dtype: of `wire_dtype`."""
    array = np.ascontiguousarray(array, dtype)
    shape = (*array.shape, 0, 0)[:3]
    return bytes(_HEADER.pack(_CODES[dtype], array.ndim, *shape) + array.tobytes())


@once_per_class
def _checkers(type_: type[Message]) -> tuple[tuple[str, Any, Axes, Check], ...]:
    """Name, default, axes and checker of each field."""
    return tuple((f.name, f.default, _axes(f.shape), _checker(f.kind, f.within, f.nonzero)) for f in fields_of(type_))


def _axes(shape: Shape | None) -> Axes:
    return tuple(int(axis) if axis.isdigit() else axis for axis in shape.axes.split()) if shape else ()


def plain_kind(kind: Any) -> Any:
    return get_args(kind)[0] if hasattr(kind, "__metadata__") else kind


def _checker(kind: Any, within: Within | None, nonzero: bool) -> Check:
    """Turns a decoded msgpack value into the field's value, or raises CodecError."""
    if get_origin(kind) is np.ndarray:
        dtype = wire_dtype(kind)
        code, rounded = _CODES[dtype], _rounded(within, dtype)
        return lambda value: _array(value, dtype, code, rounded)
    if kind is Pose2:
        return _pose
    if kind is float:
        return _number_checker(within, nonzero)
    if kind is int:
        return lambda value: _integer(value, within)
    if get_origin(kind) is tuple:
        return _tuple_checker(get_args(kind))
    if isinstance(kind, type) and issubclass(kind, StrEnum):
        return lambda value: _enum(kind, value)
    if isinstance(kind, type) and issubclass(kind, Message):
        return lambda value: _nested(kind, value)
    return lambda value: _exactly(kind, value)


def _nested(kind: type[Message], value: Any) -> Message:
    if type(value) is not dict:
        raise CodecError("not a map")
    return _checked(kind, value)


def _tuple_checker(inner: tuple[Any, ...]) -> Check:
    if inner[-1] is Ellipsis:
        item = _item_checker(inner[0])
        return lambda value: tuple(item(v) for v in _list(value))
    items = [_item_checker(k) for k in inner]

    def fixed(value: Any) -> tuple[Any, ...]:
        if len(_list(value)) != len(items):
            raise CodecError(f"{len(value)} items, not {len(items)}")
        return tuple(check(v) for check, v in zip(items, value))

    return fixed


def _item_checker(kind: Any) -> Check:
    marks: tuple[Any, ...] = getattr(kind, "__metadata__", ())
    return _checker(plain_kind(kind), next((m for m in marks if isinstance(m, Within)), None), False)


def _list(value: Any) -> list[Any]:
    if type(value) is not list:
        raise CodecError("not a list")
    return value


def _exactly(kind: type[Any], value: Any) -> Any:
    if type(value) is not kind:
        raise CodecError(f"{type(value).__name__}, not {kind.__name__}")
    return value


def _enum(kind: type[StrEnum], value: Any) -> StrEnum:
    try:
        return kind(value)
    except ValueError:
        raise CodecError(f"not one of {', '.join(kind)}") from None


def _number_checker(within: Within | None, nonzero: bool) -> Check:
    low, high = (within.low, within.high) if within is not None else (-MAX_NUMBER, MAX_NUMBER)

    def number(value: Any) -> float:
        if type(value) is float and low <= value <= high and (value or not nonzero):  # nearly always
            return value
        return _number(value, within, nonzero)

    return number


_finite = _number_checker(None, nonzero=False)


def _number(value: Any, within: Within | None, nonzero: bool) -> float:
    if type(value) is not float and type(value) is not int:
        raise CodecError(f"{type(value).__name__}, not a number")
    number = float(value)
    if isnan(number) and within is not None and within.nan:
        return number
    if not isfinite(number):
        raise CodecError(f"{number} is not finite")
    if within is not None and not within.low <= number <= within.high:
        raise CodecError(f"{number:g} is not within {within.low:g} .. {within.high:g}")
    if nonzero and number == 0:
        raise CodecError("is zero")
    return number


def _integer(value: Any, within: Within | None) -> int:
    if type(value) is not int:
        raise CodecError(f"{type(value).__name__}, not an integer")
    if within is not None and not within.low <= value <= within.high:
        raise CodecError(f"{value} is not within {within.low:g} .. {within.high:g}")
    return value


def _pose(value: Any) -> Pose2:
    if type(value) is not list or len(value) != 3:
        raise CodecError("not [x, y, yaw]")
    x, y, yaw = map(_finite, value)
    if abs(x) > MAX_COORDINATE or abs(y) > MAX_COORDINATE or abs(yaw) > MAX_YAW:
        raise CodecError("farther out than any place")
    return Pose2(x, y, yaw)


def _array(value: Any, dtype: np.dtype[Any], dtype_code: int, within: Within | None) -> Any:
    if type(value) is not bytes or len(value) < _HEADER.size:
        raise CodecError("not an array")
    code, n_axes, *lengths = _HEADER.unpack_from(value)
    if code != dtype_code or not 1 <= n_axes <= 3:
        raise CodecError(f"not a {dtype.name} array")
    shape = tuple(lengths[:n_axes])
    size = prod(shape)
    if size * dtype.itemsize != len(value) - _HEADER.size:
        raise CodecError("its bytes do not fit its shape")
    array = np.frombuffer(value, dtype, offset=_HEADER.size)
    if n_axes > 1:
        array = array.reshape(shape)
    if size:
        _check_bounds(array, within)
    return array


def _rounded(within: Within | None, dtype: np.dtype[Any]) -> Within | None:
    """The limits as numbers of an array's type: 2 pi as float32 is greater than 2 pi."""
    return within and replace(within, low=float(dtype.type(within.low)), high=float(dtype.type(within.high)))


def _check_bounds(array: Any, within: Within | None) -> None:
    low, high = _extremes(array, within)
    if isnan(low) and within is not None and within.nan:  # only allowed NaN
        return
    if not isfinite(low) or not isfinite(high):
        raise CodecError("holds values that are not finite")
    if within is not None and not (within.low <= low and high <= within.high):
        raise CodecError(f"holds {low:g} .. {high:g}, not within {within.low:g} .. {within.high:g}")


def _extremes(array: Any, within: Within | None) -> tuple[float, float]:
    """The least and the greatest number of an array, without allowed NaN and inf; NaN if it has only those."""
    few = array.ravel().tolist() if array.size <= FEW else None
    if within is None or not within.nan:
        if few is None:
            return array.min(), array.max()
        return (min(few), max(few)) if all(map(isfinite, few)) else (nan, nan)  # Python's min ignores NaN
    if few is None:
        array = np.where(array == inf, np.nan, array) if within.inf else array
        return np.fmin.reduce(array, axis=None), np.fmax.reduce(array, axis=None)
    few = [n for n in few if not isnan(n) and not (within.inf and n == inf)]
    return min(few, default=nan), max(few, default=nan)
