# SPDX-License-Identifier: Apache-2.0
"""The wire format, one kind of field after the other: to the byte, and to the last value that is still valid."""

import hashlib
import json
from dataclasses import dataclass, field
from enum import StrEnum
from math import inf, nan, nextafter
from typing import Annotated

import msgpack
import numpy as np
import pytest
from numpy.typing import NDArray

from shared.codec import CodecError, Envelope, decode, encode, envelope_of, fields_of
from shared.geometry import Pose2
from shared.messages import Message, NonZero, Shape, Unit, Within
from shared.schema import schema, schema_id
from shared.unknown_fields import unknown_fields


class Mood(StrEnum):
    GOOD = "good"
    BAD = "bad"


@dataclass(frozen=True, slots=True)
class InnerMessage(Message):
    size: Annotated[int, Unit("m"), Within(1, 3)]


@dataclass(frozen=True, slots=True)
class AllKinds(Message):
    """One field
    of each kind."""

    number: Annotated[float, Unit("m"), Within(-2, 5)]
    gap: Annotated[float, Within(0, 9, nan=True)]
    free: float
    divisor: Annotated[float, Within(-7, 7), NonZero()]
    flag: bool
    text: str
    raw: bytes
    mood: Mood
    pose: Pose2
    part: InnerMessage
    pair: tuple[str, Annotated[float, Within(0, 1)]]
    parts: tuple[InnerMessage, ...]
    names: tuple[str, ...]
    ranges: Annotated[NDArray[np.float32], Unit("m"), Shape("n"), Within(-1, 8, nan=True)]
    points: Annotated[NDArray[np.float64], Shape("n 2")]
    cells: Annotated[NDArray[np.int8], Shape("k 2 2"), Within(-1, 100)]
    rows: Annotated[NDArray[np.int32], Shape("k")]
    bits: Annotated[NDArray[np.uint8], Shape("b")]
    late: Annotated[int, Within(0, 9)] = 4
    extra: NDArray[np.float32] = field(default_factory=lambda: np.empty(0, np.float32))


@dataclass(frozen=True, slots=True)
class Label(Message):
    at: Pose2
    text: str
    words: tuple[str]
    corners: tuple[Annotated[float, Within(0, 1)], str, float]


@dataclass(frozen=True, slots=True)
class Labelled(Message):
    label: Label


@dataclass(frozen=True, slots=True)
class Refined(Message):
    speed: Annotated[Annotated[float, Unit("m/s"), Within(-9, 9)], Within(-1, 1)]


ENVELOPE = Envelope("sim", "s", 3, 77)
TREE = {
    "@": ["sim", "s", 3, 77],
    "stamp": 5,
    "number": 1.5,
    "gap": 2.0,
    "free": 1e300,
    "divisor": -1.0,
    "flag": True,
    "text": "ä",
    "raw": b"\x00\xff",
    "mood": "bad",
    "pose": [1.0, 0.0, -3.0],
    "part": {"stamp": 6, "size": 2},
    "pair": ["a", 0.0],
    "parts": [{"stamp": 7, "size": 1}, {"stamp": 8, "size": 3}],
    "names": ["b", "c"],
    "ranges": bytes.fromhex("00 01 0000 02000000 00000000 00000000") + np.array([1, nan], "<f4").tobytes(),
    "points": bytes.fromhex("01 02 0000 02000000 02000000 00000000") + np.array([1, 2, 3, 4], "<f8").tobytes(),
    "cells": bytes.fromhex("02 03 0000 01000000 02000000 02000000 ff 00 64 01"),
    "rows": bytes.fromhex("04 01 0000 01000000 00000000 00000000 fe ff ff ff"),
    "bits": bytes.fromhex("03 01 0000 03000000 00000000 00000000 01 fe ff"),
    "late": 9,
}
MESSAGE = AllKinds(
    stamp=5,
    number=1.5,
    gap=2.0,
    free=1e300,
    divisor=-1.0,
    flag=True,
    text="ä",
    raw=b"\x00\xff",
    mood=Mood.BAD,
    pose=Pose2(1.0, 0.0, -3.0),
    part=InnerMessage(6, 2),
    pair=("a", 0.0),
    parts=(InnerMessage(7, 1), InnerMessage(8, 3)),
    names=("b", "c"),
    ranges=np.array([1, nan], np.float32),
    points=np.array([[1.0, 2.0], [3.0, 4.0]]),
    cells=np.array([[[-1, 0], [100, 1]]], np.int8),
    rows=np.array([-2], np.int32),
    bits=np.array([1, 254, 255], np.uint8),
    late=9,
)


