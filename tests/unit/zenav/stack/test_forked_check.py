# SPDX-License-Identifier: Apache-2.0
import os
import subprocess
import sys

import pytest

from shared.config import UserError
from zenav.stack import forked_check
from zenav.stack.forked_check import check_apart

IN_A_PROCESS = """
import sys
from zenav.stack.forked_check import check_apart

def check():
    import colorsys

check_apart(check)
assert "colorsys" not in sys.modules
"""


def test_what_a_check_imports_does_not_stay():
    subprocess.run([sys.executable, "-c", IN_A_PROCESS], check=True)


@pytest.mark.parametrize("is_alone", [True, False])
def test_a_failed_check_raises_its_error_here(monkeypatch, is_alone):
    monkeypatch.setattr(forked_check, "is_single_threaded", lambda: is_alone)

    def check():
        raise UserError("no such world", "name another")

    with pytest.raises(UserError, match="no such world"):
        check_apart(check)


BESIDE = """
import os
from zenav.stack.forked_check import begin_check

there, here = os.pipe(), os.pipe()

def check():
    os.write(there[1], b"1")
    assert os.read(here[0], 1) == b"2"

end = begin_check(check)
assert os.read(there[0], 1) == b"1"
os.write(here[1], b"2")
end()
"""


def test_this_process_goes_on_while_a_check_runs():
    subprocess.run([sys.executable, "-c", BESIDE], check=True, timeout=60)


def test_with_other_threads_a_check_runs_in_this_process(monkeypatch):
    monkeypatch.setattr(forked_check, "is_single_threaded", lambda: False)
    pids = []
    check_apart(lambda: pids.append(os.getpid()))
    assert pids == [os.getpid()]
