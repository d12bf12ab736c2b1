# SPDX-License-Identifier: Apache-2.0
"""Short runs of the whole stack: each service, and all of them as a chain, still say what they said then, to the byte.

On another processor or C library than the recording's the last bits may differ; there they must be within TOLERANCES.
"""

import sys
from collections.abc import Callable
from functools import cache
from pathlib import Path

import pytest

from shared.config import UserError
from shared.recording import Recording, arithmetic
from shared.runners.host import LATCHED
from shared.service import Service
from tests.replay.record import SCENES, path_of, record
from zenav.recording.opening import recorded_robot_file
from zenav.replay.comparison import tolerances_from
from zenav.replay.report import service_builder
from zenav.replay.reprocess import ReplayReport, replay_file

HINT = (
    "services say something else than when this was recorded. If a change is meant to do that: make record-references"
)
TOLERANCES = tolerances_from(
    [
        "odom=1e-6", "pose=1e-3", "pose.covariance=1e-6", "plan=0.05", "base/wheels=1e-6", "base/ranges=1e-6",
        "hardware/board=1e-6", "hardware/motors=1e-6", "scan=1e-4", "sim/truth=1e-6", "nav/status=0.05",
        "follow/status=0.05", "cmd/nav=0.02", "cmd/vel=0.02", "guard/status=0.02", "base/report=1e-6", "map.cells=20",
    ]
)  # fmt: skip
"""On another machine, in the fields' units: m, rad, m/s; a map's cell in percent."""
FEW = 0.02  # share of messages that may be off by more there: one that a rounding moved over a threshold

pytestmark = pytest.mark.timeout(600)  # with an empty cache the kernels are compiled here


@cache
def made_here(name: str) -> bool:
    return arithmetic().items() <= Recording(path_of(name)).about.items()


@cache
def names_in(name: str) -> tuple[str, ...]:
    return tuple(Recording(path_of(name)).lives())


def build_for(name: str) -> Callable[[str], Service]:
    file = recorded_robot_file(Recording(path_of(name)))
    assert file is not None
    return service_builder(file)


def replayed(name: str, services: tuple[str, ...], out: Path | None = None) -> ReplayReport:
    """What comes out of it today. Fails where it is not what came out then."""
    try:
        tolerances = {} if made_here(name) else TOLERANCES
        report = replay_file(path_of(name), list(services), out, build_for(name), lambda done, of: None, tolerances)
    except UserError as error:
        pytest.fail(f"{error.what}: {HINT}")
    assert report.notes == [], HINT
    for topic in report.topics:
        n = topic.n_equal + topic.n_within + topic.n_different
        most = 0 if made_here(name) else FEW * n
        assert topic.n_different <= most, f"{topic.key} {topic.first}: {HINT}"
        assert topic.n_lacking == topic.n_new == 0, f"{topic.key} {topic.first}: {HINT}"
    return report


@pytest.mark.parametrize("name", SCENES)
def test_each_service_says_what_it_said(name):
    for service in names_in(name):
        report = replayed(name, (service,))
        assert sum(topic.n_equal + topic.n_within for topic in report.topics) >= 4, service


@pytest.mark.parametrize("name", SCENES)
def test_the_whole_chain_gives_the_recording_again(name, tmp_path):
    report = replayed(name, names_in(name), tmp_path / "out.mcap")
    if made_here(name):
        assert report.equal
        again, before = Recording(tmp_path / "out.mcap").entries(), Recording(path_of(name)).entries()
        assert list(again) == list(before)


def test_the_run_itself_comes_out_again_to_the_byte(tmp_path):
    if not made_here("killed_service"):
        pytest.skip("the recording was made with another processor, C library or numpy")
    record("killed_service", tmp_path / "again.mcap")
    again, before = (Recording(path).entries() for path in (tmp_path / "again.mcap", path_of("killed_service")))
    for entry, kept in zip(again, before, strict=True):
        assert entry == kept, HINT


@pytest.mark.parametrize(("name", "key"), [("guard", "guard/status"), ("base_driver", "base/status")])
def test_a_restarted_service_hears_first_what_it_had_latched_itself(name, key):
    before, after = Recording(path_of("killed_service")).lives()[name]
    first = after.events[0]
    assert (first.kind, first.key, first.session) == (LATCHED, key, before.session)


@pytest.mark.parametrize("name", SCENES)
def test_a_recording_is_small_whole_and_tells_nothing_of_the_machine_but_its_arithmetic(name):
    path = path_of(name)
    assert path.stat().st_size < 1_000_000
    recording = Recording(path)
    assert recording.problems == []
    assert set(names_in(name)) >= {"sim", "base_driver", "odometry", "mapper", "planner", "local_ctrl", "guard"}
    said = [*recording.about.values(), *(text.decode() for text in recording.attachments.values())]
    assert not [words for words in said if str(Path.home()) in words or sys.prefix in words]
