# SPDX-License-Identifier: Apache-2.0
"""The page's types are those of the messages, and its tables read what the codec writes."""

import re
import struct
from typing import get_type_hints

import msgpack
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from services.dashboard.frames import PAGE_KEYS
from shared import topics
from shared.codec import Envelope, encode
from tests.strategies import messages
from zenav.web_types import FILE, SHOWN, array_paths, web_types

CODES = ("f4", "f8", "i1", "u1", "i4")  # docs/messages.md: the first byte of an array


def test_the_file_is_what_the_messages_say():
    assert FILE.read_text(encoding="utf-8") == web_types(), "write it again: python -m zenav.web_types"


def test_every_topic_that_a_page_may_want_has_its_type():
    keys = set(re.findall(r'^  "([\w/]+)": \w+;$', web_types(), re.MULTILINE))
    assert keys == {topic.key for topic in SHOWN}
    assert {topics.topic_of(key) for key in PAGE_KEYS} == set(SHOWN)


def test_enums_are_unions_of_texts_and_lists_of_messages_are_typed():
    text = web_types()
    assert 'export type GuardState = "idle" | "active" | "hold" | "stopped" | "fault";' in text
    assert "readonly zones: readonly Zone[];" in text
    assert "readonly cells: Grid<Int8Array>;" in text
    assert "readonly rates: readonly (readonly [string, number, number])[];" in text
    assert "readonly intensities?: Float32Array;" in text


@pytest.mark.parametrize("kind", sorted({topic.type for topic in SHOWN}, key=lambda kind: kind.__name__))
def test_the_table_of_arrays_names_each_array_of_the_bytes_with_its_type(kind):
    @settings(max_examples=5, deadline=None)
    @given(st.data())
    def holds(data):
        tree = msgpack.unpackb(encode(data.draw(messages(kind)), Envelope("sim", "s", 0, 0)))
        arrays = dict(array_paths(kind))
        for path, expected in arrays.items():
            name, _, inner = path.partition("[].")
            values = [item[inner] for item in tree[name]] if inner else [tree[name]] if name in tree else []
            for value in values:
                code, axes = struct.unpack_from("<BB", value)
                assert (CODES[code], axes) == (expected.split()[0], int((expected + " 1").split()[1]))
        named = {path.partition("[].")[0] for path in arrays}
        others = {name for name, value in tree.items() if isinstance(value, bytes) and name not in named}
        assert others == {name for name, of in get_type_hints(kind).items() if of is bytes and name in tree}

    holds()
