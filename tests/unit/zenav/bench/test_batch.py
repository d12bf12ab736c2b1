# SPDX-License-Identifier: Apache-2.0
"""What `zenav batch` costs: the limits, the made-up logs, and a command that is killed and continued."""

import sys

import psutil
import pytest

from shared.config import UserError
from zenav.batch.work import SlamWork, run_slam
from zenav.bench import batch_kill
from zenav.bench.batch import Used, figures, made_up_logs
from zenav.bench.batch_kill import killed_run, killed_scheduler


def runs(bare_1, bare_2, batch_1, batch_2):
    return {
        name: [Used(wall, cpu, 1.0)]
        for name, (wall, cpu) in {"bare 1": bare_1, "bare 2": bare_2, "batch 1": batch_1, "batch 2": batch_2}.items()
    }


@pytest.mark.parametrize(
    ("batch_1", "batch_2", "kept"),
    [
        ((10.4, 10.4), (5.4, 10.5), True),
        ((10.6, 10.6), (5.4, 10.5), False),  # 6 % more CPU
        ((10.4, 10.4), (5.6, 10.5), False),  # 1.86 times as fast, where bare processes are 2 times
    ],
)
def test_the_limits_are_a_share_of_cpu_and_a_gain_of_the_second_job(batch_1, batch_2, kept):
    assert figures(runs((10.0, 10.0), (5.0, 10.0), batch_1, batch_2))["kept"] is kept


def test_a_computer_without_two_whole_cores_is_measured_by_its_bare_processes():
    assert figures(runs((10.0, 10.0), (6.25, 10.0), (10.0, 10.0), (6.4, 10.0)))["kept"]


def test_a_made_up_log_is_mapped(tmp_path):
    figures = run_slam(SlamWork(), made_up_logs(tmp_path / "logs", 1, 60)[0]).figures
    assert figures["scans_placed"] == 60
    assert figures["length_m"] == pytest.approx(59 * 0.03 * 1.5, rel=0.05)


def test_what_was_done_before_the_kill_is_not_computed_again(tmp_path):
    report = killed_run(tmp_path, 60)
    assert report["rows"] == 60
    assert 30 <= report["done_at_kill"] < 60
    assert report["again"] == 0


@pytest.mark.timeout(300)  # it starts two clusters
def test_a_run_whose_scheduler_is_killed_goes_on_and_computes_nothing_again_that_is_there(tmp_path):
    report = killed_scheduler(tmp_path, 40)
    assert report["rows"] == 40
    assert 20 <= report["done_at_kill"] <= 40
    assert report["again"] <= report["in_flight"]
    assert set(report["peak_mb"]) == {"command", "scheduler", "worker"}


@pytest.mark.timeout(300)  # it starts a cluster
def test_a_run_that_ends_too_early_leaves_no_cluster(tmp_path, monkeypatch):
    monkeypatch.setattr(batch_kill, "batch_command", lambda *_: [sys.executable, "-c", ""])
    with pytest.raises(UserError, match="ends before its files are done"):
        killed_scheduler(tmp_path, 4)
    children = [child for child in psutil.Process().children() if child.status() != psutil.STATUS_ZOMBIE]
    assert not [child for child in children if "distributed.cli" in " ".join(child.cmdline())]
