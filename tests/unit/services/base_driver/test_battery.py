# SPDX-License-Identifier: Apache-2.0
from math import nan

import pytest

from services.base_driver.battery import BatteryConfig, BatteryMonitor

CONFIG = BatteryConfig(low=6.6, empty=6.0, sag=0.1, recovered=0.3)


def empties(*volts, config=CONFIG):
    """Whether the battery is empty after each of these voltages, 50 ms apart."""
    watch = BatteryMonitor(config)
    found = []
    for k, v in enumerate(volts):
        watch.update(k * 50_000_000, v)
        found.append(watch.is_empty)
    return found


def test_a_voltage_that_stays_under_the_limit_is_an_empty_battery():
    assert empties(6.0, 5.99, 5.99, 5.99, 5.9) == [False, False, False, True, True]


def test_a_sag_is_forgiven():
    assert empties(*[7.0, 5.0, 5.0, 6.1] * 4) == [False] * 16


def test_it_stays_empty_until_the_voltage_has_recovered():
    assert empties(5.0, 5.0, 5.0, 6.1, 6.29, nan, 6.31, 6.0) == [False, False, True, True, True, True, False, False]
    assert empties(5.0, 5.0, 5.0, 7.0, 5.0, 5.0, 5.0)[2:] == [True, False, False, False, True]


def test_without_a_measurement_or_a_limit_nothing_is_empty():
    assert empties(*[nan] * 5) == [False] * 5
    assert empties(*[0.0] * 5, config=BatteryConfig()) == [False] * 5


@pytest.mark.parametrize(("volts", "low"), [(6.59, True), (6.6, False), (nan, False)])
def test_people_are_told_before(volts, low):
    assert BatteryMonitor(CONFIG).is_low(volts) is low
