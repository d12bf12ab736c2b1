# SPDX-License-Identifier: Apache-2.0
"""A wheel's kernels: they load from another folder without compiling, and only on the kind of computer they are for."""

import json
import os
import shutil
import subprocess
import sys
from zipfile import ZipFile

import pytest

from shared.config import UserError
from shared.kernel_cache import ROOT
from zenav.stack import prebuilt_kernels as module
from zenav.stack.kernel_stamp import kernel_target, read_stamp
from zenav.stack.prebuilt_kernels import ARCHIVE, CONTENTS, collect, copy_prebuilt
from zenav.stack.warm import tasks_for, warm

COMPILED_ELSEWHERE = """
import json, os, sys
from zenav.stack import warm
from zenav.stack.prebuilt_kernels import copy_prebuilt

n_copied, times = len(copy_prebuilt(warm.cache_root())), warm.Times()
warm._work(warm.tasks_for("x80sv", [], ["navigator"]), times, lambda times: None)
print(json.dumps([str(warm.ROOT), n_copied, sorted(times.services), len(times.kernels)]))
"""


@pytest.fixture
def checkout(tmp_path):
    """A package with one kernel, and its archive."""
    cache = tmp_path / "site" / "services" / "planner" / "__pycache__"
    cache.mkdir(parents=True)
    (cache / "search.f-1.py311.nbi").write_bytes(b"index")
    (cache / "search.f-1.py311.1.nbc").write_bytes(b"code")
    (cache / "search.cpython-311.pyc").write_bytes(b"no kernel")
    (tmp_path / "site" / "zenav").mkdir()
    return tmp_path / "site"


def test_the_files_come_into_the_folders_where_numba_looks(checkout, tmp_path):
    from numba.core.caching import _CacheLocator

    assert collect(["planner"], checkout / ARCHIVE, checkout) == 1
    cache = tmp_path / "cache"
    assert copy_prebuilt(cache, checkout) == {"planner"}
    folder = cache / _CacheLocator.get_suitable_cache_subpath(str(checkout / "services" / "planner" / "search.py"))
    assert {path.name: path.read_bytes() for path in folder.iterdir()} == {
        "search.f-1.py311.nbi": b"index",
        "search.f-1.py311.1.nbc": b"code",
    }
    assert [path for path in cache.rglob("*") if path.is_file() and path.parent != folder] == []


@pytest.mark.parametrize("target", ["py3.10 numba 0.1 x86_64 x86-64-v3", "", None])
def test_another_computer_takes_none(checkout, tmp_path, target):
    collect(["planner"], checkout / ARCHIVE, checkout)
    with ZipFile(checkout / ARCHIVE, "w") as file:
        file.writestr(CONTENTS, json.dumps({"target": target, "warmed": ["planner"]}))
        file.writestr("services/planner/search.nbi", b"index")
    assert copy_prebuilt(tmp_path / "cache", checkout) == set()
    assert not (tmp_path / "cache").exists()


@pytest.mark.parametrize("damage", [b"", b"no archive"])
def test_a_damaged_archive_is_none(checkout, tmp_path, damage):
    (checkout / ARCHIVE).write_bytes(damage)
    assert copy_prebuilt(tmp_path / "cache", checkout) == set()


def test_a_kernel_that_was_damaged_in_the_archive_leaves_the_rest_to_the_compiler(checkout, tmp_path):
    path = checkout / "services" / "planner" / "__pycache__" / "search.f-1.py311.1.nbc"
    path.write_bytes(bytes(range(256)) * 100)
    collect(["planner"], checkout / ARCHIVE, checkout)
    whole = (checkout / ARCHIVE).read_bytes()
    with ZipFile(checkout / ARCHIVE) as file:
        begin = next(info.header_offset for info in file.infolist() if info.filename.endswith(".nbc")) + 80
    (checkout / ARCHIVE).write_bytes(whole[:begin] + b"\xff" * 150 + whole[begin + 150 :])
    assert copy_prebuilt(tmp_path / "cache", checkout) == set()
    assert not list((tmp_path / "cache").rglob("*.nb[ic]"))


def test_a_checkout_never_takes_its_own_archive(checkout):
    collect(["planner"], checkout / ARCHIVE, checkout)
    assert copy_prebuilt(checkout, checkout) == set()


def test_kernels_of_one_processor_alone_are_not_given_away(checkout, tmp_path, monkeypatch):
    collect(["planner"], checkout / ARCHIVE, checkout)
    monkeypatch.delenv("NUMBA_CPU_NAME", raising=False)
    assert copy_prebuilt(tmp_path / "cache", checkout) == set()
    assert collect(["planner"], checkout / ARCHIVE, checkout) == 0
    assert not (checkout / ARCHIVE).exists()


def test_a_cache_that_cannot_be_written_is_told_in_one_line(checkout, tmp_path):
    collect(["planner"], checkout / ARCHIVE, checkout)
    (tmp_path / "cache").touch()
    with pytest.raises(UserError, match="cannot copy kernels"):
        copy_prebuilt(tmp_path / "cache", checkout)


def test_the_first_start_copies_them_and_compiles_the_rest(tmp_path, monkeypatch):
    cache = tmp_path / "cache"
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(cache))
    from zenav.stack import warm as warming

    planner, driver = (tasks_for("x80sv", [], [name])[0] for name in ("planner", "base_driver"))
    compiled, copied = [], []
    monkeypatch.setattr(warming, "_work", lambda due, times, show: compiled.extend(task.service for task in due))
    monkeypatch.setattr(warming, "copy_prebuilt", lambda cache: copied.append(cache) or {planner.key})
    warm([planner])
    assert (compiled, copied) == ([], [cache])
    warm([planner, driver])
    assert (compiled, copied) == (["base_driver"], [cache])
    assert {planner.key, driver.key} <= read_stamp(cache, warming.code_digest())
    warm([planner], again=True)
    assert (compiled, copied) == (["base_driver", "planner"], [cache])


def test_an_installed_copy_of_this_checkout_compiles_nothing(tmp_path):
    """The sources lie elsewhere, as in an environment, and numba takes each kernel from the copy."""
    if not module.is_portable():
        pytest.skip("only kernels of x86-64 with AVX2 serve other processors")
    site = tmp_path / "site"
    leave = shutil.ignore_patterns("__pycache__", "static", "*.zip")
    for package in ("services", "shared", "zenav"):
        shutil.copytree(ROOT / package, site / package, ignore=leave)
    assert collect(["every"], site / ARCHIVE) > 100
    environment = {**os.environ, "NUMBA_CACHE_DIR": str(tmp_path / "cache"), "PYTHONPATH": str(site)}  # noqa: TID251
    command = [sys.executable, "-P", "-c", COMPILED_ELSEWHERE]
    done = subprocess.run(command, capture_output=True, text=True, env=environment, cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    assert json.loads(done.stdout) == [str(site), 1, ["navigator"], 0]
    assert kernel_target() in json.loads(ZipFile(site / ARCHIVE).read(CONTENTS))["target"]
