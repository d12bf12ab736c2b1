# SPDX-License-Identifier: Apache-2.0
"""`zenav bench quota`: the group limits a process that would take a whole core, and leaves nothing behind."""

import subprocess
import sys
import time

import pytest

from shared.config import UserError
from zenav.bench.quota import cpu_group


@pytest.fixture
def group():
    try:
        with cpu_group(0.1) as group:
            yield group
    except UserError as error:
        pytest.skip(f"no control group: {error.what}")


def test_a_busy_process_is_throttled(group):
    busy = subprocess.Popen([sys.executable, "-c", "while True: pass"])
    try:
        group.add(busy.pid)
        group.add(busy.pid)  # once is enough
        assert str(busy.pid) in (group.folder / "cgroup.procs").read_text().split()
        while not group.throttled_share():
            time.sleep(0.01)  # noqa: TID251  # a period has 20 ms
    finally:
        busy.kill()
        busy.wait()


def test_a_process_that_has_ended_is_no_error(group):
    ended = subprocess.Popen(["true"])
    ended.wait()
    group.add(ended.pid)
    assert (group.folder / "cgroup.procs").read_text() == ""


def test_the_group_is_gone_after_its_block():
    try:
        with cpu_group(0.5) as group:
            assert group.folder.is_dir()
    except UserError as error:
        pytest.skip(f"no control group: {error.what}")
    assert not group.folder.exists()


def test_where_it_cannot_be_made_one_line_says_so(monkeypatch, tmp_path):
    monkeypatch.setattr("zenav.bench.quota.ROOT_V1", tmp_path / "none")
    monkeypatch.setattr("zenav.bench.quota.ROOT_V2", tmp_path / "missing")
    with pytest.raises(UserError, match="cannot limit the CPU"), cpu_group(0.5):
        pass
