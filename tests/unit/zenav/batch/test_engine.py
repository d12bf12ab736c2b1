# SPDX-License-Identifier: Apache-2.0
import subprocess
import sys
from contextlib import contextmanager
from pathlib import Path

import psutil
import pytest

from shared.config import UserError
from tests.unit.zenav.batch import works
from zenav.batch.child_process import ChildProcess, Outcome, TryLimits
from zenav.batch.engine import AHEAD, ClusterLostError, results

ROOT = Path(__file__).parents[4]
LIMITS = TryLimits(timeout=60.0, memory=400_000_000)


@pytest.fixture
def child():
    child = ChildProcess()
    yield child
    child.close()


@pytest.mark.parametrize(
    ("item", "ending", "words"),
    [
        ("raise", "raised", "ValueError: bad data"),
        ("die", "died", "killed by SIGKILL"),
        ("eat", "memory", "more than 400 MB"),
    ],
)
def test_a_try_that_fails_says_how_and_the_next_one_works(child, item, ending, words):
    outcome = child.run(works.misbehave, item, LIMITS)
    assert (outcome.ending, outcome.value) == (ending, None)
    assert words in outcome.detail
    assert child.run(works.misbehave, "well", LIMITS).value == "well"


def test_a_try_that_hangs_ends_at_its_timeout(child):
    outcome = child.run(works.misbehave, "hang", TryLimits(timeout=0.2))
    assert (outcome.ending, outcome.detail) == ("timeout", "took more than 0.2 s")


def test_one_process_works_on_many_items(child):
    assert len({child.run(works.pid, i, LIMITS).value for i in range(3)}) == 1


def test_a_worker_that_dies_costs_one_try(tmp_path):
    marker = str(tmp_path / "died")
    [(item, outcome)] = results(works.die_once, [marker], 1, limits=LIMITS)
    assert (item, outcome.ending, outcome.value, outcome.n_tries) == (marker, "done", "came through", 2)


def test_the_others_go_on_beside_a_recording_that_always_dies():
    outcomes = dict(results(works.misbehave, ["a", "die", "b", "raise", "c"], 2, limits=LIMITS))
    assert {item: outcome.ending for item, outcome in outcomes.items()} == {
        "a": "done", "b": "done", "c": "done", "die": "died", "raise": "raised",
    }  # fmt: skip
    assert outcomes["die"].n_tries == 2
    assert outcomes["raise"].n_tries == 1  # it would raise again


def test_items_are_drawn_as_the_work_goes_on():
    drawn = []

    def items():
        for i in range(40):
            drawn.append(i)
            yield i

    found = results(works.double, items(), 1, limits=LIMITS)
    item, outcome = next(found)
    assert outcome.value == 2 * item
    assert len(drawn) < 10
    assert {item: outcome.value for item, outcome in found} == {i: 2 * i for i in range(40) if i != item}


def test_a_cluster_that_does_not_answer_is_one_line_with_a_hint(monkeypatch):
    monkeypatch.setattr("zenav.batch.cluster.CONNECT_S", 0.5)
    with pytest.raises(UserError, match="no scheduler of Dask answers at tcp:"):
        list(results(works.double, [1], 1, cluster="tcp://127.0.0.1:9"))


class ShrunkCluster:
    """A cluster that is lost with its first results, comes back with one worker, and gets more."""

    def __init__(self):
        self.lives, self.in_work, self.depths = 0, [], []

    @contextmanager
    def queue(self, *_args, **_options):
        self.lives += 1
        self.in_work, self.n_results = [], 0
        yield self

    def n_threads(self):
        return 4 if self.lives == 1 or self.n_results > 20 else 1

    def submit(self, number, item):
        self.in_work.append((number, item))

    def wait(self):
        if self.lives == 1 and self.n_results == 2:
            raise ClusterLostError
        self.depths.append(len(self.in_work))
        self.n_results += 1
        number, item = self.in_work.pop(0)
        return number, Outcome("done", works.double(item))


def test_a_cluster_that_comes_back_with_fewer_workers_goes_on_and_one_that_grows_is_used(monkeypatch):
    cluster = ShrunkCluster()
    monkeypatch.setattr("zenav.batch.cluster.cluster_queue", cluster.queue)
    found = {item: outcome.value for item, outcome in results(works.double, range(60), 1, cluster="tcp://lost:1")}
    assert found == {i: 2 * i for i in range(60)}
    assert cluster.lives == 2
    assert (cluster.depths[20], cluster.depths[24]) == (AHEAD, 4 * AHEAD), "for the workers that are there now"


def listening_ports() -> set[int]:
    return {row.laddr.port for row in psutil.Process().net_connections() if row.status == psutil.CONN_LISTEN}


def test_a_local_run_opens_no_port_and_loads_no_dask():
    code = "import sys; from tests.unit.zenav.batch.works import double; from zenav.batch.engine import results; "
    code += "print(sorted(o.value for _, o in results(double, range(4), 2)), 'distributed' in sys.modules)"
    said = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True, cwd=ROOT).stdout
    assert said == "[0, 2, 4, 6] False\n"
    before = listening_ports()
    run = results(works.double, [1, 2], 1)
    assert next(run)[1].value == 2
    assert listening_ports() == before
    run.close()


def test_an_item_that_cannot_be_sent_is_one_row():
    [(_, outcome)] = results(works.double, [lambda: None], 1)
    assert (outcome.ending, outcome.n_tries) == ("raised", 1)
