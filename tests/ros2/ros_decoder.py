# SPDX-License-Identifier: Apache-2.0
"""ROS's own decoder, in an environment of its own: reads lines of TYPE HEX, writes what rclpy makes of each.

The first line says which hashes ROS's packages have. Each further one is the message as rclpy encodes it again.
"""

import importlib
import json
import sys
from pathlib import Path

from rclpy.serialization import deserialize_message, serialize_message


def known_hashes() -> dict[str, str]:
    hashes = {}
    for path in Path(sys.prefix, "share").rglob("*.json"):
        document = json.loads(path.read_text())
        if isinstance(document, dict):
            hashes |= {row["type_name"]: row["hash_string"] for row in document.get("type_hashes", [])}
    return hashes


def again(type_: str, data: bytes) -> bytes | None:
    """The message encoded again; None where this environment lacks the type."""
    package, kind, name = type_.split("/")
    try:
        class_ = importlib.import_module(f"{package}.{kind}")
    except ModuleNotFoundError:
        return None
    part, _, suffix = name.partition("_")
    found = getattr(class_, part)
    return serialize_message(deserialize_message(data, getattr(found, suffix) if suffix else found))


sys.stdout.write(json.dumps(known_hashes()) + "\n")
for line in sys.stdin:
    type_, data = line.split()
    encoded = again(type_, bytes.fromhex(data))
    sys.stdout.write(("" if encoded is None else encoded.hex()) + "\n")
