# SPDX-License-Identifier: Apache-2.0
"""`zenav batch --against v0.1.0`: the same work by the code of another revision of this checkout, to compare with."""

import io
import os
import subprocess
import sys
import tarfile
from pathlib import Path
from tempfile import TemporaryDirectory

from shared.config import UserError
from shared.kernel_cache import ROOT
from zenav.batch.child_process import TryLimits
from zenav.batch.work import SlamWork, Work

CODE = "services", "shared", "zenav", "pyproject.toml"


def commit_of(revision: str) -> str:
    """The commit that a tag, branch or hash names in the checkout of this code; empty where it names none."""
    if not revision or revision.startswith("-") or not (ROOT / ".git").exists():
        return ""
    command = ["git", "-C", str(ROOT), "rev-parse", "--verify", "--quiet", f"{revision}^{{commit}}"]
    try:
        return subprocess.run(command, capture_output=True, text=True, check=False).stdout.strip()
    except OSError:  # no git here
        return ""


def run_revision(commit: str, work: Work, inputs: list[str], out: str, jobs: int, limits: TryLimits) -> str:
    """Runs the work by the code of a commit, with the packages of this environment. Returns the place of its table.

    A second run computes only what changed, too: its results are kept in `out`. Raises UserError.
    """
    place = f"{out}/revisions/{commit[:12]}"
    command = ["git", "-C", str(ROOT), "archive", commit, *CODE]
    archive = subprocess.run(command, capture_output=True, check=False)
    if archive.returncode:
        raise UserError(
            f"{commit[:12]} is no revision of zenav", "name another one: zenav batch slam --against REVISION"
        )
    with TemporaryDirectory(prefix="zenav-") as folder:
        with tarfile.open(fileobj=io.BytesIO(archive.stdout)) as files:
            files.extractall(folder, filter="data")
        if not (Path(folder) / "zenav" / "batch").is_dir():
            hint = f"run zenav slam or zenav replay in a checkout of {commit[:12]}"
            raise UserError(f"{commit[:12]} is older than zenav batch", hint)
        sys.stderr.write(f"the same by {commit[:12]}\n")
        status = subprocess.run(
            [sys.executable, "-m", "zenav", "batch", *_arguments(work), *_limit_arguments(limits),
             "--jobs", str(jobs), "--out", place, "--", *inputs],
            env={**os.environ, "PYTHONPATH": folder, "PYTHONSAFEPATH": "1"},  # noqa: TID251  # the other code comes first
            stdout=subprocess.DEVNULL, check=False,
        ).returncode  # fmt: skip
    if status not in (0, 1):  # 1: a recording did not come through, which its table says
        raise UserError(f"zenav batch of {commit[:12]} ends with status {status}", "its reason stands above")
    return place


def _arguments(work: Work) -> list[str]:
    if isinstance(work, SlamWork):
        options = {
            "registrar": work.registrar,
            "topic-scan": work.topic_scan,
            "topic-odom": work.topic_odom,
            "base-frame": work.base_frame,
            "odom-frame": work.odom_frame,
        }
        return ["slam", *(f"--{name}={value}" for name, value in options.items() if value)]
    return [
        "replay",
        *(f"--through={name}" for name in work.services),
        *([f"--robot={work.robot}"] if work.robot else []),
        *(f"--set={setting}" for setting in work.settings),
    ]


def _limit_arguments(limits: TryLimits) -> list[str]:
    return [f"--timeout={limits.timeout}", f"--memory={limits.memory / 1e6}", f"--tries={limits.tries}"]
