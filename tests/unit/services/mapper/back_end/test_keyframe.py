# SPDX-License-Identifier: Apache-2.0
"""A keyframe holds what it was given, to the bit."""

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from services.mapper.back_end.keyframe import Keyframe
from shared.geometry import Pose2

ARRAYS = "origins", "ends", "points", "normals", "silent"


def same_bits(a, b):
    return a.shape == b.shape and a.dtype == b.dtype and a.tobytes() == b.tobytes()


@st.composite
def sweeps(draw):
    """Arrays of a sweep; its points are some of the ends, some of them twice, zeros of other signs, or other ones."""
    rng, n = np.random.default_rng(draw(st.integers(0, 2**32))), draw(st.integers(0, 40))
    ends = rng.integers(-2, 3, (n, 2)).astype(np.float32) if draw(st.booleans()) else rng.normal(size=(n, 2))
    ends = ends.astype(np.float32)
    ends[rng.random(n) < 0.2] = np.nan
    points = ends[np.isfinite(ends[:, 0]) & (rng.random(n) < 0.9)]
    points = {
        "some": points,
        "others": points + np.float32(0.5),
        "twice": np.repeat(points, 2, axis=0),
        "signs": -0.0 * points,
    }[draw(st.sampled_from(("some", "others", "twice", "signs")))]
    silent = np.where(np.isnan(ends), np.float32(3), np.float32(np.nan))
    silent = silent if draw(st.booleans()) and np.isfinite(silent).any() else silent[:0]
    origins, normals = rng.normal(size=(n, 2)), rng.normal(size=points.shape)
    return dict(
        zip(ARRAYS, (origins.astype(np.float32), ends, points, normals.astype(np.float32), silent), strict=True)
    )


@given(sweeps())
def test_every_array_comes_back_to_the_bit(arrays):
    keyframe = Keyframe.of(7, Pose2(1, 2, 3), **arrays)
    for name, array in arrays.items():
        assert same_bits(getattr(keyframe, name), array), name
    points, normals = keyframe.surface()
    assert points.dtype == normals.dtype == np.float64
    assert np.array_equal(points, arrays["points"])
