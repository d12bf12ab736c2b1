# SPDX-License-Identifier: Apache-2.0
"""`zenav batch replay` and a benchmark's items on a real cluster: a scheduler and a worker, each a process."""

import gc
import re
import subprocess
import sys
import threading
import time
from contextlib import ExitStack
from datetime import UTC, datetime, timedelta
from pathlib import Path

import dask
import distributed
import pytest
from cryptography import x509
from cryptography.hazmat.primitives import hashes, serialization
from cryptography.hazmat.primitives.asymmetric import ec
from cryptography.x509.oid import NameOID

from shared.config import UserError
from tests.replay.record import path_of
from tests.unit.zenav.batch.works import double, misbehave
from tests.unit.zenav.logs import room_log
from zenav.__main__ import _status
from zenav.batch import cluster as module
from zenav.batch.engine import results
from zenav.batch.storage import Folder
from zenav.batch.table import last_table
from zenav.batch.work import SlamWork, run_slam
from zenav.bench.process_pool import pool_results

LIMIT_S = 100.0
pytestmark = pytest.mark.timeout(300)  # each starts several programs that load much
ROOT = Path(__file__).parents[4]  # workers import works.py


class Cluster:
    """A scheduler and workers, each a process; may be killed and started again at its address.

    The scheduler takes a free port itself: one that was free before may be another program's by then.
    """

    def __init__(self, folder, n_workers=1, certificate=None):
        self.address = ""
        self.log, self._folder, self._n_workers, self._processes = folder / "cluster.log", folder, n_workers, []
        self._protocol = "tls" if certificate else "tcp"
        names = ("ca-file", "cert", "key")
        self._tls = [f"--tls-{name}={path}" for name, path in zip(names, certificate or (), strict=False)]

    def start(self):
        """Returns when the workers are there."""
        n_before = self._count("Register worker")
        host = self.address or f"{self._protocol}://127.0.0.1:0"
        self._run("dask_scheduler", "--host", host, "--no-dashboard")
        self._wait(lambda: self._count("Scheduler at:") > 0)
        self.address = re.findall(r"Scheduler at: *(\S+)", self.log.read_text())[-1]
        for _ in range(self._n_workers):
            options = ["--nthreads", "1", "--no-dashboard", "--no-nanny", "--local-directory", str(self._folder)]
            self._run("dask_worker", self.address, "--host", "127.0.0.1", *options)
        self._wait(lambda: self._count("Register worker") >= n_before + self._n_workers)

    def _run(self, program, *options):
        command = [sys.executable, "-m", f"distributed.cli.{program}", *options, *self._tls]
        with self.log.open("a") as log:
            self._processes.append(subprocess.Popen(command, stdout=log, stderr=log, cwd=ROOT))

    def _count(self, words):
        return self.log.read_text().count(words) if self.log.exists() else 0

    def _wait(self, is_there):
        limit = time.monotonic() + LIMIT_S
        while not is_there():
            assert time.monotonic() < limit, self.log.read_text()
            assert all(process.poll() is None for process in self._processes), self.log.read_text()
            threading.Event().wait(0.1)

    def kill(self):
        for process in self._processes:
            process.kill()
            process.wait()
        self._processes.clear()


@pytest.fixture
def make_cluster(tmp_path):
    """Starts clusters, which end with the test."""
    with ExitStack() as made:

        def make(**options):
            cluster = Cluster(tmp_path, **options)
            made.callback(cluster.kill)
            cluster.start()
            return cluster

        yield make


@pytest.fixture
def cluster(make_cluster):
    """The address of a scheduler with one worker."""
    return make_cluster().address


def certificate_files(folder):
    """A certificate that is its own authority, twice, and its key."""
    key = ec.generate_private_key(ec.SECP256R1())
    name, now = x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, "cluster")]), datetime.now(UTC)  # noqa: TID251  # of the wall clock
    made = (
        x509.CertificateBuilder(name, name, key.public_key(), x509.random_serial_number())
        .not_valid_before(now - timedelta(days=1)).not_valid_after(now + timedelta(days=1))
        .add_extension(x509.BasicConstraints(ca=True, path_length=None), critical=True).sign(key, hashes.SHA256())
    )  # fmt: skip
    certificate, private = folder / "own.pem", folder / "own-key.pem"
    certificate.write_bytes(made.public_bytes(serialization.Encoding.PEM))
    private.write_bytes(
        key.private_bytes(serialization.Encoding.PEM, serialization.PrivateFormat.PKCS8, serialization.NoEncryption())
    )
    return certificate, certificate, private


