# SPDX-License-Identifier: Apache-2.0
"""Turns of the robot by its scans alone: correlation of angle histograms.

The directions of the walls in a scan make a histogram. The shift at which those of two scans agree best is the turn
between them. Source: Weiss, Wetzler and von Puttkamer, "Keeping track of position and orientation of moving indoor
systems by correlation of range-finder scans", IROS 1994.
"""

from collections.abc import Iterable

import numpy as np
from numpy.typing import NDArray

from services.mapper.front_end.surface_normals import sweep_normals
from shared.types import Float64s
from zenav.convert.records import LoggedScan

N_BINS = 720  # of a circle
SMOOTHING_RAD = 0.026  # standard deviation of a wall's direction by a few beams
MAX_TURN_RAD = 0.6  # between two scans
_FREQUENCIES = np.arange(N_BINS // 2 + 1)
_SMOOTHING = np.exp(-((_FREQUENCIES * SMOOTHING_RAD) ** 2))  # of both histograms


def scan_turns(scans: Iterable[LoggedScan]) -> Float64s:
    """(n,) rad, the turn to each of n scans from the one before; 0 for the first."""
    turns, before = [], None
    for scan in scans:
        spectrum = _spectrum(scan)
        turns.append(0.0 if before is None else _turn(before, spectrum))
        before = spectrum
    return np.array(turns)


def _spectrum(scan: LoggedScan) -> NDArray[np.complex128]:
    """The Fourier transform of the histogram of a scan's normals."""
    angles = scan.angle_min + scan.angle_increment * np.arange(len(scan.ranges))
    ends = np.column_stack((np.cos(angles), np.sin(angles))) * scan.ranges[:, None].astype(np.float64)
    normals = sweep_normals(np.zeros_like(ends), ends)
    normals = normals[normals.any(axis=1)]
    bins = np.floor(np.arctan2(normals[:, 1], normals[:, 0]) / (2 * np.pi) * N_BINS).astype(np.int64) % N_BINS
    return np.fft.rfft(np.bincount(bins, minlength=N_BINS))


def _turn(before: NDArray[np.complex128], after: NDArray[np.complex128]) -> float:
    """rad, of the best correlation, between bins by a parabola; 0 without any. The walls turn against the robot."""
    correlation = np.fft.irfft(before * after.conj() * _SMOOTHING, N_BINS)
    reach = round(MAX_TURN_RAD / (2 * np.pi) * N_BINS)
    near = np.concatenate((correlation[-reach:], correlation[: reach + 1]))
    best = int(np.argmax(near))
    if near[best] <= 0:  # a scan without a wall
        return 0.0
    offset = 0.0
    if 0 < best < len(near) - 1:
        left, middle, right = near[best - 1 : best + 2]
        if left - 2 * middle + right < 0:
            offset = 0.5 * (left - right) / (left - 2 * middle + right)
    return float((best - reach + offset) * 2 * np.pi / N_BINS)
