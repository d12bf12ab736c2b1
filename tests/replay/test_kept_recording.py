# SPDX-License-Identifier: Apache-2.0
"""A drive that the live stack recorded once: today's services still say what they said then, to the byte.

On another processor or C library than the recording's the last bits differ; there poses must be near.
"""

from pathlib import Path

import pytest

from shared.codec import decode
from shared.config import UserError
from shared.messages import Odometry, PoseEstimate
from shared.recording import Recording, arithmetic
from tests.replay.record import CHAIN, FILE, keys
from zenav.replay import Report, replay_file, robot_file
from zenav.replaying import builder

MEND = "services say something else than when the recording was made. If a change is meant to do that: make recording"
NEAR, NEAR_ANGLE = 0.01, 0.01  # m, rad: of poses that were computed elsewhere

pytestmark = pytest.mark.timeout(600)  # with an empty cache the kernels are compiled here


def made_here() -> bool:
    return arithmetic().items() <= Recording(FILE).about.items()


def replayed(names: tuple[str, ...], out: Path | None = None) -> Report:
    try:
        file = robot_file(Recording(FILE))
        assert file is not None
        return replay_file(FILE, list(names), out, builder(file), lambda done, of: None)
    except UserError as error:
        pytest.fail(f"{error.what}: {MEND}")


def differences(report: Report) -> list[str]:
    changed = [topic for topic in report.topics if topic.n_different or topic.n_lacking or topic.n_new]
    return [f"{topic.key} {topic.first}" for topic in changed] + report.notes


@pytest.mark.skipif(not made_here(), reason="the recording was made with another processor, C library or numpy")
@pytest.mark.parametrize("names", [*((name,) for name in CHAIN), CHAIN], ids=" ".join)
def test_what_was_recorded_comes_out_again_to_the_byte(names):
    report = replayed(names)
    assert differences(report) == [], MEND
    assert all(topic.n_equal >= 10 for topic in report.topics)


def test_poses_computed_anywhere_are_near_the_recorded_ones(tmp_path):
    replayed(("odometry", "mapper"), tmp_path / "out.mcap")
    n_poses = 0
    for key, type_ in (("odom", Odometry), ("pose", PoseEstimate)):
        recorded, anew = Recording(FILE).entries([key]), Recording(tmp_path / "out.mcap").entries([key])
        for before, now in zip(recorded, anew, strict=True):
            (a, _), (b, _) = decode(type_, before.payload), decode(type_, now.payload)
            a, b = (m.odom_from_base if isinstance(m, Odometry) else m.map_from_base for m in (a, b))
            step = a.inverse() @ b
            assert step.distance(type(step)()) < NEAR, MEND
            assert abs(step.yaw) < NEAR_ANGLE, MEND
            n_poses += 1
    assert n_poses > 300


def test_the_recording_is_small_and_holds_what_the_chain_needs():
    assert FILE.stat().st_size < 1_000_000
    assert {entry.key for entry in Recording(FILE).entries()} <= keys()
    assert Recording(FILE).problems == []
