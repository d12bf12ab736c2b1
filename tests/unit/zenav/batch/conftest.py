# SPDX-License-Identifier: Apache-2.0
from urllib.request import urlopen

import pytest


@pytest.fixture(scope="session")
def s3_server():
    """The address of a server of S3 in this process."""
    from moto.server import ThreadedMotoServer

    server = ThreadedMotoServer(ip_address="127.0.0.1", port=0, verbose=False)
    server.start()
    host, port = server.get_host_and_port()
    yield f"http://{host}:{port}"
    server.stop()


@pytest.fixture
def s3(s3_server, monkeypatch):
    """The file system of an S3 server with the empty buckets `logs` and `results`; the environment names it."""
    urlopen(f"{s3_server}/moto-api/reset", data=b"").close()
    for name, value in (
        ("AWS_ENDPOINT_URL", s3_server), ("AWS_ACCESS_KEY_ID", "test"),
        ("AWS_SECRET_ACCESS_KEY", "test"), ("AWS_DEFAULT_REGION", "us-east-1"),
    ):  # fmt: skip
        monkeypatch.setenv(name, value)
    import s3fs

    s3fs.S3FileSystem.clear_instance_cache()
    files = s3fs.S3FileSystem()
    files.mkdir("logs")
    files.mkdir("results")
    yield files
    s3fs.S3FileSystem.clear_instance_cache()
