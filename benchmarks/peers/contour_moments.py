"""OpenCV: centroid of a contour, `cv2.moments` of the polygon (Green's theorem).

https://docs.opencv.org/4.x/d0/d49/tutorial_moments.html
"""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from peers.disc_contours import contours

FloatArray = NDArray[np.float64]


def centres(image: NDArray[Any], *, bright: bool, grid: tuple[int, int]) -> FloatArray:
    """Return the centroids of round regions, shape (N, 2); the grid is not looked at."""
    del grid
    found = [cv2.moments(outline) for outline in contours(image, bright=bright)]
    return np.array([(m["m10"] / m["m00"], m["m01"] / m["m00"]) for m in found]).reshape(-1, 2)
