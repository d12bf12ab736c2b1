# SPDX-License-Identifier: Apache-2.0
"""The layout: what it names is there, every panel has its place, and the file in docs is the present one."""

import json
import re
from pathlib import Path
from typing import Any

from shared.topics import SERVICES, TOPICS, key_of
from zenav.foxglove.commander import COMMAND_HOLD_S
from zenav.foxglove.inbound import TOPICS as TAKEN
from zenav.foxglove.layout import layout
from zenav.foxglove.schemas import MAP_ROW, encoding_of, rows_of

ROOT = Path(__file__).resolve().parents[4]
DOCS = ROOT / "docs" / "foxglove-layout.json"
IGNORED = {"/clicked_point"}  # the 3D panel must have a name for it
CALLS = {"/estop", "/estop_release", "/explore", "/cancel"}


def named_topics(value: Any) -> set[str]:
    """Every Foxglove topic, or path into one, that a layout names."""
    if isinstance(value, dict):
        return {key for key in value if key.startswith("/")}.union(*map(named_topics, value.values()))
    if isinstance(value, list):
        return set().union(*map(named_topics, value))
    return {value} if isinstance(value, str) and value.startswith("/") else set()


def shown() -> dict[str, Any]:
    keys = [key for t in TOPICS for key in ([t.key] if t.by != "*" else [key_of(t, name) for name in SERVICES])]
    return {row.topic: row for key in keys for row in rows_of(key)} | {MAP_ROW.topic: MAP_ROW}


def test_every_topic_and_field_that_it_names_is_there():
    rows = shown()
    for path in named_topics(json.loads(layout())) - IGNORED - CALLS - set(TAKEN):
        topic, *fields = re.split(r"\.", path)
        assert topic in rows, path
        encoding, schema = encoding_of(rows[topic].type)
        if fields and encoding == "json":
            assert fields[0] in json.loads(schema.data)["properties"], path
        elif fields:
            assert all(field.encode() in schema.data for field in fields), path


def test_every_panel_has_one_place():
    tree = json.loads(layout())

    def leaves(node: Any) -> list[str]:
        return [node] if isinstance(node, str) else leaves(node["first"]) + leaves(node["second"])

    assert sorted(leaves(tree["layout"])) == sorted(tree["configById"])


def test_its_teleop_sends_often_enough_to_drive():
    teleop = json.loads(layout())["configById"]["Teleop!drive"]
    assert TAKEN[teleop["topic"]] == "teleop"
    assert 1 / teleop["publishRate"] < COMMAND_HOLD_S / 2


def test_the_file_in_docs_is_the_present_one():
    assert DOCS.read_text(encoding="utf-8") == layout(), (
        "write it again: zenav foxglove --layout > docs/foxglove-layout.json"
    )