def wire(**changes: object) -> bytes:
    return msgpack.packb({name: value for name, value in {**TREE, **changes}.items() if value is not ...})


def decoded(**changes: object) -> AllKinds:
    return decode(AllKinds, wire(**changes))[0]


def array(code: int, shape: list[int], values: bytes) -> bytes:
    lengths = [*shape, 0, 0, 0][:3]
    return bytes((code, len(shape), 0, 0)) + b"".join(n.to_bytes(4, "little") for n in lengths) + values


def f4(*values: float) -> bytes:
    return array(0, [len(values)], np.array(values, "<f4").tobytes())


def i1(*values: int, shape: list[int]) -> bytes:
    return array(2, shape, np.array(values, "i1").tobytes())


def test_a_message_is_the_bytes_that_are_described():
    assert encode(MESSAGE, ENVELOPE) == wire()


def test_the_bytes_that_are_described_are_the_message():
    message, envelope = decode(AllKinds, wire())
    assert envelope == envelope_of(wire()) == ENVELOPE
    for one in fields_of(AllKinds):
        value, expected = getattr(message, one.name), getattr(MESSAGE, one.name)
        assert type(value) is type(expected)
        if isinstance(expected, np.ndarray):
            assert value.dtype == expected.dtype
            np.testing.assert_array_equal(value, expected)
        else:
            assert value == expected


def test_what_is_in_a_message_s_message_goes_there_and_back():
    message = Labelled(1, Label(2, Pose2(1.0, 2.0, 3.0), "a", ("b",), (0.5, "c", 7.0)))
    payload = encode(message, ENVELOPE)
    inner = {"stamp": 2, "at": [1.0, 2.0, 3.0], "text": "a", "words": ["b"], "corners": [0.5, "c", 7.0]}
    assert msgpack.unpackb(payload) == {"@": TREE["@"], "stamp": 1, "label": inner}
    assert decode(Labelled, payload) == (message, ENVELOPE)
    for wrong in ({"words": []}, {"words": ["b", "c"]}, {"corners": [0.5, "c"]}, {"corners": [0.5, 7.0, "c"]}):
        with pytest.raises(CodecError):
            decode(Labelled, msgpack.packb({"@": TREE["@"], "stamp": 1, "label": {**inner, **wrong}}))


def test_what_has_a_default_may_be_missing():
    message = decoded(late=...)
    assert message.late == 4
    assert (message.extra.dtype, message.extra.shape) == (np.float32, (0,))
    assert decoded(late=..., extra=f4(0.5)).extra == [0.5], "what comes after it is read"


def test_an_unknown_field_is_ignored_and_named_wherever_it_is():
    grown = {
        "colour": 1,
        "part": {"stamp": 6, "size": 2, "shade": 1},
        "parts": [
            {"stamp": 7, "size": 1, "@": 2},
            {"stamp": 8, "size": 3, "shade": 1},
            {"stamp": 8, "size": 3, "@": 2},
        ],
    }
    message = decoded(**grown)
    assert (message.part, message.parts[1]) == (InnerMessage(6, 2), InnerMessage(8, 3))
    assert unknown_fields(AllKinds, wire(**grown)) == ("part.shade", "parts.@", "parts.shade", "colour")
    assert unknown_fields(AllKinds, wire()) == ()


@pytest.mark.parametrize("n", [1, 2])
def test_an_optional_array_is_sent_unless_it_is_empty(n):
    values = {one.name: getattr(MESSAGE, one.name) for one in fields_of(AllKinds)}
    payload = encode(AllKinds(**{**values, "extra": np.zeros(n, np.float32)}), ENVELOPE)
    assert msgpack.unpackb(payload)["extra"] == f4(*[0] * n)
    empty = AllKinds(**{**values, "names": (), "bits": np.empty(0, np.uint8)})
    tree = msgpack.unpackb(encode(empty, ENVELOPE))
    assert {"names", "bits"} <= tree.keys(), "only what has a default may be missing"


def test_numpy_s_own_numbers_are_sent_as_plain_ones():
    part = InnerMessage(np.int64(1), np.int64(2))  # type: ignore[arg-type]  # that is the point
    assert encode(part, ENVELOPE) == encode(InnerMessage(1, 2), ENVELOPE)
    refined = Refined(1, np.float64(0.5))
    assert encode(refined, ENVELOPE) == encode(Refined(1, 0.5), ENVELOPE)


