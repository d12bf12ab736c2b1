# SPDX-License-Identifier: Apache-2.0
import pytest

from services.base_driver.stuck_detection import StuckConfig, StuckDetector

RADIUS = 0.1


def reports(commanded, turning, seconds=1.5, hz=50):
    """When (s) a wheel that is commanded and turns at these rim speeds (m/s) is found stuck, or None."""
    watch = StuckDetector(StuckConfig())
    for k in range(round(seconds * hz) + 1):
        t = k / hz
        if watch.update(round(t * 1e9), turning * t / RADIUS, commanded / RADIUS, RADIUS):
            return t
    return None


@pytest.mark.parametrize("commanded", [0.051, 0.8, -0.051])
def test_a_standing_wheel_is_stuck_after_exactly_a_second(commanded):
    assert reports(commanded, 0.0) == 1.0


@pytest.mark.parametrize("commanded", [0.05, -0.05, 0.0])
def test_up_to_the_threshold_nothing_is_judged(commanded):
    assert reports(commanded, 0.0) is None


@pytest.mark.parametrize(
    ("turning", "found"), [(0.0199, True), (0.0204, False), (-0.0199, True), (-0.0204, False), (0.3, False)]
)
def test_two_centimetres_a_second_is_turning(turning, found):
    assert (reports(0.2, turning, seconds=3) is not None) is found


def test_less_than_a_second_of_other_settings_scales_the_way():
    watch = StuckDetector(StuckConfig(longer_than=0.5))
    for t, way in ((0.0, 0.0), (0.25, 0.0), (0.49, 0.0), (0.5, 0.011)):
        found = watch.update(round(t * 1e9), way / RADIUS, 0.2 / RADIUS, RADIUS)
    assert not found, "1.1 cm in half a second is over 2 cm/s"


@pytest.mark.parametrize("first", [1, -1])
def test_a_reversal_begins_again(first):
    watch = StuckDetector(StuckConfig())
    assert not watch.update(0, 0.0, first * 2.0, RADIUS)
    assert not watch.update(900_000_000, 0.0, first * 2.0, RADIUS)
    assert not watch.update(1_000_000_000, 0.0, -first * 2.0, RADIUS)
    assert not watch.update(1_900_000_000, 0.0, -first * 2.0, RADIUS)
    assert watch.update(2_000_000_000, 0.0, -first * 2.0, RADIUS)


def test_a_pause_begins_again():
    watch = StuckDetector(StuckConfig())
    assert not watch.update(0, 0.0, 2.0, RADIUS)
    assert not watch.update(900_000_000, 0.0, 0.0, RADIUS)
    assert not watch.update(1_100_000_000, 0.0, 2.0, RADIUS)
    assert watch.update(2_100_000_000, 0.0, 2.0, RADIUS)
