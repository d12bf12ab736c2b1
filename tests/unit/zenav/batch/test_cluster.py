# SPDX-License-Identifier: Apache-2.0
"""`zenav batch replay` and a benchmark's items on a real cluster: a scheduler and a worker, each a process."""

import socket
import subprocess
import sys
import threading
import time
from contextlib import ExitStack
from pathlib import Path

import pytest

from shared.config import UserError
from tests.replay.record import path_of
from tests.unit.zenav.batch.works import double, misbehave
from zenav.__main__ import _status
from zenav.batch.storage import Folder
from zenav.batch.table import last_table
from zenav.bench.process_pool import pool_results

LIMIT_S = 60.0
ROOT = Path(__file__).parents[4]  # workers import works.py


@pytest.fixture
def cluster(tmp_path):
    """The address of a scheduler with one worker."""
    with socket.create_server(("127.0.0.1", 0)) as probe:
        address = f"tcp://127.0.0.1:{probe.getsockname()[1]}"
    scheduler = ["dask_scheduler", "--host", address, "--no-dashboard"]
    worker = ["dask_worker", address, "--nthreads", "1", "--no-dashboard", "--no-nanny", "--host", "127.0.0.1"]
    worker += ["--local-directory", str(tmp_path)]
    with ExitStack() as open_things, (tmp_path / "cluster.log").open("w") as log:
        for program, *options in (scheduler, worker):
            command = [sys.executable, "-m", f"distributed.cli.{program}", *options]
            process = subprocess.Popen(command, stdout=log, stderr=log, cwd=ROOT)
            open_things.enter_context(process)
            open_things.callback(process.kill)
        yield address


def test_a_replay_on_a_cluster_is_equal_and_the_second_run_computes_nothing(cluster, tmp_path, capsys):
    command = ["batch", "replay", str(path_of("driving")), "--through", "guard", "--out", str(tmp_path / "out")]
    limit = time.monotonic() + LIMIT_S
    while _status([*command, "--cluster", cluster]) == 2:  # until a worker is there
        assert time.monotonic() < limit, capsys.readouterr().err
        threading.Event().wait(0.5)
    (row,) = last_table(Folder(str(tmp_path / "out")))
    assert (row["state"], row["different"], row["lacking"], row["cached"]) == ("done", 0, 0, False)
    assert row["equal"] == row["messages"] > 100
    assert _status([*command, "--cluster", cluster]) == 0
    (again,) = last_table(Folder(str(tmp_path / "out")))
    assert (again["cached"], again["digest"]) == (True, row["digest"])


def test_a_benchmark_s_items_have_the_same_results_on_a_cluster_and_a_dead_one_is_named(cluster):
    limit = time.monotonic() + LIMIT_S
    here = list(pool_results(double, range(5), 1))
    there: list[int] = []
    while not there:
        assert time.monotonic() < limit
        try:
            there = list(pool_results(double, range(5), 1, cluster))
        except UserError:  # until a worker is there
            threading.Event().wait(0.5)
    assert sorted(there) == here
    with pytest.raises(UserError, match="killed by SIGKILL"):
        list(pool_results(misbehave, ["die"], 1, cluster))