def test_arrays_are_sent_in_the_declared_type_and_order():
    values = {one.name: getattr(MESSAGE, one.name) for one in fields_of(AllKinds)}
    other = {**values, "points": np.asfortranarray(MESSAGE.points), "ranges": MESSAGE.ranges.astype(">f8")}
    assert encode(AllKinds(**other), ENVELOPE) == wire()


def test_a_fault_of_the_sender_s_own_is_no_codec_error():
    with pytest.raises(TypeError):
        encode(InnerMessage(None, 2), ENVELOPE)  # type: ignore[arg-type]  # that is the point
    values = {one.name: getattr(MESSAGE, one.name) for one in fields_of(AllKinds)}
    with pytest.raises(ValueError):
        encode(AllKinds(**{**values, "pair": ("a", 0.0, 1.0)}), ENVELOPE)


@pytest.mark.parametrize(
    "changes",
    [
        {"number": -2},
        {"number": 5},
        {"number": 0},
        {"gap": nan},
        {"gap": 0.0},
        {"gap": 9.0},
        {"free": -1e300},
        {"divisor": 1},
        {"divisor": 0.5},
        {"divisor": -0.5},
        {"flag": False},
        {"text": ""},
        {"raw": b""},
        {"pose": [1e6, -1e6, 1000]},
        {"pose": [-1e6, 1e6, -1000.0]},
        {"pose": [0, 0, 0]},
        {"part": {"stamp": 0, "size": 1}},
        {"part": {"stamp": 2**62, "size": 3}},
        {"pair": ["", 1]},
        {"parts": []},
        {"names": []},
        {"ranges": f4(nan, nan)},
        {"ranges": f4(-1, 8)},
        {"ranges": f4(nan, 8)},
        {"ranges": f4(-1, nan)},
        {"ranges": f4(), "points": array(1, [0, 2], b"")},
        {"points": array(1, [2, 2], np.array([1e300, -1e300, 0, 1]).tobytes())},
        {"cells": i1(-1, -1, -1, -1, shape=[1, 2, 2])},
        {"cells": i1(100, 100, 100, 100, shape=[1, 2, 2])},
        {"cells": i1(shape=[0, 2, 2]), "rows": array(4, [0], b"")},
        {"rows": array(4, [1], b"\x00\x00\x00\x80")},
        {"bits": array(3, [0], b"")},
        {"extra": f4(1e30, -1e30)},
        {"late": 0},
    ],
)
def test_valid_to_the_last_value(changes):
    message = decoded(**changes)
    tree = msgpack.unpackb(encode(message, ENVELOPE))
    for name, value in changes.items():
        assert tree[name] == value or value != value


