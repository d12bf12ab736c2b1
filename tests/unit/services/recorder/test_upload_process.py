# SPDX-License-Identifier: Apache-2.0
"""The recorder starts its uploader, hears it, and starts it again; it never waits for it."""

import sys
import threading
import time

import pytest

from services.recorder import upload_process
from services.recorder.upload_process import UploadOrder, UploadProcess
from shared.service import Log

LIMIT_S = 30.0
ORDER = UploadOrder("here", "there", 0.0, ("x80-*.mcap",))


@pytest.fixture
def uploader(monkeypatch):
    """An uploader whose process runs a piece of code."""
    made = UploadProcess()

    def run(code):
        monkeypatch.setattr(UploadOrder, "command", lambda self: [sys.executable, "-c", code])
        made.wake(ORDER)
        return made

    yield run
    made.close()


def step_until(process, holds):
    logs, limit = [], time.monotonic() + LIMIT_S
    while not holds(logs):
        assert time.monotonic() < limit, (logs, process.text)
        logs += process.step()
        threading.Event().wait(0.01)
    return logs


def test_its_lines_are_state_and_log(uploader):
    lines = ['{"state": "1 to upload"}', "a warning of a library", "100", '{"log": "INFO", "text": "uploaded a.mcap"}']
    process = uploader(f"print(*{lines!r}, sep=chr(10))")
    assert step_until(process, lambda logs: logs) == [Log("INFO", "uploaded a.mcap")]
    assert process.text == "1 to upload"


def test_one_that_dies_is_started_again_later_each_time(uploader, monkeypatch):
    monkeypatch.setattr(upload_process, "MIN_WAIT_S", 0.01)
    process = uploader("import os; os.kill(os.getpid(), 9)")
    process._wait = 0.01
    logs = step_until(process, lambda logs: len(logs) >= 3)
    assert [log.level for log in logs] == ["WARNING"] * 3
    assert "killed by signal 9; it is started again in 0.01 s" in logs[0].text
    assert "in 0.04 s" in logs[2].text


def test_a_part_that_ends_while_it_runs_is_looked_for_again(uploader, tmp_path):
    count = tmp_path / "count"
    process = uploader(f"open({str(count)!r}, 'a').write('x'); import time; time.sleep(0.2)")
    step_until(process, lambda _: count.exists())
    process.wake(ORDER)
    step_until(process, lambda _: count.read_text() == "xx")
    assert process.text == ""


def test_other_settings_are_another_process(uploader):
    process = uploader("import time; time.sleep(60)")
    step_until(process, lambda _: process._process is not None)
    first = process._process
    process.wake(UploadOrder("here", "there", 5.0, ("x80-*.mcap",)))
    assert first.poll() is not None
    step_until(process, lambda _: process._process is not None)
    process.close()
    assert list(process.step()) == []
