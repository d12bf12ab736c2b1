# SPDX-License-Identifier: Apache-2.0
"""The wheel in an empty environment, away from the checkout, of which nothing is read: `make test-wheel`.

The tests run in their order: the first ones use the kernels of the wheel, then they are compiled.
"""

import json
import os
import re
import shutil
import subprocess
import sys
import venv
from dataclasses import dataclass
from pathlib import Path

import pytest

from shared.repeatable import is_portable
from zenav.stack.prebuilt_kernels import ARCHIVE

ROOT = Path(__file__).resolve().parents[2]
RECORDING = ROOT / "tests" / "replay" / "recordings" / "driving.mcap"
NO_INDEX = "No matching distribution", "Could not find a version", "Connection", "Temporary failure"
pytestmark = [pytest.mark.slow, pytest.mark.timeout(1200)]

WATCH = """
import os, sys

def refuse(event, arguments):
    if event in ("open", "os.listdir", "os.scandir") and isinstance(arguments[0], (str, os.PathLike)):
        path = os.path.realpath(os.path.join(os.getcwd(), arguments[0]))
        if path.startswith({root!r} + os.sep):
            sys.stderr.write(f"read from the checkout: {{path}}\\n")
            os._exit(97)

sys.addaudithook(refuse)
"""
"""Put into the environment as sitecustomize: each of its processes ends where it reads from the checkout."""


@dataclass(frozen=True)
class Installed:
    """An environment with nothing but the wheel, a home folder, and a folder to work in."""

    environment: Path
    home: Path
    work: Path

    @property
    def packages(self) -> Path:
        return next(self.environment.glob("lib/python*/site-packages"))

    @property
    def cache(self) -> Path:
        return self.home / ".cache" / "zenav" / "kernels"

    @property
    def kernels(self) -> set[Path]:
        return {path.relative_to(self.cache) for path in self.cache.rglob("*.nbc")}

    def run(self, *command: str, status: int = 0) -> subprocess.CompletedProcess[str]:
        bin_ = self.environment / "bin"
        variables = {"PATH": f"{bin_}:/usr/bin:/bin", "HOME": str(self.home), "LANG": "C.UTF-8"}
        done = subprocess.run(
            [str(bin_ / command[0]), *command[1:]], cwd=self.work, env=variables, capture_output=True, text=True
        )
        assert done.returncode == status, done.stdout + done.stderr
        return done


@pytest.fixture(scope="module")
def wheel(tmp_path_factory):
    """The wheel, built from a copy of what the source distribution holds, with the kernels of the checkout."""
    folder = tmp_path_factory.mktemp("dist")
    build = f"from setuptools.build_meta import build_sdist; print(build_sdist({str(folder)!r}))"
    source = subprocess.run([sys.executable, "-c", build], cwd=ROOT, capture_output=True, text=True)
    assert source.returncode == 0, source.stderr
    shutil.unpack_archive(next(folder.glob("*.tar.gz")), folder, filter="data")
    unpacked = next(path for path in folder.iterdir() if path.is_dir())
    collecting = [sys.executable, "-m", "zenav.stack.warm", str(unpacked / ARCHIVE)]
    assert subprocess.run(collecting, cwd=ROOT, capture_output=True).returncode == 0
    build = f"from setuptools.build_meta import build_wheel; build_wheel({str(folder)!r})"
    made = subprocess.run([sys.executable, "-c", build], cwd=unpacked, capture_output=True, text=True)
    assert made.returncode == 0, made.stderr
    return next(folder.glob("*.whl"))


@pytest.fixture(scope="module")
def installed(wheel, tmp_path_factory):
    place = tmp_path_factory.mktemp("empty")
    here = Installed(place / "venv", place / "home", place / "work")
    here.home.mkdir()
    here.work.mkdir()
    venv.create(here.environment, with_pip=True)
    command = [str(here.environment / "bin" / "pip"), "install", "-q", "-c", str(ROOT / "requirements.txt"), str(wheel)]
    outside = {name: value for name, value in os.environ.items() if name != "PYTHONPATH"}  # noqa: TID251
    done = subprocess.run(command, capture_output=True, text=True, env=outside, cwd=here.work)
    if done.returncode and any(words in done.stderr for words in NO_INDEX):
        pytest.skip("pip reaches no package index")
    assert done.returncode == 0, done.stderr
    (here.packages / "sitecustomize.py").write_text(WATCH.format(root=str(ROOT)))
    shutil.copy(RECORDING, here.work)
    return here


def test_nothing_of_the_checkout_is_read(installed):
    code = f"open({str(ROOT / 'README.md')!r})"
    assert "read from the checkout" in installed.run("python", "-c", code, status=97).stderr


def test_robot_files_are_listed_and_copied(installed):
    of_checkout = sorted(path.stem for path in (ROOT / "shared" / "robots").glob("*.yaml"))
    assert [line.split()[0] for line in installed.run("zenav", "robots").stdout.splitlines()] == of_checkout
    installed.run("zenav", "robot", "new", "rover", "--from", "jackal")
    assert "valid" in installed.run("zenav", "config", "check", "--robot", "rover").stdout
    assert "here: rover.yaml" in installed.run("zenav", "robots").stdout


def test_a_hint_names_a_page_that_is_there(installed):
    text = installed.run("zenav", "robot", "new", "other").stdout and (installed.work / "other.yaml").read_text()
    (page,) = re.findall(r"every setting is in (\S+)", text)
    assert "# Configuration" in (installed.work / page).read_text()


def test_a_service_says_how_it_is_started(installed):
    assert "--robot" in installed.run("python", "-P", "-m", "services.mapper", "--help").stdout


def test_the_first_demo_drives_by_the_kernels_of_the_wheel(installed):
    done = installed.run("zenav", "demo", "--world", "room", "--headless", "--seconds", "300")
    assert ("compiling" not in done.stderr) is is_portable()
    assert installed.kernels
    assert not list(installed.packages.rglob("*.nb[ic]"))  # it may be read-only
    (summary,) = installed.work.glob("out/demo-*/summary.json")
    assert json.loads(summary.read_text())["summary"]["collisions"] == 0


def test_what_is_compiled_again_serves_the_next_start(installed):
    installed.run("zenav", "warm", "--again", "--set", "sim.world=room")
    before = installed.kernels
    assert before
    too_short = "zenav", "demo", "--world", "room", "--headless", "--seconds", "5"
    done = installed.run(*too_short, status=1)
    assert "compiling" not in done.stderr
    assert installed.kernels == before


def test_a_log_becomes_a_map(installed):
    installed.run("zenav", "slam", "driving.mcap", "--out", "mapped")
    assert (installed.work / "mapped" / "map.pgm").is_file()


def test_the_doctor_finds_every_package(installed):
    rows = installed.run("zenav", "doctor").stdout.splitlines()
    assert any(row.split()[:2] == ["packages", "ok"] for row in rows)
