"""Centroid of grey values above the background, as particle trackers and OpenPTV measure targets.

M. R. Shortis, T. A. Clarke, T. Short, 1994, doi:10.1117/12.189136 (grey-scale centroid with the
background taken off). The window is the disc's upright box and a rim; its background is the
median of the window's frame.
"""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from peers.disc_contours import contours

FloatArray = NDArray[np.float64]

RIM_PX = 5


def centres(image: NDArray[Any], *, bright: bool, grid: tuple[int, int]) -> FloatArray:
    """Return grey-value centroids of round regions, shape (N, 2); the grid is not looked at."""
    del grid
    found = []
    for outline in contours(image, bright=bright):
        x, y, width, height = cv2.boundingRect(outline)
        left, top = max(x - RIM_PX, 0), max(y - RIM_PX, 0)
        window = image[top : y + height + RIM_PX, left : x + width + RIM_PX].astype(np.float64)
        frame = np.concatenate([window[0], window[-1], window[1:-1, 0], window[1:-1, -1]])
        weight = (window - np.median(frame)) * (1 if bright else -1)
        rows, columns = np.indices(window.shape)
        total = weight.sum()
        found.append((left + (weight * columns).sum() / total, top + (weight * rows).sum() / total))
    return np.array(found).reshape(-1, 2)
