# SPDX-License-Identifier: Apache-2.0
"""A service's latched values on disk: the newest of them shows when its process ended."""

import numpy as np
import pytest

from shared.codec import Envelope, encode
from shared.config import UserError
from shared.geometry import Pose2
from shared.messages import Localization, MapState, PoseEstimate
from shared.runners.latched_disk import MAX_RESTART_AGE_NS, LatchedDisk
from shared.runners.latched_store import LatchedStore
from shared.types import NS_PER_S

KEYS = ["pose", "map/state"]
HOUR_NS = 3600 * NS_PER_S
ENDED = 2 * HOUR_NS
"""ns; the pose was published then, and the map's state an hour before."""


@pytest.fixture
def disk(tmp_path):
    disk = LatchedDisk(tmp_path, "mapper")
    pose = PoseEstimate(ENDED, Pose2(), Pose2(), np.zeros(9), 1.0, Localization.GOOD)
    state = MapState(ENDED - HOUR_NS, 7, "office", ())
    for key, message in (("pose", pose), ("map/state", state)):
        disk.write(key, lambda message=message: encode(message, Envelope("mapper", "mapper-1", 0, message.stamp)))
    return disk


def restored(disk, now):
    store = LatchedStore(disk, KEYS)
    return [key for key, _, _ in store.restore(now, lambda words, now: pytest.fail(words))]


def test_what_rarely_changes_is_restored_with_what_changes_often(disk):
    assert restored(disk, ENDED + NS_PER_S) == KEYS
    assert restored(disk, ENDED + MAX_RESTART_AGE_NS) == KEYS


def test_a_clock_that_was_set_back_loses_nothing(disk):
    assert restored(disk, ENDED - 25 * NS_PER_S) == KEYS


@pytest.mark.parametrize("now", [ENDED + MAX_RESTART_AGE_NS + 1, ENDED - MAX_RESTART_AGE_NS - 1])
def test_values_of_a_process_that_ended_long_ago_are_removed(disk, now):
    assert restored(disk, now) == []
    assert restored(disk, ENDED) == [], "nor is one of them taken for a newer process's"


def test_values_that_cannot_be_read_are_none_and_do_not_stop_the_start(disk, caplog):
    for path in list(disk.folder.iterdir()):
        path.unlink()
        path.mkdir()
    assert restored(disk, ENDED) == []
    disk.remove("pose")
    assert "pose of before the restart cannot be read" in caplog.text


def test_without_values_nothing_is_restored(tmp_path):
    assert restored(LatchedDisk(tmp_path / "none", "mapper"), ENDED) == []


def test_a_folder_that_cannot_be_made_is_an_error_of_the_user(tmp_path):
    (tmp_path / "file").touch()
    with pytest.raises(UserError, match=f"in {tmp_path}/file: File exists") as refused:
        LatchedDisk(tmp_path / "file", "mapper")
    assert "--memory" in refused.value.hint
