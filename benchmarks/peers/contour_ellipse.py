"""OpenCV: ellipse through the pixels of a contour, `cv2.fitEllipse`.

A. Fitzgibbon, R. Fisher, 1995, doi:10.5244/C.9.51 (OpenCV's reference for the algorithm).
"""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from peers.disc_contours import contours

FloatArray = NDArray[np.float64]


def centres(image: NDArray[Any], *, bright: bool, grid: tuple[int, int]) -> FloatArray:
    """Return the centres of ellipses through contours, shape (N, 2); the grid is not looked at."""
    del grid
    found = [cv2.fitEllipse(outline)[0] for outline in contours(image, bright=bright)]
    return np.array(found, np.float64).reshape(-1, 2)
