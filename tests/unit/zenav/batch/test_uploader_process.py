# SPDX-License-Identifier: Apache-2.0
"""The uploader as a process, and the server of S3 as another one: both are killed in the middle."""

import os
import signal
import socket
import subprocess
import sys
import threading
import time
from contextlib import ExitStack, suppress
from pathlib import Path

import numpy as np
import pytest

from services.recorder.upload_process import UploadOrder
from shared.recording import Writer

LIMIT_S = 90.0
MB = 1_000_000


@pytest.fixture
def server(monkeypatch):
    """Starts a server of S3 with an empty bucket, again where it was killed; gives its process and file system."""
    with socket.create_server(("127.0.0.1", 0)) as probe:
        port = probe.getsockname()[1]
    for name, value in (
        ("AWS_ENDPOINT_URL", f"http://127.0.0.1:{port}"), ("AWS_ACCESS_KEY_ID", "test"),
        ("AWS_SECRET_ACCESS_KEY", "test"), ("AWS_DEFAULT_REGION", "us-east-1"),
    ):  # fmt: skip
        monkeypatch.setenv(name, value)
    import s3fs

    with ExitStack() as processes:

        def start():
            null = subprocess.DEVNULL
            command = [sys.executable, "-m", "moto.server", "-p", str(port)]
            process = processes.enter_context(subprocess.Popen(command, stdout=null, stderr=null))
            processes.callback(process.kill)
            wait_until(lambda: listens(port))
            s3fs.S3FileSystem.clear_instance_cache()
            files = s3fs.S3FileSystem(use_listings_cache=False)
            files.mkdir("robots")
            return process, files

        yield start
    s3fs.S3FileSystem.clear_instance_cache()


def listens(port):
    with suppress(ConnectionRefusedError), socket.create_connection(("127.0.0.1", port)):
        return True
    return False


def wait_until(holds):
    limit = time.monotonic() + LIMIT_S
    while not holds():
        assert time.monotonic() < limit
        threading.Event().wait(0.02)


def test_uploader_and_server_may_be_killed_at_any_moment(server, tmp_path):
    path, rng = tmp_path / "x80-20260101-000000.mcap", np.random.default_rng(4)
    with Writer(path, attachments={"noise": rng.bytes(30 * MB)}):
        pass
    content, progress = path.read_bytes(), Path(f"{path}.uploading")
    order = UploadOrder(str(tmp_path), "s3://robots/today", 30.0, ("x80-*.mcap",))
    process, files = server()
    with ExitStack() as uploaders:

        def upload():
            started = uploaders.enter_context(subprocess.Popen(order.command(), stdout=subprocess.DEVNULL))
            uploaders.callback(started.kill)
            return started

        for seconds in rng.uniform(0.0, 0.8, 2):  # from its first part on
            uploader = upload()
            wait_until(lambda: progress.exists() or Path(f"{path}.uploaded").exists())
            threading.Event().wait(seconds)
            uploader.kill()
            uploader.wait()
            assert {files.cat_file(name) for name in files.glob("robots/today/*.mcap")} <= {content}
        if not Path(f"{path}.uploaded").exists():
            uploader = upload()
        os.kill(process.pid, signal.SIGKILL)
        process.wait()
        process, files = server()  # it has forgotten all
        Path(f"{path}.uploaded").unlink(missing_ok=True)
        if uploader.poll() is not None:
            uploader = upload()
        assert uploader.wait(LIMIT_S) == 0
    assert files.cat_file("robots/today/x80-20260101-000000.mcap") == content
    assert len(files.find("robots/today/catalogue")) == 1
    assert sorted(p.name for p in tmp_path.iterdir()) == [".uploads.lock", path.name, f"{path.name}.uploaded"]
