# SPDX-License-Identifier: Apache-2.0
"""The golden bytes of docs/wire/ are read by another language: the example's reader in Node."""

import json
import shutil
import subprocess
from pathlib import Path

import pytest

from zenav.wire.golden import STAMP
from zenav.wire.json_schema import document

ROOT = Path(__file__).resolve().parents[2]
GOLDEN = ROOT / "docs" / "wire" / "golden.json"
NODE_MODULES = ROOT / "web" / "node_modules"


def test_node_reads_every_golden_message_by_the_schema(tmp_path):
    node = shutil.which("node")
    if node is None or not (NODE_MODULES / "@msgpack").exists():
        pytest.skip("no Node with @msgpack/msgpack")
    (tmp_path / "node_modules").symlink_to(NODE_MODULES)
    shutil.copy(ROOT / "examples" / "wire.mjs", tmp_path)
    (tmp_path / "schema.json").write_text(json.dumps(document()))
    reader = Path(__file__).with_name("golden_reader.mjs")
    run = subprocess.run(
        [node, reader, tmp_path / "wire.mjs", GOLDEN, tmp_path / "schema.json"],
        capture_output=True,
        text=True,
        timeout=60,
    )
    assert run.returncode == 0, run.stderr
    n = len(json.loads(GOLDEN.read_text()))
    assert json.loads(run.stdout) == {"read": n, "wrong": [], "stamp": str(STAMP)}
