# SPDX-License-Identifier: Apache-2.0
"""The key of a robot's liveliness token."""

from hypothesis import given
from hypothesis import strategies as st

from shared.runners.presence import Presence, own_presence, presence_of

WORD = st.text(st.characters(codec="ascii", categories=("L", "N"), include_characters="-._"), min_size=1)


@given(st.integers(0, 2**63), WORD, st.integers(1, 2**22), WORD, WORD)
def test_a_key_says_what_it_was_made_of(start, host, pid, version, name):
    presence = Presence(start, host, pid, version, name)
    assert presence_of(presence.key) == presence


@given(st.lists(st.one_of(WORD, st.just("@up"), st.just("")), max_size=8).map("/".join))
def test_any_key_is_a_presence_or_none(key):
    presence = presence_of(key)
    assert presence is None or presence.key.split("/")[1] == "@up"


def test_this_process_has_a_key_without_wildcards():
    key = own_presence("red").key
    assert len(key.split("/")) == 6
    assert not set(key) & set("*$#? ")
