# SPDX-License-Identifier: Apache-2.0
"""The lock with hashes has each pin of the plain one; the list of software has each pin."""

import re
from pathlib import Path

from tests.sbom import merged, missing, pins

ROOT = Path(__file__).resolve().parents[2]
PLAIN = (ROOT / "requirements.txt").read_text(encoding="utf-8")
HASHED = (ROOT / "requirements.hashes.txt").read_text(encoding="utf-8")


def test_both_locks_have_the_same_pins():
    assert pins(HASHED) == pins(PLAIN)
    assert len(pins(PLAIN)) > 40


def test_each_pin_has_a_hash_and_the_lock_names_no_host():
    entries = re.split(r"\n(?=[\w.-]+==)", HASHED)[1:]
    assert len(entries) == len(pins(HASHED))
    for entry in entries:
        assert re.search(r"--hash=sha256:[0-9a-f]{64}\b", entry), entry.splitlines()[0]
    assert "://" not in HASHED
    assert "--index-url" not in HASHED


def component(name: str, version: str, hashes: int = 1) -> dict[str, object]:
    link = {"type": "distribution", "url": "anywhere", "hashes": [{"alg": "SHA-256", "content": "0"}] * hashes}
    purl = f"pkg:pypi/{name}@{version}"
    return {"type": "library", "bom-ref": name, "name": name, "version": version, "purl": purl,
            "externalReferences": [link]}  # fmt: skip


def test_a_package_that_the_list_lacks_or_has_without_hash_is_found():
    licence = [{"license": {"id": "MIT"}}]
    given = {"specVersion": "1.6", "components": [component("a-b", "1"), component("c", "2"), component("d", "1", 0)]}
    bom = merged(given, {"components": [{"name": "A_B", "licenses": licence}]})
    assert bom["components"][0]["licenses"] == licence
    assert missing(bom, pins("A.B==1\nc==3\nd==1\ne==1\n")) == ["c==3", "d==1", "e==1"]
    assert missing(bom, pins("a_b==1\nc==2\n")) == []