@pytest.mark.parametrize(
    ("changes", "told"),
    [
        ({"number": nextafter(-2, -3)}, "number: -2 is not within -2 .. 5"),
        ({"number": nextafter(5, 6)}, "number: 5 is not within -2 .. 5"),
        ({"number": nan}, "number: nan is not finite"),
        ({"number": inf}, "number: inf is not finite"),
        ({"number": "1"}, "number: str, not a number"),
        ({"number": True}, "number: bool, not a number"),
        ({"number": None}, "number: NoneType, not a number"),
        ({"number": ...}, "number: missing"),
        ({"gap": nextafter(0, -1)}, "gap: -4.94066e-324 is not within 0 .. 9"),
        ({"gap": 10}, "gap: 10 is not within 0 .. 9"),
        ({"gap": -inf}, "gap: -inf is not finite"),
        ({"free": nan}, "free: nan is not finite"),
        ({"free": -inf}, "free: -inf is not finite"),
        ({"free": False}, "free: bool, not a number"),
        ({"divisor": 0}, "divisor: is zero"),
        ({"divisor": -0.0}, "divisor: is zero"),
        ({"divisor": 8}, "divisor: 8 is not within -7 .. 7"),
        ({"flag": 1}, "flag: int, not bool"),
        ({"text": b"a"}, "text: bytes, not str"),
        ({"raw": "a"}, "raw: str, not bytes"),
        ({"mood": "sad"}, "mood: not one of good, bad"),
        ({"mood": 1}, "mood: not one of good, bad"),
        ({"mood": ["good"]}, "mood: not one of good, bad"),
        ({"pose": [0.0, 0.0]}, "pose: not [x, y, yaw]"),
        ({"pose": [0.0, 0.0, 0.0, 0.0]}, "pose: not [x, y, yaw]"),
        ({"pose": {"x": 0.0}}, "pose: not [x, y, yaw]"),
        ({"pose": "xyz"}, "pose: not [x, y, yaw]"),
        ({"pose": [0.0, "0", 0.0]}, "pose: str, not a number"),
        ({"pose": [0.0, nan, 0.0]}, "pose: nan is not finite"),
        *(({"pose": pose}, "pose: farther out than any place")
          for value, i in ((1e6, 0), (1e6, 1), (1000.0, 2)) for sign in (1, -1)
          for pose in [[sign * nextafter(value, inf) if k == i else 0.0 for k in range(3)]]),
        ({"part": {"stamp": 1, "size": 0}}, "part: size: 0 is not within 1 .. 3"),
        ({"part": {"stamp": 1, "size": 4}}, "part: size: 4 is not within 1 .. 3"),
        ({"part": {"stamp": 1, "size": 2.0}}, "part: size: float, not an integer"),
        ({"part": {"stamp": 1, "size": True}}, "part: size: bool, not an integer"),
        ({"part": {"stamp": 1}}, "part: size: missing"),
        ({"part": [1, 2]}, "part: not a map"),
        ({"pair": ["a"]}, "pair: 1 items, not 2"),
        ({"pair": ["a", 0.0, 0.0]}, "pair: 3 items, not 2"),
        ({"pair": "ab"}, "pair: not a list"),
        ({"pair": [1, 0.0]}, "pair: int, not str"),
        ({"pair": ["a", 2.0]}, "pair: 2 is not within 0 .. 1"),
        ({"parts": [{"stamp": 7, "size": 1}, {"stamp": 7, "size": 9}]}, "parts: size: 9 is not within 1 .. 3"),
        ({"parts": {"stamp": 7}}, "parts: not a list"),
        ({"names": ["a", 1]}, "names: int, not str"),
        ({"names": "ab"}, "names: not a list"),
        ({"ranges": f4(1.0, -1.5)}, "ranges: holds -1.5 .. 1, not within -1 .. 8"),
        ({"ranges": f4(nan, 9.0)}, "ranges: holds 9 .. 9, not within -1 .. 8"),
        ({"ranges": f4(1.0, inf)}, "ranges: holds values that are not finite"),
        ({"ranges": f4(-inf, 1.0)}, "ranges: holds values that are not finite"),
        ({"ranges": array(0, [1, 2], bytes(8))}, "ranges: 2 axes, not 1"),
        ({"ranges": f4(1.0, 1.0, 1.0)}, "points: 2 long, not 3"),
        ({"ranges": f4(1.0)}, "points: 2 long, not 1"),
        ({"ranges": f4(1.0, 1.0) + b"\0"}, "ranges: its bytes do not fit its shape"),
        ({"ranges": f4(1.0, 1.0)[:-1]}, "ranges: its bytes do not fit its shape"),
        ({"ranges": f4()[:-1]}, "ranges: not an array"),
        ({"ranges": b""}, "ranges: not an array"),
        ({"ranges": "a" * 24}, "ranges: not an array"),
        ({"ranges": array(1, [1], bytes(8))}, "ranges: not a float32 array"),
        ({"ranges": array(2, [8], bytes(8))}, "ranges: not a float32 array"),
        ({"ranges": array(4, [2], bytes(8))}, "ranges: not a float32 array"),
        ({"ranges": array(5, [2], bytes(8))}, "ranges: not a float32 array"),
        ({"points": array(1, [4], bytes(32))}, "points: 1 axes, not 2"),
        ({"points": array(1, [2, 1], bytes(16))}, "points: 1 long, not 2"),
        ({"points": array(1, [2, 3], bytes(48))}, "points: 3 long, not 2"),
        ({"points": array(1, [2, 2], np.array([0, nan, 0, 0]).tobytes())}, "points: holds values that are not finite"),
        ({"points": array(1, [2, 2], np.array([0, inf, 0, 0]).tobytes())}, "points: holds values that are not finite"),
        ({"points": array(1, [2, 2], np.array([0, -inf, 0, 0]).tobytes())}, "points: holds values that are not finite"),
        ({"cells": i1(0, 0, 0, 101, shape=[1, 2, 2])}, "cells: holds 0 .. 101, not within -1 .. 100"),
        ({"cells": i1(0, 0, 0, -2, shape=[1, 2, 2])}, "cells: holds -2 .. 0, not within -1 .. 100"),
        ({"extra": array(0, [], bytes(4))}, "extra: not a float32 array"),
        ({"extra": bytes((0, 4, 0, 0, *[1, 0, 0, 0] * 3)) + bytes(4)}, "extra: not a float32 array"),
        ({"extra": f4(nan)}, "extra: holds values that are not finite"),
        ({"late": 10}, "late: 10 is not within 0 .. 9"),
        ({"late": -1}, "late: -1 is not within 0 .. 9"),
        ({"@": ...}, "no envelope"),
        ({"@": ["sim", "s", 3]}, "no envelope"),
        ({"@": ["sim", "s", 3, 77, 0]}, "no envelope"),
        ({"@": {}}, "no envelope"),
        *(({"@": [value if k == i else good for k, good in enumerate(["sim", "s", 3, 77])]},
           "the envelope is not [publisher, session, sequence, sent]")
          for i, value in ((0, 1), (1, b"s"), (2, 3.0), (2, True), (3, "77"))),
    ],
)  # fmt: skip
def test_every_fault_names_its_field_and_what_was_expected(changes, told):
    with pytest.raises(CodecError) as error:
        decoded(**changes)
    assert str(error.value) == told


