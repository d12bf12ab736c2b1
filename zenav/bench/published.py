# SPDX-License-Identifier: Apache-2.0
"""docs/figures.json: what was measured when, on which commit, machine and load. `zenav bench figures` writes it."""

import hashlib
import json
import os
import platform
import subprocess
from dataclasses import asdict, dataclass, field
from pathlib import Path

from shared.config import UserError
from shared.ros_map import replace_file
from zenav.bench.figure_cells import Cells

ROOT = Path(__file__).resolve().parents[2]
FILE = ROOT / "docs" / "figures.json"
CODE = "services", "shared", "zenav", "requirements.txt"
"""What figures depend on: a commit that changes none of it leaves them as they are."""
WORDS = "zenav/bench/figure"
"""Files that begin so only choose and write rows; they are no part of what is measured."""


@dataclass(frozen=True, slots=True)
class CheckoutState:
    """The checkout. code: a digest of the committed CODE; dirty: there are changes of it that are not committed."""

    commit: str
    code: str
    dirty: bool


@dataclass(frozen=True, slots=True)
class PublishedFigure:
    """One row as it was measured.

    began, ended: UTC.  load: the machine's load average of a minute, at the begin and at the end; seconds: of running,
    all parts.  kept: whether every part met its own targets.
    """

    command: str
    cells: Cells
    commit: str
    ended: str
    code: str = ""
    dirty: bool = False
    began: str = ""
    seconds: float = 0.0
    machine: str = ""
    load: tuple[float, ...] = field(default=())
    kept: bool = True


Published = dict[str, PublishedFigure]


def load_published(path: Path = FILE) -> Published:
    """All rows by name; none where there is no file. Raises UserError where it is damaged."""
    if not path.exists():
        return {}
    try:
        tree = json.loads(path.read_text(encoding="utf-8"))
        return {name: PublishedFigure(**row | {"load": tuple(row["load"])}) for name, row in tree.items()}
    except (OSError, ValueError, TypeError, KeyError, AttributeError) as error:
        raise UserError(f"{path} is damaged: {error}", "git checkout it") from None


def save_published(published: Published, path: Path = FILE) -> None:
    """Writes all rows, sorted by name. Raises UserError where the file refuses."""
    tree = {name: asdict(published[name]) for name in sorted(published)}
    try:
        replace_file(path, (json.dumps(tree, indent=1) + "\n").encode())
    except OSError as error:
        raise UserError(f"cannot write {path}: {error.strerror}", "check the folder and the disk") from None


def checkout_state(root: Path = ROOT) -> CheckoutState:
    """The checkout's state. Raises UserError where there is no git."""
    if not (root / ".git").exists():
        raise UserError("no commit to measure", "run it in a git checkout of zenav")
    tree = _git(root, "ls-tree", "-r", "HEAD", "--", *CODE).splitlines()
    code = "\n".join(line for line in tree if not line.partition("\t")[2].startswith(WORDS))
    changed = [line[3:] for line in _git(root, "status", "--porcelain", "--", *CODE).splitlines()]
    dirty = any(not name.startswith(WORDS) for name in changed)
    return CheckoutState(
        _git(root, "rev-parse", "--short=7", "HEAD").strip(), hashlib.sha1(code.encode()).hexdigest(), dirty
    )


def _git(root: Path, *arguments: str) -> str:
    try:
        return subprocess.run(("git", *arguments), cwd=root, check=True, capture_output=True, text=True).stdout
    except (OSError, subprocess.CalledProcessError) as error:
        message = getattr(error, "stderr", "") or str(error)
        raise UserError(f"no commit to measure: {message.strip()}", "run it in a git checkout of zenav") from None


def machine() -> str:
    """Processor, cores and Python of this machine."""
    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
    except OSError:
        lines = []
    model = next((line.partition(":")[2].strip() for line in lines if line.startswith("model name")), "")
    cores = os.cpu_count() or 1
    return f"{model or platform.machine()}, {cores} core{'s' * (cores > 1)}, Python {platform.python_version()}"
