# SPDX-License-Identifier: Apache-2.0
"""Compiled kernels of an installed package lie in the user's cache, and two processes may save at the same time."""

import threading
import time
from pathlib import Path

import numba  # noqa: F401  # what is not imported is not serialized
import pytest
from numba.core.caching import IndexDataCacheFile

from shared.kernel_cache import ROOT, installed_cache, serialize_saves


@pytest.fixture
def installed(tmp_path):
    record = tmp_path / "site-packages" / "zenav-1.2.3.dist-info" / "RECORD"
    record.parent.mkdir(parents=True)
    record.write_text("shared/a.py,sha256=1,1\n")
    return record


def test_a_checkout_keeps_its_kernels_beside_the_code(installed):
    assert installed_cache(ROOT) is None
    (installed.parents[1] / "pyproject.toml").touch()
    assert installed_cache(installed.parents[1]) is None


def test_an_installed_package_keeps_its_kernels_in_the_users_cache_by_its_contents(installed, tmp_path, monkeypatch):
    monkeypatch.setenv("HOME", str(tmp_path / "home"))
    monkeypatch.delenv("XDG_CACHE_HOME", raising=False)
    first = installed_cache(installed.parents[1])
    assert first.parent == tmp_path / "home" / ".cache" / "zenav" / "kernels"
    assert first.name.startswith("1.2.3-")
    installed.write_text("shared/a.py,sha256=2,1\n")  # the same version, other code
    assert installed_cache(installed.parents[1]) != first
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "xdg"))
    assert installed_cache(installed.parents[1]).is_relative_to(tmp_path / "xdg")
    monkeypatch.setenv("XDG_CACHE_HOME", "relative")  # the standard: to be ignored
    assert installed_cache(installed.parents[1]).is_relative_to(tmp_path / "home")


def test_signatures_that_are_saved_at_the_same_time_keep_their_own_code(tmp_path, monkeypatch):
    serialize_saves()
    serialize_saves()  # once is enough
    save_index = IndexDataCacheFile._save_index

    def slow_save_index(self, overloads):
        time.sleep(0.002)  # noqa: TID251  # the other one reads the index meanwhile
        save_index(self, overloads)

    monkeypatch.setattr(IndexDataCacheFile, "_save_index", slow_save_index)

    def save(prefix):
        file = IndexDataCacheFile(str(tmp_path), "kernel-1.py311", "stamp")
        for i in range(10):
            file.save((prefix, i), f"code of {prefix} {i}")

    threads = [threading.Thread(target=save, args=(prefix,)) for prefix in "ab"]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    file = IndexDataCacheFile(str(tmp_path), "kernel-1.py311", "stamp")
    assert [file.load((p, i)) for p in "ab" for i in range(10)] == [f"code of {p} {i}" for p in "ab" for i in range(10)]
    assert len(list(Path(tmp_path).glob("*.nbc"))) == 20
