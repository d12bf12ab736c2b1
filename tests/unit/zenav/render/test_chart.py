# SPDX-License-Identifier: Apache-2.0
from io import BytesIO

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from PIL import Image

from zenav.render.chart import AFTER, BEFORE, HEIGHT, PAPER, WIDTH, Chart, charts_png, ticks


@given(st.floats(-1e3, 1e3), st.floats(1e-3, 1e6))
def test_ticks_are_a_few_even_steps_within_the_bounds(low, span):
    found = ticks(low, low + span)
    assert 2 <= len(found) <= 9
    assert all(low - 1e-6 * span <= tick <= low + span * (1 + 1e-6) for tick in found)
    np.testing.assert_allclose(np.diff(found), found[1] - found[0], rtol=1e-3)


def picture(*charts: Chart):
    return np.asarray(Image.open(BytesIO(charts_png(list(charts)))).convert("RGB")).astype(int)


def places(image, colour):
    rows, columns = np.nonzero((image == colour).all(axis=2))
    return columns, rows


def test_dots_lie_where_their_numbers_say():
    image = picture(Chart("t", "x", "y").dots([0, 1], [0, 0], BEFORE).dots([0.5], [1], AFTER))
    assert image.shape == (HEIGHT, WIDTH, 3)
    x, y = places(image, BEFORE)
    left, right = x[x < WIDTH / 2].mean(), x[x > WIDTH / 2].mean()
    above_x, above_y = (v.mean() for v in places(image, AFTER))
    assert above_x == pytest.approx((left + right) / 2, abs=1)
    assert above_y < y.mean() - HEIGHT / 2


def test_equal_axes_make_a_metre_as_long_both_ways():
    image = picture(Chart("t", "x", "y", equal=True).dots([0, 4, 0], [0, 0, 1], BEFORE))
    x, y = places(image, BEFORE)
    assert np.ptp(x) - 6 == pytest.approx(4 * (np.ptp(y) - 6), abs=4)


@pytest.mark.parametrize(
    "values", [[], [float("nan")], [1.0], [2.0, 2.0], [1.0, float("nan"), 3.0], [1e9, -1e9], [1e9, 1e9 + 1e-6]]
)
def test_any_values_are_drawn(values):
    image = picture(Chart("t", "x", "y").line(values, values, BEFORE, "label"), Chart("t", "x", "y", True))
    assert image.shape == (HEIGHT, 2 * WIDTH, 3)
    assert (image != PAPER).any()


def test_a_gap_in_a_line_is_a_gap():
    whole = picture(Chart("t", "x", "y").line([0, 1, 2, 3, 4], [0, 0, 0, 0, 1], BEFORE))
    gap = picture(Chart("t", "x", "y").line([0, 1, np.nan, 3, 4], [0, 0, 0, 0, 1], BEFORE))
    assert 0 < (gap == BEFORE).all(axis=2).sum() < (whole == BEFORE).all(axis=2).sum()
