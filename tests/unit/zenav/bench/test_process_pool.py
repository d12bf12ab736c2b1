# SPDX-License-Identifier: Apache-2.0
"""A benchmark that is interrupted leaves nothing running, however it ends."""

import os
import signal
import subprocess
import sys
import threading

import psutil
import pytest

from zenav.stack.launch import ROOT

TWO_AT_A_TIME = """
import time
from functools import partial
from zenav.bench.process_pool import pool_results
if __name__ == "__main__":
    list(pool_results(partial(time.sleep), [1000, 1001], 2))
"""


def workers(process: psutil.Process) -> list[psutil.Process]:
    return [child for child in process.children(recursive=True) if "spawn_main" in " ".join(child.cmdline())]


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGKILL])
def test_no_worker_outlives_it(tmp_path, number):
    script = tmp_path / "two.py"
    script.write_text(TWO_AT_A_TIME)
    environment = dict(os.environ, PYTHONPATH=str(ROOT))  # noqa: TID251
    with subprocess.Popen([sys.executable, script], env=environment, stderr=subprocess.DEVNULL) as bench:
        begun = psutil.Process(bench.pid)
        while len(found := workers(begun)) < 2:
            assert bench.poll() is None
            threading.Event().wait(0.05)
        bench.send_signal(number)
        assert bench.wait(20) != 0
    _, left = psutil.wait_procs(found, 20)
    assert left == []
