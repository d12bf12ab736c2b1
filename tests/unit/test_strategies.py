# SPDX-License-Identifier: Apache-2.0
from dataclasses import replace
from math import nan

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from shared.messages import LaserScan, Velocity, WheelState
from shared.requests import REQUESTS
from tests.strategies import MESSAGES, faults, messages

EVERY = [*MESSAGES, *(kind for request in REQUESTS for kind in (request.request, request.reply))]


@pytest.mark.parametrize("kind", EVERY, ids=lambda kind: kind.__name__)
def test_what_is_drawn_is_valid(kind):
    @settings(max_examples=20, deadline=None, suppress_health_check=list(HealthCheck))
    @given(messages(kind))
    def every_message_is_valid(message):
        assert not list(faults(message))

    every_message_is_valid()


SCAN = LaserScan(1, 0.0, 0.01, 0.1, 0.1, 5.0, np.ones(5, np.float32))


@pytest.mark.parametrize(
    "wrong",
    [
        replace(SCAN, stamp=-1),
        replace(SCAN, stamp=0.5),
        replace(SCAN, angle_min=nan),
        replace(SCAN, angle_increment=0.0),
        replace(SCAN, scan_time=3.0),
        replace(SCAN, range_min=6.0),
        replace(SCAN, ranges=np.ones(5)),
        replace(SCAN, ranges=np.ones((5, 1), np.float32)),
        replace(SCAN, ranges=np.full(5, 251, np.float32)),
        replace(SCAN, ranges=[1.0, 2.0]),
        replace(SCAN, ranges=np.ones(1, np.float32)),
        WheelState(0, 0, np.float64(1.0), 0.0, 0.0, 0.0),
        Velocity(0, 0.0, 0.0, None),
        Velocity(0, 21.0, 0.0, ""),
    ],
)
def test_an_invalid_message_is_found(wrong):
    assert list(faults(wrong))


def test_nan_is_valid_where_it_means_nothing_measured():
    assert not list(faults(replace(SCAN, ranges=np.full(5, nan, np.float32))))


@given(messages(Velocity, v=st.just(0.0)))
def test_a_field_can_be_narrowed(velocity):
    assert velocity.v == 0
