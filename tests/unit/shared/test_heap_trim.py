# SPDX-License-Identifier: Apache-2.0
"""Holes in the heap go back to the system, and only where a process has grown."""

import subprocess
import sys

import pytest
from hypothesis import given
from hypothesis import strategies as st

from shared.runners import heap_trim
from shared.runners.heap_trim import GROWTH_MB, HeapTrimmer

HOLES = """
from pathlib import Path
from shared.runners.heap_trim import trim_heap

def own_mb():
    rows = Path("/proc/self/smaps_rollup").read_text().splitlines()
    return next(int(row.split()[1]) for row in rows if row.startswith("Private_Dirty")) / 1e3

blocks = [bytearray(50_000) for _ in range(2000)]
blocks[:-1] = []  # the last one holds the heap's end
before = own_mb()
trim_heap()
print(before - own_mb())
"""


def test_holes_are_given_back():
    done = subprocess.run([sys.executable, "-c", HOLES], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert float(done.stdout) > 80.0


@given(st.lists(st.floats(20, 60), min_size=1, max_size=40))
def test_a_process_is_trimmed_each_time_that_it_has_grown(sizes):
    trims = []
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(heap_trim, "trim_heap", lambda: trims.append(now))
        trimmer, since = HeapTrimmer(), [sizes[0]]
        for now in sizes:
            grown = now >= min(since) + GROWTH_MB
            assert trimmer.look(now) is grown
            since = [now] if grown else [*since, now]
    assert len(trims) <= len(sizes) - 1
