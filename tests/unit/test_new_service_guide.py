# SPDX-License-Identifier: Apache-2.0
"""docs/new_service.md, followed to the letter in a copy of the project: what it shows works and breaks no rule."""

import re
import shutil
import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
GUIDE = ROOT / "docs" / "new_service.md"
STEP = re.compile(
    r'^<!-- (append|write|below "(?P<line>[^\n]+?)"): (?P<file>\S+) -->\n```python\n(?P<code>.*?)```$', re.M | re.S
)


def followed(project: Path) -> list[str]:
    """Does what the guide says; the files that it wrote or changed."""
    changed = []
    for found in STEP.finditer(GUIDE.read_text(encoding="utf-8")):
        what, path, code = found[1], project / found["file"], found["code"]
        changed.append(found["file"])
        if what == "write":
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_text(code, encoding="utf-8")
        elif what == "append":
            path.write_text(f"{path.read_text(encoding='utf-8')}\n\n{code}", encoding="utf-8")
        else:
            lines = path.read_text(encoding="utf-8").splitlines(keepends=True)
            (i,) = (i for i, line in enumerate(lines) if line.strip().startswith(found["line"].strip()))
            path.write_text("".join([*lines[: i + 1], code, *lines[i + 1 :]]), encoding="utf-8")
    return changed


def test_the_guide_to_a_new_service_works_as_written(tmp_path, monkeypatch):
    for name in ("shared", "services", "zenav", "docs", "tests", "README.md", "pyproject.toml"):
        source = ROOT / name
        if source.is_dir():
            shutil.copytree(source, tmp_path / name, ignore=shutil.ignore_patterns("__pycache__", "stack", "docker"))
        else:
            shutil.copy(source, tmp_path / name)
    changed = followed(tmp_path)
    assert len(changed) == 8
    monkeypatch.setenv("PYTHONPATH", str(tmp_path))

    def run(*arguments: str) -> None:
        command = [sys.executable, "-m", *arguments]
        done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True)
        assert done.returncode == 0, done.stdout + done.stderr

    run("ruff", "check", *changed)
    run("ruff", "format", "--check", *(name for name in changed if name.startswith(("services/", "tests/"))))
    run("zenav.docs")
    run("pytest", "-p", "no:cacheprovider", "tests/test_architecture.py", "tests/unit/services/mileage")
