"""OpenCV: `findChessboardCornersSB`, the sector-based detector.

A. Duda, U. Frese, 2018, "Accurate Detection and Localization of Checkerboard Corners for
Calibration", BMVC. ``CALIB_CB_ACCURACY`` up-samples the image for sub-pixel work.
"""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]


def corners(image: NDArray[Any], *, rows: int, columns: int, accurate: bool = True) -> FloatArray:
    """Return inner corners in OpenCV's order, shape (N, 2); empty if not found."""
    flags = cv2.CALIB_CB_ACCURACY if accurate else 0
    found, xy = cv2.findChessboardCornersSB(image, (columns, rows), flags=flags)
    return np.asarray(xy, np.float64).reshape(-1, 2) if found else np.empty((0, 2))
