"""OpenCV: `findCirclesGrid`, whose centres are those of `SimpleBlobDetector`.

The detector averages the centroids of contours at several thresholds. Without clustering the grid
of nine discs is not recognised.
https://docs.opencv.org/4.x/d0/d7a/classcv_1_1SimpleBlobDetector.html
"""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]


def centres(image: NDArray[Any], *, bright: bool, grid: tuple[int, int]) -> FloatArray:
    """Return the centres of a grid (columns, rows) of discs, shape (N, 2); empty if not found."""
    options = cv2.SimpleBlobDetector_Params()
    options.filterByColor = True
    options.blobColor = 255 if bright else 0
    found, xy = cv2.findCirclesGrid(
        image,
        grid,
        flags=cv2.CALIB_CB_SYMMETRIC_GRID | cv2.CALIB_CB_CLUSTERING,
        blobDetector=cv2.SimpleBlobDetector_create(options),
    )
    return np.asarray(xy, np.float64).reshape(-1, 2) if found else np.empty((0, 2))
