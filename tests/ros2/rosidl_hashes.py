# SPDX-License-Identifier: Apache-2.0
"""ROS's own generator of hashes, in an environment of its own: reads definitions as JSON, writes their hashes.

Definitions are of interfaces whose package the environment lacks: [name, parts], with one part for a message, two for a
service and three for an action. Each may use those before it. The hashes are also those of all that ROS makes of them.
"""

import contextlib
import json
import sys
from pathlib import Path
from tempfile import TemporaryDirectory

from rosidl_adapter.action import convert_action_to_idl
from rosidl_adapter.msg import convert_msg_to_idl
from rosidl_adapter.srv import convert_srv_to_idl
from rosidl_generator_type_description import generate_type_hash

CONVERTERS = {"msg": convert_msg_to_idl, "srv": convert_srv_to_idl, "action": convert_action_to_idl}


def type_hashes(folder: Path, name: str, parts: list[str]) -> dict[str, str]:
    """The hashes of one definition by name. folder: of all of them, a folder a package."""
    package, kind, short = name.split("/")
    home = folder / package
    (home / kind).mkdir(parents=True, exist_ok=True)
    (home / kind / f"{short}.{kind}").write_text("---\n".join(parts))
    CONVERTERS[kind](home, package, Path(kind, f"{short}.{kind}"), home / kind)
    places = [*Path(sys.prefix, "share").iterdir(), *folder.iterdir()]
    arguments = {
        "package_name": package,
        "output_dir": str(home),
        "idl_tuples": [f"{home}:{kind}/{short}.idl"],
        "include_paths": [f"{place.name}:{place}" for place in places],
    }
    path = home / f"{short}_arguments.json"
    path.write_text(json.dumps(arguments))
    rows = (row for file in generate_type_hash(str(path)) for row in json.loads(Path(file).read_text())["type_hashes"])
    return {row["type_name"]: row["hash_string"] for row in rows}


with TemporaryDirectory() as made, contextlib.redirect_stdout(sys.stderr):
    hashes = {}
    for name, parts in json.load(sys.stdin):
        hashes |= type_hashes(Path(made), name, parts)
sys.stdout.write(json.dumps(hashes))
