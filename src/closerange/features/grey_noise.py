"""The noise of pixels as a function of their grey value."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from closerange.geometry.arrays import FloatArray

QUANTISATION = 1 / np.sqrt(12.0)
"""Grey values are whole numbers: no noise can be told below this."""

LEVELS = 16
"""Groups of equal size. Each needs a thousand pixels for a median good to a few per cent, and an
image of a hundred thousand has them; noise changes slowly with grey value."""

ENOUGH = 40_000
"""Pixels that are looked at, evenly spread: 2500 a group, for a median good to 2 %."""

WINDOW_PX = 5
"""Over so many pixels brightness is averaged before pixels are grouped by it."""

_LAPLACIAN = np.array([[1, -2, 1], [-2, 4, -2], [1, -2, 1]], dtype=np.float32) / 6
"""Blind to planes and straight edges along rows or columns; unit gain for white noise
(doi:10.1006/cviu.1996.0060)."""


@dataclass(frozen=True, slots=True, eq=False)
class NoiseCurve:
    """Noise against brightness; ascending."""

    level: FloatArray
    noise: FloatArray

    def at(self, level: NDArray[Any]) -> FloatArray:
        """Interpolate; constant beyond the ends."""
        return np.asarray(np.interp(level, self.level, self.noise))


def noise_curve(grey: NDArray[np.float32], level: NDArray[np.float32]) -> NoiseCurve:
    """Estimate the standard deviation of the noise of pixels of every brightness.

    Shot noise grows with brightness, so that one number for an image is too small on bright parts
    and too large on a dark table. The median of the high-pass filtered image in groups of similar
    brightness knows nothing of the sensor and is not disturbed by edges, which are few.

    Parameters
    ----------
    grey : ndarray of float32, shape (H, W)
        Grey values.
    level : ndarray of float32, shape (H, W)
        The same, smoothed over `WINDOW_PX`.

    Returns
    -------
    NoiseCurve
        Brightness against noise; at least `QUANTISATION`.
    """
    rough = np.abs(cv2.filter2D(grey, -1, _LAPLACIAN))[1:-1, 1:-1].ravel()
    bright = level[1:-1, 1:-1].ravel()
    step = max(rough.size // ENOUGH, 1)
    rough, bright = rough[::step], bright[::step]
    groups = max(min(LEVELS, rough.size // 1000), 1)
    order = np.argsort(bright, kind="stable")
    parts = np.array_split(order, groups)
    return NoiseCurve(
        np.array([bright[part].mean() for part in parts]),
        np.maximum([np.median(rough[part]) / 0.6745 for part in parts], QUANTISATION),
    )
