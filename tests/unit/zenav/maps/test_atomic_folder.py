# SPDX-License-Identifier: Apache-2.0
"""Files that belong together are replaced together, whenever the machine stops."""

import errno
import json
import os
import subprocess
import sys
import threading

import pytest

from shared.config import UserError
from zenav.maps import atomic_folder
from zenav.maps.atomic_folder import finish_replacing, read_together, replace_together

OLD = {"a": b"old a", "b": b"old b", "c": b"old c"}
NEW = {"a": b"new a" * 9000, "b": b"", "d": b"new d"}

KILLED = """
import json, os, shutil, sys
from pathlib import Path
from zenav.maps.atomic_folder import read_together, replace_together

root = Path(sys.argv[1])
old = {"a": b"old a", "b": b"old b", "c": b"old c"}
new = {"a": b"new a" * 9000, "b": b"", "d": b"new d"}

def killed_at(step, folder):
    left = [step]
    def hook(event, arguments):
        if event.startswith("os.") or event == "open":
            if str(folder) in str(arguments):
                left[0] -= 1
                if left[0] < 0:
                    os._exit(7)
    sys.addaudithook(hook)
    replace_together(folder, new)
    os._exit(0)

seen = []
for step in range(1000):
    folder = root / str(step)
    replace_together(folder, old)
    child = os.fork()
    if not child:
        killed_at(step, folder)
    status = os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])
    names = sorted(p.name for p in folder.rglob("*") if p.is_file())
    content = {}
    for name in "abcd":
        try:
            content[name] = read_together(folder, name).decode()[:5]
        except Exception as error:
            content[name] = type(error).__name__
    replace_together(folder, old)
    again = {p.name: p.read_text() for p in folder.iterdir() if p.name in "abc"}
    seen.append((status, content, again == {k: v.decode() for k, v in old.items()}, names))
    if status == 0:
        break
print(json.dumps(seen))
"""


@pytest.mark.skipif(not hasattr(os, "fork"), reason="the machine cannot fork")
def test_a_process_that_is_killed_at_any_step_leaves_all_the_old_files_or_all_the_new_ones(tmp_path):
    done = subprocess.run([sys.executable, "-c", KILLED, str(tmp_path)], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    seen = json.loads(done.stdout)
    old = {"a": "old a", "b": "old b", "c": "old c", "d": "UserError"}
    new = {"a": "new a", "b": "UserError", "c": "old c", "d": "new d"}
    contents = [content for _, content, _, _ in seen]
    turn = contents.index(new)
    assert contents == [old] * turn + [new] * (len(seen) - turn)
    assert 5 < turn < len(seen) - 3, "it was killed before and after the step that counts"
    assert [status for status, *_ in seen] == [7] * (len(seen) - 1) + [0]
    assert all(mended for *_, mended, _ in seen), "the next one is not held up"


def contents(folder):
    return {path.name: path.read_bytes() for path in folder.iterdir()}


def test_what_the_new_ones_do_not_name_stays(tmp_path):
    replace_together(tmp_path, OLD)
    (tmp_path / "mine").write_bytes(b"notes")
    replace_together(tmp_path, NEW)
    assert contents(tmp_path) == {"a": NEW["a"], "c": b"old c", "d": b"new d", "mine": b"notes"}


class PausedContents(dict):
    """Contents, of which the second file is only there when `begun` was called."""

    def __init__(self, contents, begun):
        super().__init__(contents)
        self._begun = begun

    def items(self):
        first, *others = super().items()
        yield first
        self._begun()
        yield from others


def test_two_processes_that_replace_at_once_leave_the_files_of_one(tmp_path):
    replace_together(tmp_path, OLD)
    one, other = ({name: name.encode() + writer for name in "abc"} for writer in (b" one", b" other"))
    written = threading.Event()

    def second():
        replace_together(tmp_path, PausedContents(other, written.set))

    thread = threading.Thread(target=second)

    def begin_second():
        thread.start()
        written.wait(0.5)  # it has written its first file, or waits for this one

    replace_together(tmp_path, PausedContents(one, begin_second))
    thread.join()
    assert contents(tmp_path) == other


@pytest.mark.parametrize("call", ["fsync", "rename"])
def test_a_full_disk_leaves_the_old_files_and_says_so(tmp_path, monkeypatch, call):
    replace_together(tmp_path, OLD)

    def full(*_):
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(atomic_folder.os, call, full)
    with pytest.raises(UserError, match="No space left on device"):
        replace_together(tmp_path, NEW)
    assert contents(tmp_path) == OLD


def test_where_nothing_may_be_written_a_half_moved_folder_is_read_all_the_same(tmp_path, monkeypatch):
    replace_together(tmp_path, OLD)
    (tmp_path / ".saved").mkdir()
    (tmp_path / ".saved" / "a").write_bytes(b"newer")

    def refused(*_):
        raise PermissionError(errno.EROFS, "Read-only file system")

    with monkeypatch.context() as patched:
        patched.setattr(atomic_folder.os, "replace", refused)
        assert read_together(tmp_path, "a") == b"newer"
        assert read_together(tmp_path, "b") == b"old b"
    finish_replacing(tmp_path)
    assert contents(tmp_path) == OLD | {"a": b"newer"}


def test_a_file_that_is_far_too_large_is_not_even_read(tmp_path):
    (tmp_path / "a").write_bytes(bytes(2000))
    with pytest.raises(UserError, match="larger"):
        read_together(tmp_path, "a", max_bytes=1000)
