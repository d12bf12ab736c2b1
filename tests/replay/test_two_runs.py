# SPDX-License-Identifier: Apache-2.0
"""`zenav replay --through`: another setting against the recorded one, another processor, and what cannot be asked."""

import io
import os
import platform
import subprocess
import sys
from collections.abc import Callable
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from shared.recording import CONFIG, Recording, Writer
from tests.replay.record import path_of
from zenav.__main__ import _status
from zenav.metrics.run_metrics import comparison_table, run_differences, run_from_entries, run_metrics

FILE = path_of("driving")
ROOT = Path(__file__).resolve().parents[2]
NOISE = "mapper.registration.noise=0.2"

pytestmark = pytest.mark.timeout(600)  # with an empty cache the kernels are compiled here


def run(*arguments: object) -> int:
    return _status(["replay", str(FILE), *map(str, arguments)])


def row(lines: list[str], name: str) -> list[str]:
    """What follows a name in the line that begins with it."""
    return next(line for line in lines if line.startswith(name)).removeprefix(name).split()


def test_another_setting_is_compared_in_figures_message_by_message_and_as_a_picture(tmp_path, capsys):
    again, noisy, picture = tmp_path / "again.mcap", tmp_path / "noisy.mcap", tmp_path / "a.png"
    assert run("--through", "mapper", "--out", again) == 0
    assert run("--through", "mapper", "--out", noisy, "--set", NOISE, "--against", again, "--picture", picture) == 1
    told = capsys.readouterr().out.splitlines()
    before, now, change = map(float, row(told, "pose path, m "))
    assert now - before == pytest.approx(change, rel=0.01)
    assert change
    assert 0 < float(row(told, "pose apart most, m:")[0]) < 0.1
    assert any(line.startswith("mapper on_constraints: ") for line in told)
    image = np.asarray(Image.open(io.BytesIO(picture.read_bytes())))
    assert (image == (240, 150, 30)).all(axis=-1).sum() > 20  # cells that differ
    assert b"noise: 0.2" in Recording(noisy).attachments[CONFIG]
    assert b"noise: 0.2" not in Recording(again).attachments[CONFIG]
    assert _status(["replay", str(noisy), "--through", "mapper"]) == 0  # with its own configuration it repeats
    assert _status(["replay", str(again), "--against", str(noisy)]) == 1
    assert _status(["replay", str(again), "--against", str(again), "--compare"]) == 0


def test_within_a_tolerance_two_settings_are_alike(capsys):
    noisy = "--through", "mapper", "--set", NOISE, "--compare", "--tolerance", "map=100"
    assert run(*noisy, "--tolerance", "pose=1") == 0
    assert "within tolerance" in capsys.readouterr().out
    assert run(*noisy, "--tolerance", "pose=1", "--tolerance", "pose.map_from_base=0.0001") == 1
    told = capsys.readouterr().out
    assert "pose.map_from_base.x: " in told
    assert "map.cells" not in told
    assert "pose.quality" not in told


def test_figures_of_a_run_against_itself_do_not_differ():
    a = run_from_entries(Recording(FILE).entries())
    assert run_differences(a, a)["pose apart most, m"] == run_differences(a, a)["map differs, cells"] == 0
    assert comparison_table(run_metrics(a), run_metrics(a), ("a", "b"), only_changed=True)[1:] == []
    assert run_metrics(a)["truly driven, m"] == pytest.approx(run_metrics(a)["pose path, m"], rel=0.05)


def test_another_robot_s_configuration_can_be_taken_and_must_be_where_there_is_none(tmp_path, capsys):
    bare = tmp_path / "bare.mcap"
    with Writer(bare) as writer:
        for entry in Recording(FILE).entries():
            writer.copy(entry)
    assert _status(["replay", str(bare), "--through", "odometry"]) == 2
    assert "holds no configuration\nhint: name the robot" in capsys.readouterr().err
    assert _status(["replay", str(bare), "--through", "odometry", "--robot", "x80sv"]) == 0
    assert _status(["replay", str(FILE), "--through", "odometry", "--robot", "jackal"]) == 1


def test_a_foreign_recording_without_journals_goes_in_the_order_of_its_stamps_and_says_so(tmp_path, capsys):
    foreign = tmp_path / "foreign.mcap"
    with Writer(foreign) as writer:
        for entry in Recording(FILE).entries(["scan", "odom"]):
            writer.copy(entry)
    for name in "ab":
        out = tmp_path / f"{name}.mcap"
        assert _status(["replay", str(foreign), "--through", "mapper", "--robot", "x80sv", "--out", str(out)]) == 0
    assert "no journals: fed in the order of the stamps" in capsys.readouterr().err
    assert (tmp_path / "a.mcap").read_bytes() == (tmp_path / "b.mcap").read_bytes()
    assert (
        run_differences(run_from_entries(Recording(FILE).entries()), run_from_entries(Recording(out).entries()))[
            "pose apart most, m"
        ]
        < 0.1
    )


