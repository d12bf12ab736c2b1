# SPDX-License-Identifier: Apache-2.0
"""The golden bytes are those of the codec, fit the JSON Schema, and come back from their JSON."""

import json
from pathlib import Path
from typing import Any

import pytest

from shared.codec import Envelope, decode, encode
from shared.config import UserError
from shared.messages import LaserScan, MapUpdate, Velocity
from shared.requests import Navigate
from zenav.__main__ import _status
from zenav.console.message_text import json_value
from zenav.wire.from_json import payload_from_json
from zenav.wire.json_schema import document
from zenav.wire.page import message_classes

GOLDEN = json.loads((Path(__file__).resolve().parents[4] / "docs" / "wire" / "golden.json").read_text())
CLASSES = {class_.__name__: class_ for class_ in message_classes()}
SCHEMA = document()
ENVELOPE = Envelope("operator", "s", 0, 99)
TYPES: dict[str, Any] = {
    "object": dict, "array": list, "string": str, "boolean": bool, "number": (int, float), "integer": int,
    "null": type(None),
}  # fmt: skip


def faults(value: Any, schema: dict[str, Any], at: str) -> list[str]:
    """What of a value the keywords that zenav's schemas use forbid."""
    if "$ref" in schema:
        return faults(value, SCHEMA["$defs"][schema["$ref"].removeprefix("#/$defs/")], at)
    if "enum" in schema:
        return [] if value in schema["enum"] else [at]
    names = schema["type"] if isinstance(schema["type"], list) else [schema["type"]]
    if not any(isinstance(value, TYPES[name]) and (name == "boolean" or value is not True) for name in names):
        return [f"{at} is no {names}"]
    found = []
    if isinstance(value, int | float) and not isinstance(value, bool):
        low, high = schema.get("minimum", value), schema.get("maximum", value)
        found += [] if low <= value <= high and value != schema.get("not", {}).get("const") else [f"{at}: {value}"]
    if isinstance(value, dict):
        found += [f"{at}: no {name}" for name in schema["required"] if name not in value]
        found += [fault for name in value for fault in faults(value[name], schema["properties"][name], f"{at}.{name}")]
    if isinstance(value, list):
        first = schema.get("prefixItems", [])
        n = schema.get("minItems", 0), schema.get("maxItems", len(first) if schema.get("items") is False else 10**9)
        found += [] if n[0] <= len(value) <= n[1] else [f"{at}: {len(value)} items"]
        schemas = [*first, *[schema["items"]] * (len(value) - len(first))]
        found += [fault for item, one in zip(value, schemas) for fault in faults(item, one, f"{at}[]")]
    return found


def test_every_class_has_its_golden_bytes():
    assert list(GOLDEN) == list(CLASSES)


@pytest.mark.parametrize("name", CLASSES)
def test_the_bytes_are_the_values_and_fit_the_schema(name):
    payload, value = bytes.fromhex(GOLDEN[name]["bytes"]), GOLDEN[name]["value"]
    message, envelope = decode(CLASSES[name], payload)
    assert {"@": list(envelope), **json_value(message)} == value
    assert encode(message, envelope) == payload
    assert faults(value, {"$ref": f"#/$defs/{name}"}, name) == []


@pytest.mark.parametrize("name", CLASSES)
def test_json_becomes_the_same_message(name):
    value = GOLDEN[name]["value"]
    message, envelope = decode(CLASSES[name], payload_from_json(CLASSES[name], json.dumps(value), ENVELOPE))
    assert envelope == ENVELOPE
    assert json_value(message) == {key: item for key, item in value.items() if key != "@"}


def test_the_schema_has_units_bounds_and_shapes():
    scan = SCHEMA["$defs"]["LaserScan"]
    assert scan["properties"]["ranges"] == {
        "type": "array", "items": {"type": ["number", "null"], "minimum": 0, "maximum": 250},
        "x-dtype": "float32", "x-shape": "n", "x-unit": "m",
    }  # fmt: skip
    assert "intensities" not in scan["required"]
    assert faults({**GOLDEN["LaserScan"]["value"], "angle_increment": 0}, scan, "scan") != []
    cells = SCHEMA["$defs"]["MapUpdate"]["properties"]["cells"]["items"]
    assert (cells["minItems"], cells["maxItems"]) == (4096, 4096)
    keys = {row["key"]: row for row in SCHEMA["x-topics"]}
    assert keys["scan"]["message"] == "#/$defs/LaserScan"


def test_a_stamp_that_is_left_out_is_the_time_of_sending():
    payload = payload_from_json(Velocity, '{"v": 1, "w": 0, "reason": ""}', ENVELOPE)
    assert decode(Velocity, payload)[0].stamp == ENVELOPE.sent
    assert len(decode(MapUpdate, payload_from_json(MapUpdate, json.dumps(
        {"map_id": 1, "version": 1, "resolution": 0.05, "rows": [], "columns": [], "cells": []}), ENVELOPE))[0].rows
    ) == 0  # fmt: skip


@pytest.mark.parametrize(
    ("class_", "text", "said"),
    [
        (Velocity, "{", "not JSON"),
        (Velocity, "[1]", "JSON object"),
        (Velocity, '{"v": 1}', "missing"),
        (Velocity, '{"v": "a", "w": 0, "reason": ""}', "v: str, not a number"),
        (Velocity, '{"v": 99, "w": 0, "reason": ""}', "v: 99 is not within"),
        (Navigate, '{"pose": [[1, 2, 0]]}', "no field pose"),
        (Navigate, '{"poses": [[1, 2]], "dwell": 0, "loops": 1, "any_heading": true}', "poses: not"),
        (LaserScan, '{"ranges": 3}', "ranges is not a list"),
        (LaserScan, '{"ranges": ["a"]}', "LaserScan"),
        (MapUpdate, '{"rows": [0.5]}', "rows holds values that are no int32"),
        (MapUpdate, '{"rows": [1e99]}', "rows holds values that are no int32"),
    ],
)
def test_json_that_is_no_message_is_one_line_and_a_hint(class_, text, said):
    with pytest.raises(UserError) as error:
        payload_from_json(class_, text, ENVELOPE)
    assert said in error.value.what
    assert error.value.hint


def test_zenav_schema_prints_one_message_or_all(capsys):
    assert _status(["schema", "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["$defs"].keys() >= {"envelope", "LaserScan", "Navigate"}
    assert _status(["schema", "request/navigate", "--json"]) == 0
    assert "poses" in json.loads(capsys.readouterr().out)["properties"]
    assert _status(["schema", "LaserScan"]) == 0
    assert "ranges (m)" in capsys.readouterr().out
    assert _status(["schema", "LaserScam"]) == 2
    assert "LaserScan" in capsys.readouterr().err
