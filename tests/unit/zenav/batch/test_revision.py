# SPDX-License-Identifier: Apache-2.0
"""`zenav batch --against` a revision, with a checkout whose code only writes a table."""

import subprocess

import pytest

from shared.config import UserError
from tests.unit.zenav.logs import room_log
from zenav.batch.child_process import TryLimits
from zenav.batch.commands import batch
from zenav.batch.storage import Folder
from zenav.batch.work import SlamWork

FORMER = """
import base64, pathlib, sys
out = pathlib.Path(sys.argv[sys.argv.index("--out") + 1].removeprefix("file://"))
(out / "results" / "former").mkdir(parents=True)
(out / "results" / "former" / "map.png").write_bytes(b"the former map")
(out / "table.parquet").write_bytes(base64.b64decode("{table}"))
(out / "arguments").write_text(" ".join(sys.argv[1:]))
"""


def git(folder, *arguments):
    who = ("-c", "user.name=a", "-c", "user.email=a@localhost")
    subprocess.run(["git", *who, *arguments], cwd=folder, check=True, capture_output=True)


def commit(folder, tag, **files):
    for name in ("services", "shared", "zenav"):
        (folder / name).mkdir(exist_ok=True)
        (folder / name / "__init__.py").touch()
    (folder / "pyproject.toml").touch()
    for name, content in files.items():
        path = folder / "zenav" / name.replace("__main__", "__main__.py")
        path.parent.mkdir(exist_ok=True)
        path.write_text(content)
    git(folder, "add", "-A")
    git(folder, "commit", "-m", tag)
    git(folder, "tag", tag)


@pytest.fixture
def checkout(tmp_path, monkeypatch):
    folder = tmp_path / "checkout"
    folder.mkdir()
    git(folder, "init")
    monkeypatch.setattr("zenav.batch.revision.ROOT", folder)
    return folder


def slam(tmp_path, **options):
    log = tmp_path / "a.log"
    log.write_text("\n".join(room_log(20)))
    work = SlamWork(topic_scan=options.pop("topic_scan", ""))
    chosen = {"against": "", "cluster": "", **options}
    limits = TryLimits()
    return batch(work, [str(log)], str(tmp_path / "out"), 1, chosen["cluster"], limits, chosen["against"], False)


def test_the_code_of_the_revision_makes_what_is_compared(tmp_path, checkout):
    import base64

    from zenav.batch.table import last_table, parquet

    assert slam(tmp_path) == 0
    today = last_table(Folder(str(tmp_path / "out")))[0]
    former = {**today, "quality": 2.0 * today["quality"], "key": "former"}
    commit(checkout, "v1", __main__=FORMER.format(table=base64.b64encode(parquet([former])).decode()))
    (checkout / "zenav" / "batch").mkdir()
    (checkout / "zenav" / "batch" / "__init__.py").touch()
    git(checkout, "add", "-A")
    git(checkout, "commit", "-m", "with batch")
    git(checkout, "tag", "v2")
    assert slam(tmp_path, against="v2") == 0
    page = (tmp_path / "out" / "changes.html").read_text()
    assert "<tr class=worse>" in page
    assert "results/former/map.png" in page
    assert (tmp_path / "out" / "results" / "former" / "map.png").read_bytes() == b"the former map"
    arguments = next((tmp_path / "out" / "revisions").glob("*/arguments")).read_text()
    assert arguments.startswith("batch slam --registrar=line --timeout=0")
    assert arguments.endswith(f"-- {tmp_path / 'a.log'}")


def test_a_revision_that_cannot_be_run_is_one_line(tmp_path, checkout):
    commit(checkout, "v1", __main__="")
    with pytest.raises(UserError, match="older than zenav batch"):
        slam(tmp_path, against="v1")
    with pytest.raises(UserError, match="holds no table of a batch and is no revision"):
        slam(tmp_path, against="v9")
    with pytest.raises(UserError, match="runs on this computer"):
        slam(tmp_path, against="v1", cluster="tcp://127.0.0.1:1")
    git(checkout, "rm", "-rq", "services")
    git(checkout, "commit", "-m", "other")
    with pytest.raises(UserError, match="is no revision of zenav"):
        slam(tmp_path, against="HEAD")
