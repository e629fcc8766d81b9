"""OpenCV: `findChessboardCorners`, refined by `cornerSubPix`.

W. Förstner, E. Gülch, 1987 (the point nearest to all edges of the window). OpenCV's tutorial has
a half window of 11 pixels: https://docs.opencv.org/4.x/dc/dbb/tutorial_py_calibration.html; where
squares are smaller than some 30 px corners then run away to their neighbours.
"""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]

STOP = (cv2.TERM_CRITERIA_EPS + cv2.TERM_CRITERIA_MAX_ITER, 30, 0.001)


def corners(image: NDArray[Any], *, rows: int, columns: int, half_window: int = 11) -> FloatArray:
    """Return inner corners in OpenCV's order, shape (N, 2); empty if not found."""
    found, xy = cv2.findChessboardCorners(image, (columns, rows))
    if not found:
        return np.empty((0, 2))
    refined = cv2.cornerSubPix(image, xy, (half_window, half_window), (-1, -1), STOP)
    return np.asarray(refined, np.float64).reshape(-1, 2)
