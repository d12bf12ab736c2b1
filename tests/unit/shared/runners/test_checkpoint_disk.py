# SPDX-License-Identifier: Apache-2.0
from concurrent.futures import Future

import pytest

from shared.config import Section, load_robot
from shared.requests import GIVE_MAP, GiveMap
from shared.runners.checkpoint_disk import MAX_BYTES_PER_S, MIN_INTERVAL_NS, CheckpointDisk
from shared.service import Checkpoint, Service
from shared.types import NS_PER_S


class AtOnce:
    """An executor that works at once, or when `finish` is called."""

    def __init__(self, waits=False):
        self.waits, self.orders = waits, []

    def submit(self, function, *arguments):
        future = Future()
        self.orders.append(lambda: future.set_result(function(*arguments)))
        if not self.waits:
            self.finish()
        return future

    def finish(self):
        while self.orders:
            self.orders.pop(0)()


class Counter(Service):
    """A service with a state of its own size."""

    def __init__(self):
        super().__init__(Section(), load_robot("x80sv").robot)
        self.count, self.n_bytes = 0, 10

    def checkpoint(self):
        if self.count == 0:
            return None
        return Checkpoint(
            self.count, lambda *data: [(GIVE_MAP, GiveMap(0, 7, 0, 1, bytes(data)))], (self.count,) * self.n_bytes
        )


def restored(disk):
    problems = []
    return [request.data for _, request, _ in disk.restored(problems.append)], problems


def test_the_next_process_gets_the_newest_state(tmp_path):
    service, disk = Counter(), CheckpointDisk(tmp_path, "mapper", AtOnce())
    assert restored(disk) == ([], [])
    disk.step(service, NS_PER_S)
    assert restored(disk) == ([], [])  # nothing to keep yet
    for count in (1, 2):
        service.count = count
        disk.step(service, (1 + count) * MIN_INTERVAL_NS)
        assert restored(CheckpointDisk(tmp_path, "mapper", AtOnce())) == ([bytes([count] * 10)], [])


@pytest.mark.parametrize("n_bytes", [10, 1_000_000])
def test_a_large_state_is_written_less_often(tmp_path, n_bytes):
    service, disk, now, n_written = Counter(), CheckpointDisk(tmp_path, "mapper", AtOnce()), 10**12, 0
    service.n_bytes = n_bytes
    path, last, seconds = tmp_path / "mapper-checkpoint.msgpack", None, 100
    for second in range(seconds):
        service.count = second + 1
        disk.step(service, now + second * NS_PER_S)
        content = path.read_bytes()
        n_written += content != last
        last = content
    allowed = min(seconds * NS_PER_S / MIN_INTERVAL_NS, seconds * MAX_BYTES_PER_S / n_bytes)
    assert allowed / 2 <= n_written <= allowed + 1


def test_the_same_state_is_not_written_again(tmp_path):
    service, disk = Counter(), CheckpointDisk(tmp_path, "mapper", AtOnce())
    service.count = 1
    disk.step(service, 10**12)
    (tmp_path / "mapper-checkpoint.msgpack").unlink()
    disk.step(service, 2 * 10**12)
    assert restored(disk) == ([], [])


def test_one_is_written_at_a_time(tmp_path):
    service, workers = Counter(), AtOnce(waits=True)
    disk = CheckpointDisk(tmp_path, "mapper", workers)
    for count in (1, 2, 3):
        service.count = count
        disk.step(service, count * 10**12)
    assert len(workers.orders) == 1
    workers.finish()
    assert restored(disk)[0] == [bytes([1] * 10)]


@pytest.mark.parametrize(
    "content", [b"", b"\xc1", b"\x91\x92\xa1x\xc4\x00", b"\x91\x92\xb0request/give_map\xc4\x02ab", b"\x05"]
)
def test_damage_is_told_and_nothing_is_restored(tmp_path, content):
    (tmp_path / "mapper-checkpoint.msgpack").write_bytes(content)
    found, problems = restored(CheckpointDisk(tmp_path, "mapper", AtOnce()))
    assert found == []
    assert len(problems) == 1
    assert "damaged" in problems[0]


def test_a_disk_that_refuses_ends_nothing(tmp_path):
    service, disk = Counter(), CheckpointDisk(tmp_path / "missing", "mapper", AtOnce())
    service.count = 1
    disk.step(service, 10**12)
    assert restored(disk) == ([], [])