@pytest.mark.parametrize(
    ("payload", "told"),
    [(b"", "not msgpack: "), (b"\xc1", "not msgpack: "), (b"\x81\x01\x02", "not msgpack: "), (b"\x90", "not a map")],
)
def test_what_is_no_map_of_names_is_told(payload, told):
    for read in (envelope_of, lambda data: decode(AllKinds, data)):
        with pytest.raises(CodecError, match=told):
            read(payload)


def test_who_sent_a_message_is_read_of_any_type():
    assert envelope_of(msgpack.packb({"@": ["a", "b", 0, 1], "anything": None})) == Envelope("a", "b", 0, 1)
    with pytest.raises(CodecError, match="no envelope"):
        envelope_of(msgpack.packb({}))


def test_the_last_mark_of_a_kind_holds():
    (_, speed) = fields_of(Refined)
    assert (speed.name, speed.kind, speed.unit, speed.within) == ("speed", float, "m/s", Within(-1, 1))
    assert (speed.shape, speed.nonzero, speed.required) == (None, False, True)
    marks = {one.name: one for one in fields_of(AllKinds)}
    assert marks["divisor"].nonzero
    assert marks["divisor"].unit == ""
    assert marks["points"].shape == Shape("n 2")
    assert marks["free"].kind is float
    assert marks["free"].within is None
    assert (marks["late"].required, marks["late"].default) == (False, 4)
    assert not marks["extra"].required


def test_the_schema_says_all_that_is_declared():
    described = json.loads(schema(AllKinds))
    rows = {row.pop("name"): row for row in described.pop("fields")}
    assert described == {"name": "AllKinds", "doc": "One field of each kind.", "encoding": "zenav msgpack"}
    assert list(rows) == [one.name for one in fields_of(AllKinds)]
    assert rows["stamp"] == {"type": "int", "unit": "ns", "within": [0, 2**62]}
    assert rows["number"] == {"type": "float", "unit": "m", "within": [-2, 5]}
    assert rows["gap"] == {"type": "float", "unit": "", "within": [0, 9], "nan": True}
    assert rows["free"] == {"type": "float", "unit": ""}
    assert rows["ranges"] == {"type": "float32[]", "unit": "m", "within": [-1, 8], "nan": True, "shape": "n"}
    assert rows["points"] == {"type": "float64[]", "unit": "", "shape": "n 2"}
    assert rows["cells"]["type"] == "int8[]"
    assert rows["pair"]["type"] == "[str, float]"
    assert rows["parts"]["type"] == "[InnerMessage, ...]"
    assert rows["pose"]["type"] == "Pose2"
    assert json.loads(schema(Refined))["doc"] == " ".join((Refined.__doc__ or "").split())


def test_a_schema_s_name_tells_incompatible_versions_apart():
    rows = [("stamp", "int"), ("size", "int")]
    assert schema_id(InnerMessage) == f"InnerMessage-{hashlib.sha256(repr(rows).encode()).hexdigest()[:8]}"

    @dataclass(frozen=True, slots=True)
    class Grown(InnerMessage):
        colour: Annotated[int, Within(0, 1)] = 0

    @dataclass(frozen=True, slots=True)
    class Changed(InnerMessage):
        colour: Annotated[int, Within(0, 1)]

    assert schema_id(Grown)[-8:] == schema_id(InnerMessage)[-8:], "a field with a default is compatible"
    assert schema_id(Changed)[-8:] != schema_id(InnerMessage)[-8:]
