# SPDX-License-Identifier: Apache-2.0
"""Every command that README and guides show is one: it parses, its target or container exists, its links lead on."""

import re
import shlex
from pathlib import Path

import pytest
import typer
from ruamel.yaml import YAML

from zenav.cli.commands import all_commands

ROOT = Path(__file__).resolve().parents[2]
NAMES = (
    "install",
    "new_service",
    "hardware",
    "calibration",
    "benchmarks",
    "maps",
    "local_control",
    "planner",
    "runtime_settings",
    "wire",
)
GUIDES = [ROOT / "README.md", *(ROOT / "docs" / f"{name}.md" for name in NAMES)]
RECORDINGS = ROOT / "docs" / "recordings.md"  # speaks of commands within its lines too; what it runs stands alone
SHOWN = [
    (page, command.strip())
    for page in GUIDES
    for found in re.finditer(r"^    (.+)$|`([^`\n]+)`", page.read_text(encoding="utf-8"), re.M)
    for command in [(found[1] or found[2]).partition("#")[0]]
] + [
    (RECORDINGS, re.split(r"#|&|\||>", found[1])[0].strip())
    for found in re.finditer(r"^    (?:\$ )?(zenav .+)$", RECORDINGS.read_text(encoding="utf-8"), re.M)
]


def shown(program: str) -> list[str]:
    return sorted({command for _, command in SHOWN if command.startswith(f"{program} ")})


@pytest.mark.parametrize("command", shown("zenav"))
def test_a_zenav_command_parses(command, monkeypatch):
    words = shlex.split(command)
    if "--with" in words:  # a package of the guide, which is not installed here
        monkeypatch.setenv("ZENAV_WITH", words[words.index("--with") + 1])
    assert parses(words)


def parses(words: list[str]) -> bool:
    """True for a command, or a family of commands, spoken of as such. Raises typer's error otherwise."""
    arguments = words[1:]
    parsed = typer.main.get_command(all_commands())
    context = None
    while hasattr(parsed, "resolve_command"):
        if not arguments:
            return True
        context = parsed.make_context(parsed.name, list(arguments), parent=context)
        _, parsed, arguments = parsed.resolve_command(context, list(arguments))
    parsed.make_context(parsed.name, list(arguments), parent=context)
    return True


@pytest.mark.parametrize("command", shown("make"))
def test_a_make_target_exists(command):
    makefile = (ROOT / "Makefile").read_text(encoding="utf-8")
    for word in shlex.split(command)[1:]:
        assert "=" in word or re.search(rf"^{word}:.*## ", makefile, re.M)


@pytest.mark.parametrize("command", shown("docker"))
def test_a_container_or_image_exists(command):
    services = YAML(typ="safe").load(ROOT / "docker-compose.yml")["services"]
    _, family, *words = shlex.split(command)
    if family == "image":
        bases = re.findall(r"^FROM (\S+)", (ROOT / "Dockerfile").read_text(encoding="utf-8"), re.M)
        images = {service["image"] for service in services.values() if "image" in service} | set(bases)
        assert words[0] == "inspect"
        assert words[1:]
        assert set(words[1:]) <= images
        return
    assert family == "compose"
    while words[0] == "--profile":
        assert any(words[1] in service.get("profiles", ()) for service in services.values())
        words = words[2:]
    if "run" in words:
        assert words[:3] == ["run", "--rm", "cli"]
        assert parses(["zenav", *words[3:]])
    else:
        assert words[0] == "up"
        assert set(words[1:]) <= set(services)


@pytest.mark.parametrize("page", [*GUIDES, ROOT / "docs" / "architecture.md"], ids=lambda page: page.name)
def test_a_link_leads_to_a_file(page):
    for target in re.findall(r"(?<!!)\[[^\]]*\]\((?!http)([^)#]+)", page.read_text(encoding="utf-8")):
        assert (page.parent / target).exists(), target
