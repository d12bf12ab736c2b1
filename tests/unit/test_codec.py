# SPDX-License-Identifier: Apache-2.0
"""Bytes to messages and back: a message decodes to itself, and the error of invalid bytes says what is wrong."""

import msgpack
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from shared.codec import CodecError, Envelope, decode, encode, envelope_of, fields_of
from shared.messages import LaserScan, MapUpdate, Message, Velocity
from shared.requests import REQUESTS
from shared.schema import schema, schema_id
from shared.topics import TOPICS
from tests.strategies import messages

TYPES = sorted({t.type for t in TOPICS} | {r.request for r in REQUESTS} | {r.reply for r in REQUESTS}, key=str)
envelopes = st.builds(Envelope, st.text(max_size=8), st.text(max_size=8), st.integers(0, 2**40), st.integers(0, 2**62))


def changed(payload: bytes, **fields: object) -> bytes:
    tree = msgpack.unpackb(payload)
    tree.update(fields)
    return msgpack.packb({k: v for k, v in tree.items() if v is not ...})


@pytest.mark.parametrize("kind", TYPES)
@settings(max_examples=50)
@given(data=st.data())
def test_decoding_undoes_encoding(kind, data):
    message, envelope = data.draw(messages(kind)), data.draw(envelopes)
    payload = encode(message, envelope)
    decoded, sender = decode(kind, payload)
    assert sender == envelope == envelope_of(payload)
    assert encode(decoded, sender) == payload
    come_back(message, decoded)


def come_back(before, after):
    """What is in a message is in what was decoded, also in messages inside it."""
    if isinstance(before, Message):
        for field in fields_of(type(before)):
            come_back(getattr(before, field.name), getattr(after, field.name))
    elif isinstance(before, np.ndarray):
        np.testing.assert_array_equal(after, before)
        assert not after.flags.writeable
        assert after.flags.aligned
    elif isinstance(before, tuple):
        assert len(after) == len(before)
        for one, other in zip(before, after):
            come_back(one, other)
    else:
        assert after == before or before != before != after  # NaN is not even itself


@pytest.mark.parametrize("kind", TYPES)
@settings(max_examples=30)
@given(junk=st.binary(max_size=80))
def test_random_bytes_are_a_codec_error_and_nothing_else(kind, junk):
    with pytest.raises(CodecError):
        decode(kind, junk)


@pytest.mark.parametrize("kind", [LaserScan, MapUpdate])
@given(data=st.data())
def test_a_damaged_message_decodes_to_a_valid_one_or_is_a_codec_error(kind, data):
    payload = bytearray(encode(data.draw(messages(kind)), Envelope("sim", "s", 0, 0)))
    at = data.draw(st.integers(0, len(payload) - 1))
    payload[at] ^= data.draw(st.integers(1, 255))
    try:
        message, envelope = decode(kind, bytes(payload))
    except CodecError:
        return
    assert encode(message, envelope)


def scan(**fields: object) -> bytes:
    ranges = np.array([1.0, np.nan, 2.0], np.float32)
    good = encode(LaserScan(5, 0.0, 0.1, 0.1, 0.1, 10.0, ranges), Envelope("sim", "s", 0, 5))
    return changed(good, **fields) if fields else good


def array(values: object, dtype: type = np.float32) -> bytes:
    from shared.codec import packed_array

    return packed_array(np.array(values, dtype), np.dtype(dtype))


def test_a_good_scan_is_good():
    assert decode(LaserScan, scan())[0].stamp == 5


numbers = st.sampled_from([np.nan, np.inf, -np.inf, -1.0, -1e-7, 0.0, 1.0, 250.0, 250.00002, 65535.0, 65536.0, 1e30])


@given(st.lists(numbers, min_size=2, max_size=8), st.sampled_from(["ranges", "intensities"]))
def test_few_and_many_numbers_of_an_array_are_judged_alike(values, field):
    def judged(n: int) -> str:
        try:
            decode(LaserScan, scan(angle_increment=0.01, **{field: array(values * n)}))
        except CodecError as error:
            return str(error)
        return "good"

    assert judged(1) == judged(20)


@pytest.mark.parametrize(
    ("fields", "told"),
    [
        ({"ranges": array([1, -np.inf, 2])}, "not finite"),
        ({"ranges": array([1, -1, 2])}, "not within"),
        ({"ranges": array([1])}, "fewer than 2 beams"),
        ({"ranges": array([])}, "fewer than 2 beams"),
        ({"ranges": array([[1, 2]])}, "axes"),
        ({"ranges": array([1, 2], np.float64)}, "not a float32 array"),
        ({"ranges": array([1, 2])[:-1]}, "do not fit"),
        ({"ranges": [1.0, 2.0]}, "not an array"),
        ({"ranges": array(np.ones(64))}, "more than a full turn"),
        ({"angle_increment": 0.0}, "zero"),
        ({"angle_increment": float("nan")}, "not finite"),
        ({"angle_min": "0"}, "not a number"),
        ({"scan_time": -0.1}, "not within"),
        ({"range_min": 20.0}, "range_min"),
        ({"stamp": -1}, "not within"),
        ({"stamp": 1.5}, "not an integer"),
        ({"stamp": True}, "not an integer"),
        ({"stamp": ...}, "missing"),
        ({"@": ...}, "envelope"),
        ({"@": ["sim", "s", "0", 5]}, "envelope"),
    ],
)
def test_each_fault_is_told(fields, told):
    with pytest.raises(CodecError, match=told):
        decode(LaserScan, scan(**fields))


def test_all_echoes_missing_is_a_valid_scan():
    ranges = decode(LaserScan, scan(ranges=array([np.nan, np.nan])))[0].ranges
    assert np.isnan(ranges).all()


def test_no_return_may_be_plus_infinity_in_a_scan_and_nothing_else_is_let_through_beside_it():
    ranges = decode(LaserScan, scan(ranges=array([np.inf, np.nan, 1.0])))[0].ranges
    assert np.isposinf(ranges[0])
    for wrong in ([np.inf, -np.inf], [np.inf, 300.0], [np.inf, -1.0]):
        with pytest.raises(CodecError):
            decode(LaserScan, scan(ranges=array(wrong)))


def test_a_reason_is_plain_text_on_the_wire():
    tree = msgpack.unpackb(encode(Velocity(1, 0.5, 0.0, "estop"), Envelope("guard", "s", 3, 2)))
    assert tree == {"@": ["guard", "s", 3, 2], "stamp": 1, "v": 0.5, "w": 0.0, "reason": "estop"}


def test_schemas_are_named_by_their_fields():
    names = {schema_id(kind) for kind in TYPES}
    assert len(names) == len(TYPES)
    assert b'"unit": "rad"' in schema(LaserScan)


def test_an_empty_optional_array_costs_nothing_on_the_wire_and_a_full_one_arrives():
    ranges = np.ones(360, np.float32)
    plain, rich = (LaserScan(5, 0.0, 0.01, 0.1, 0.1, 10.0, ranges, *more) for more in ((), (ranges * 7,)))
    envelope = Envelope("sim", "s", 0, 5)
    assert b"intensities" not in encode(plain, envelope)
    assert len(decode(LaserScan, encode(plain, envelope))[0].intensities) == 0
    np.testing.assert_array_equal(decode(LaserScan, encode(rich, envelope))[0].intensities, ranges * 7)
