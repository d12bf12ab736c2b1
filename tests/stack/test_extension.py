# SPDX-License-Identifier: Apache-2.0
"""A package of a user with a service and a topic of its own: started, recorded, shown and replayed like the others."""

import os
import re
import signal
import subprocess
import sys
import time
from contextlib import contextmanager
from pathlib import Path

import pytest

from tests.stack.processes import wait
from zenav.stack.launch import ROOT, free_stack

GUIDE = ROOT / "docs" / "new_service.md"
PACKAGED = re.compile(r"^<!-- package: (?P<file>\S+) -->\n```\w*\n(?P<content>.*?)```$", re.M | re.S)
PACKAGE = "odometer"
LIMIT_S = 90.0


@pytest.fixture(scope="module")
def installed(tmp_path_factory) -> dict[str, str]:
    """The environment after the steps of the guide: the package, and what pip writes for its entry points."""
    folder = tmp_path_factory.mktemp("site")
    for found in PACKAGED.finditer(GUIDE.read_text(encoding="utf-8")):
        path = folder / found["file"]
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(found["content"], encoding="utf-8")
    project = (folder / "pyproject.toml").read_text(encoding="utf-8")
    about = folder / f"{PACKAGE}-0.1.dist-info"
    about.mkdir()
    (about / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {PACKAGE}\nVersion: 0.1\n", encoding="utf-8")
    points = re.sub(r'\[project\.entry-points\."(.+?)"\]', r"[\1]", project[project.index("[project.entry-points") :])
    (about / "entry_points.txt").write_text(points.replace('"', ""), encoding="utf-8")
    # a child's environment is made here
    return dict(os.environ, PYTHONPATH=f"{folder}{os.pathsep}{ROOT}")  # noqa: TID251


def zenav(environment: dict[str, str], folder: Path, *arguments: str) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-m", "zenav", *arguments]
    return subprocess.run(command, env=environment, cwd=folder, capture_output=True, text=True, timeout=LIMIT_S)


@contextmanager
def started(environment: dict[str, str], folder: Path, *arguments: str):
    command = [sys.executable, "-m", "zenav", "up", *arguments]
    with subprocess.Popen(command, env=environment, cwd=folder, stderr=subprocess.PIPE, text=True) as process:
        try:
            yield process
            process.send_signal(signal.SIGINT)
            process.communicate(timeout=30)
        finally:
            process.kill()


def test_a_service_of_a_package_is_started_shown_recorded_and_replayed_to_the_byte(installed, tmp_path):
    with free_stack() as claim:
        number = str(claim.where.domain)
    services = "sim,base_driver,odometry,recorder,mileage"
    recording = tmp_path / "run.mcap"
    options = ("--world", "room", "--stack", number, "--no-dashboard", "--set", f"recorder.file={recording}")
    with started(installed, tmp_path, "--with", PACKAGE, "--only", services, *options) as process:
        lines = iter(process.stderr.readline, "")
        assert next(line for line in lines if "every service runs" in line or "mileage" in line)
        shown = ""
        limit = time.monotonic() + LIMIT_S
        with_package = {**installed, "ZENAV_WITH": PACKAGE}
        while "distance" not in shown and time.monotonic() < limit:
            shown = zenav(with_package, tmp_path, "topic", "echo", "mileage", "--once", "--stack", number).stdout
        assert "distance" in shown
        wait(3.0)
    again = zenav(installed, tmp_path, "replay", str(recording), "--with", PACKAGE, "--through", "mileage")
    assert again.returncode == 0, again.stdout + again.stderr
    assert re.search(r"^mileage +[1-9]\d* equal +0 different", again.stdout, re.M), again.stdout


def test_its_topics_and_settings_are_listed(installed, tmp_path):
    with_package = {**installed, "ZENAV_WITH": PACKAGE}
    assert "mileage" in zenav(with_package, tmp_path, "topic", "list").stdout
    assert "min_step" in zenav(with_package, tmp_path, "config", "show", "mileage").stdout
    assert "mileage" not in zenav(installed, tmp_path, "topic", "list").stdout


@pytest.mark.parametrize(
    ("name", "points", "words"),
    [
        ("absent", None, "no package absent is installed"),
        ("empty", "", "the package empty has no services for zenav"),
        ("clash", "[zenav.services]\nmapper = clash.mapper\n", "a package has a service mapper, as zenav has"),
    ],
)
def test_a_package_that_does_not_fit_is_one_line_with_a_hint(installed, tmp_path, name, points, words):
    if points is not None:
        about = tmp_path / f"{name}-1.dist-info"
        about.mkdir()
        (about / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {name}\nVersion: 1\n", encoding="utf-8")
        (about / "entry_points.txt").write_text(points, encoding="utf-8")
    environment = {**installed, "PYTHONPATH": f"{tmp_path}{os.pathsep}{ROOT}"}
    done = zenav(environment, tmp_path, "up", "--with", name, "--world", "room")
    assert done.returncode == 2
    assert words in done.stderr
    assert len(done.stderr.strip().splitlines()) == 2