def test_a_replay_on_a_cluster_is_equal_and_the_second_run_computes_nothing(cluster, tmp_path, capsys):
    command = ["batch", "replay", str(path_of("driving")), "--through", "guard", "--out", str(tmp_path / "out")]
    assert _status([*command, "--cluster", cluster]) == 0, capsys.readouterr().err
    (row,) = last_table(Folder(str(tmp_path / "out")))
    assert (row["state"], row["different"], row["lacking"], row["cached"]) == ("done", 0, 0, False)
    assert row["equal"] == row["messages"] > 100
    assert _status([*command, "--cluster", cluster]) == 0
    (again,) = last_table(Folder(str(tmp_path / "out")))
    assert (again["cached"], again["digest"]) == (True, row["digest"])


def test_a_benchmark_s_items_have_the_same_results_on_a_cluster_and_a_dead_one_is_named(cluster):
    here = list(pool_results(double, range(5), 1))
    assert sorted(pool_results(double, range(5), 1, cluster)) == here
    with pytest.raises(UserError, match="killed by SIGKILL"):
        list(pool_results(misbehave, ["die"], 1, cluster))


def test_a_scheduler_that_falls_silent_after_the_handshake_does_not_hold_the_command(monkeypatch):
    """Dask's client waits for its first message for ever."""
    over, closed = threading.Event(), threading.Event()

    class SilentClient:
        def __init__(self, *arguments, **options):
            over.wait(60)

        def close(self):
            closed.set()

    monkeypatch.setattr(module, "CONNECT_S", 0.1)
    monkeypatch.setattr("distributed.Client", SilentClient)
    with pytest.raises(UserError, match="no scheduler of Dask answers"):
        list(pool_results(double, range(5), 1, "tcp://127.0.0.1:9"))
    assert not closed.is_set()
    over.set()
    assert closed.wait(60), "a client that comes too late is closed"


def test_a_client_that_could_not_connect_is_closed_before_the_collector_finds_it(cluster):
    """Dask closes it where the collector runs: in the start of the next client both waited for one lock, for ever."""
    with pytest.raises(UserError, match="no scheduler of Dask answers"):
        list(pool_results(double, range(5), 1, cluster.replace("tcp://", "tls://")))  # without certificates
    clients = [thing for thing in gc.get_objects() if issubclass(type(thing), distributed.Client)]
    assert {client.status for client in clients} <= {"closed"}


def test_slam_over_tls_on_two_workers_gives_the_maps_of_this_computer(make_cluster, tmp_path, capsys):
    logs, files = tmp_path / "logs", certificate_files(tmp_path)
    logs.mkdir()
    for n in (20, 21):
        (logs / f"{n}.log").write_text("\n".join(room_log(n)))
    cluster = make_cluster(n_workers=2, certificate=files)
    command = ["batch", "slam", str(logs), "--out", str(tmp_path / "there"), "--cluster", cluster.address]
    assert _status(command) == 2, "without a certificate"
    assert "certificates configured" in capsys.readouterr().err
    tls = dict(zip(("ca-file", "client.cert", "client.key"), map(str, files), strict=True))
    with dask.config.set({f"distributed.comm.tls.{name}": path for name, path in tls.items()}):
        assert _status(command) == 0, capsys.readouterr().err + cluster.log.read_text()
    there = {row["recording"]: row for row in last_table(Folder(str(tmp_path / "there")))}
    assert len(there) == 2
    for path in logs.iterdir():
        assert there[path.as_uri()]["digest"] == run_slam(SlamWork(), path).figures["digest"]


def test_a_run_goes_on_by_itself_when_scheduler_and_workers_were_killed(make_cluster, capsys):
    cluster = make_cluster(n_workers=2)
    run = results(double, range(40), 1, cluster.address)
    first = next(run)
    cluster.kill()
    again = threading.Timer(1.0, cluster.start)
    again.start()
    found = [first, *run]
    again.join()
    assert sorted(item for item, _ in found) == list(range(40)), "each once"
    assert all(outcome.value == 2 * item for item, outcome in found)
    assert "was lost; what was in work is done again" in capsys.readouterr().err
