# SPDX-License-Identifier: Apache-2.0
"""ROS's own generator of hashes, in an environment of its own: reads definitions as JSON, writes their hashes.

Definitions are of messages whose package the environment lacks, by name; each may use those before it.
"""

import contextlib
import json
import sys
from pathlib import Path
from tempfile import TemporaryDirectory

from rosidl_adapter.msg import convert_msg_to_idl
from rosidl_generator_type_description import generate_type_hash


def type_hash(folder: Path, name: str, text: str) -> str:
    """The hash of one message. folder: of all of them, a folder a package."""
    package, _, short = name.split("/")
    home = folder / package
    (home / "msg").mkdir(parents=True, exist_ok=True)
    (home / "msg" / f"{short}.msg").write_text(text)
    convert_msg_to_idl(home, package, Path("msg", f"{short}.msg"), home / "msg")
    places = [*Path(sys.prefix, "share").iterdir(), *folder.iterdir()]
    arguments = {
        "package_name": package,
        "output_dir": str(home),
        "idl_tuples": [f"{home}:msg/{short}.idl"],
        "include_paths": [f"{place.name}:{place}" for place in places],
    }
    path = home / f"{short}_arguments.json"
    path.write_text(json.dumps(arguments))
    [written] = generate_type_hash(str(path))
    return json.loads(Path(written).read_text())["type_hashes"][0]["hash_string"]


with TemporaryDirectory() as made, contextlib.redirect_stdout(sys.stderr):
    hashes = {name: type_hash(Path(made), name, text) for name, text in json.load(sys.stdin).items()}
sys.stdout.write(json.dumps(hashes))
