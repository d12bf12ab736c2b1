# SPDX-License-Identifier: Apache-2.0
"""The list of software of `make sbom`, CycloneDX JSON: `python -m tests.sbom REQUIREMENTS ENVIRONMENT OUT`.

cyclonedx-bom makes both inputs: of requirements.hashes.txt, with the hashes, and of .venv, with the licences.
"""

import json
import re
import sys
from pathlib import Path
from typing import Any

PIN = re.compile(r"^([\w.-]+)(?:\[\w+\])?==(\S+)", re.MULTILINE)


def normal_name(name: str) -> str:
    """A package's name as PEP 503 compares it."""
    return re.sub(r"[-_.]+", "-", name).lower()


def pins(text: str) -> dict[str, str]:
    """Versions by normal name, of a file of requirements."""
    return {normal_name(name): version for name, version in PIN.findall(text)}


def merged(requirements: dict[str, Any], environment: dict[str, Any]) -> dict[str, Any]:
    """The packages of the requirements, with description and licences of the environment."""
    installed = {normal_name(row["name"]): row for row in environment["components"]}
    components = []
    for row in requirements["components"]:
        about = installed.get(normal_name(row["name"]), {})
        kept = {key: about[key] for key in ("description", "licenses") if key in about}
        hashes = [entry for link in row.get("externalReferences", []) for entry in link.get("hashes", [])]
        plain = {key: row[key] for key in ("type", "bom-ref", "name", "version", "purl")}
        # not `hashes` of the component: a package has a file for each system, and each file its hash
        link = {"type": "distribution", "url": f"pkg:pypi/{row['name']}@{row['version']}", "hashes": hashes}
        components.append({**plain, **kept, "externalReferences": [link]})
    return {**requirements, "components": components}


def missing(bom: dict[str, Any], wanted: dict[str, str]) -> list[str]:
    """Pinned packages that are not in the list with their version, purl and hashes."""
    found = {
        normal_name(row["name"]): row["version"]
        for row in bom["components"]
        if row["purl"] and row["externalReferences"][0]["hashes"]
    }
    return [f"{name}=={version}" for name, version in wanted.items() if found.get(name) != version]


def main(requirements: str, environment: str, out: str) -> None:
    """Writes the list; ends with an error where a pinned package is missing."""
    bom = merged(json.loads(Path(requirements).read_text()), json.loads(Path(environment).read_text()))
    if lost := missing(bom, pins(Path("requirements.txt").read_text())):
        sys.exit(f"not in the list: {', '.join(lost)}\nhint: make lock")
    Path(out).parent.mkdir(parents=True, exist_ok=True)
    Path(out).write_text(json.dumps(bom, indent=1) + "\n")
    n = sum("licenses" in row for row in bom["components"])
    print(f"{out}: {len(bom['components'])} packages, {n} with their licence")


if __name__ == "__main__":
    main(*sys.argv[1:])
