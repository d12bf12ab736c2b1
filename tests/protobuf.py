# SPDX-License-Identifier: Apache-2.0
"""Protobuf messages decoded by the schema that travels with them, a FileDescriptorSet: what Foxglove does too.

Wire format and descriptor.proto: protobuf.dev/programming-guides/encoding. Numbers, strings, messages; no maps, groups.
"""

import struct
from collections.abc import Iterator
from functools import cache
from typing import Any, NamedTuple

DOUBLE, FLOAT, STRING, MESSAGE, BYTES, ENUM = 1, 2, 9, 11, 12, 14
FIXED = {DOUBLE: "<d", FLOAT: "<f", 6: "<Q", 7: "<I", 15: "<i", 16: "<q"}
SIGNED = (3, 5)  # int64, int32
REPEATED = 3


def _varint(data: bytes, at: int) -> tuple[int, int]:
    value = shift = 0
    while True:
        byte = data[at]
        value, shift, at = value | (byte & 0x7F) << shift, shift + 7, at + 1
        if byte < 0x80:
            return value, at


def _wire(data: bytes) -> Iterator[tuple[int, int, Any]]:
    """(number, wire type, raw value) of each field."""
    at = 0
    while at < len(data):
        tag, at = _varint(data, at)
        kind = tag & 7
        if kind == 0:
            value, at = _varint(data, at)
        elif kind == 2:
            length, at = _varint(data, at)
            value, at = data[at : at + length], at + length
            assert len(value) == length
        else:
            length = {1: 8, 5: 4}[kind]
            value, at = data[at : at + length], at + length
        yield tag >> 3, kind, value


def _all(data: bytes, number: int) -> list[Any]:
    return [value for n, _, value in _wire(data) if n == number]


class ProtobufField(NamedTuple):
    """A field of a message type; `type` is the full name where it is a message itself."""

    name: str
    kind: int
    repeated: bool
    type: str


@cache
def schema_of(descriptor_set: bytes) -> "Schema":
    """The schema that this FileDescriptorSet holds."""
    return Schema(descriptor_set)


class Schema:
    """The message types of a FileDescriptorSet, by their full names."""

    def __init__(self, descriptor_set: bytes) -> None:
        self.types: dict[str, bytes] = {}
        self._known: dict[str, dict[int, ProtobufField]] = {}
        for file in _all(descriptor_set, 1):
            package = b"".join(_all(file, 2)).decode()
            for message in _all(file, 4):
                self._add(f".{package}", message)

    def _add(self, scope: str, message: bytes) -> None:
        name = f"{scope}.{_all(message, 1)[0].decode()}"
        self.types[name] = message
        for nested in _all(message, 3):
            self._add(name, nested)

    def decode(self, name: str, data: bytes) -> dict[str, Any]:
        """A message as a dictionary with every field of its type."""
        fields = self._fields(name)
        found: dict[str, Any] = {}
        for field in fields.values():
            empty: Any = {STRING: "", BYTES: b"", MESSAGE: None}.get(field.kind, 0)
            found[field.name] = [] if field.repeated else empty
        for number, wire, raw in _wire(data):
            field = fields[number]
            if field.kind in (STRING, BYTES, MESSAGE) or wire != 2:
                values = [self._value(field, raw)]
            else:
                values = list(self._packed(field, raw))
            if field.repeated:
                found[field.name].extend(values)
            else:
                found[field.name] = values[-1]
        return found

    def _fields(self, name: str) -> dict[int, ProtobufField]:
        name = f".{name.lstrip('.')}"
        if name not in self._known:
            rows = ({n: v for n, _, v in _wire(field)} for field in _all(self.types[name], 2))
            self._known[name] = {
                row[3]: ProtobufField(row[1].decode(), row[5], row[4] == REPEATED, row.get(6, b"").decode())
                for row in rows
            }
        return self._known[name]

    def _packed(self, field: ProtobufField, data: bytes) -> Iterator[Any]:
        kind, at = field.kind, 0
        while at < len(data):
            if kind in FIXED:
                size = struct.calcsize(FIXED[kind])
                raw, at = data[at : at + size], at + size
            else:
                raw, at = _varint(data, at)
            yield self._value(field, raw)

    def _value(self, field: ProtobufField, raw: Any) -> Any:
        kind = field.kind
        if kind == MESSAGE:
            return self.decode(field.type, raw)
        if kind in FIXED:
            return struct.unpack(FIXED[kind], raw)[0]
        if kind == STRING:
            return raw.decode()
        return raw - 2**64 if kind in SIGNED and raw >= 2**63 else raw