def test_two_runs_without_maps_are_no_picture(tmp_path, capsys):
    bare = tmp_path / "bare.mcap"
    with Writer(bare) as writer:
        for entry in Recording(FILE).entries(["odom"]):
            writer.copy(entry)
    assert _status(["replay", str(bare), "--against", str(bare), "--picture", str(tmp_path / "a.png")]) == 2
    assert "no two maps" in capsys.readouterr().err


OTHERS = {
    "numpy without AVX2": ({"NPY_DISABLE_CPU_FEATURES": "X86_V3 X86_V4 AVX512_ICL AVX512_SPR"}, ()),
    "numpy with all that is there": ({"NPY_DISABLE_CPU_FEATURES": ""}, ("plan=1e-9",)),
    "OpenBLAS without FMA": ({"OPENBLAS_CORETYPE": "Prescott"}, ("odom.covariance=1e-12", "pose.covariance=1e-12")),
    "kernels for the oldest x86-64": ({"NUMBA_CPU_NAME": "generic"}, ()),
}
"""By name: another processor's environment, and how far a replay there may be off."""


@pytest.fixture(scope="module")
def here(tmp_path_factory) -> Callable[[str], Path]:
    """What comes out of services here; made once for each list of them."""

    @cache
    def of(names: str) -> Path:
        out = tmp_path_factory.mktemp("here") / "out.mcap"
        assert run("--through", names, "--out", out) in (0, 1)
        return out

    return of


@pytest.mark.skipif(platform.machine() != "x86_64", reason="these are features of x86-64 processors")
@pytest.mark.parametrize("other", OTHERS)
def test_a_replay_on_another_processor_gives_the_same_bytes_or_what_is_stated(other, here):
    environment, tolerances = OTHERS[other]
    names = "odometry,navigator" if "NUMBA_CPU_NAME" in environment else ",".join(Recording(FILE).lives())  # compiling
    options = [word for tolerance in tolerances for word in ("--tolerance", tolerance)]
    command = [sys.executable, "-m", "zenav", "replay", FILE, "--through", names, "--against", here(names)]
    done = subprocess.run(
        [*command, *options],
        cwd=ROOT,
        env={**os.environ, **environment},  # noqa: TID251  # another processor is an environment
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0, done.stdout + done.stderr


@pytest.mark.parametrize(
    ("arguments", "what", "hint"),
    [
        (["--through", "mapper", "--set", "mapper.registration.nois=1"], "nois is not a setting", "`noise`"),
        (["--through", "mapper", "--set", "mapper.registration.noise=x"], "mapper.registration.noise", "m"),
        (["--through", "mapper", "--set", "guard.x=1"], "guard is not replayed", "--through mapper,guard"),
        (["--through", "maper"], "maper is not a service", "`mapper`"),
        (["--through", "recorder"], "no journal of recorder", ""),
        (["--set", NOISE], "--set is for services", "--through"),
        (["--pdb"], "--pdb is for services", "--through"),
        (["--tolerance", "pose=1"], "--tolerance is for a comparison", "--against"),
        (["--through", "mapper", "--picture", "a.png"], "--picture shows two runs", "--against"),
        (["--through", "mapper", "--rate", "2"], "playing onto Zenoh", "leave out"),
        (["--through", "mapper", "--against", "nowhere.mcap"], "no recording nowhere.mcap", "path"),
        (["--through", "mapper", "--tolerance", "poze=1"], "poze is not a topic", "`pose`"),
        (["--topics", "scn"], "no topic scn", "`scan`"),
        (["--topics", "cmd/vel"], "cmd/vel is not played: robots obey it", "--commands"),
        (["--start", "99"], "nothing lies between", "s long"),
        (["--rate", "0"], "--rate", "--help"),
        (["--remap", "scan=odom"], "LaserScan", "choose"),
    ],
)
def test_what_cannot_be_asked_is_one_line_and_a_hint(arguments, what, hint, capsys):
    assert run(*arguments) == 2
    out, err = capsys.readouterr()
    assert out == ""
    first, second = err.splitlines()
    assert what in first
    assert second.startswith("hint: ")
    assert hint in second
