"""Values of an image between its pixels."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from closerange.geometry.arrays import FloatArray


def bilinear(image: NDArray[Any], xy_px: NDArray[Any]) -> FloatArray:
    """Interpolate between the four pixels around each point.

    Parameters
    ----------
    image : ndarray, shape (H, W)
        Values.
    xy_px : ndarray, shape (..., 2)
        Where; points outside of the image take the value of its border.

    Returns
    -------
    ndarray, shape (...)
        Values.
    """
    height, width = image.shape
    x = np.clip(xy_px[..., 0], 0, width - 1)
    y = np.clip(xy_px[..., 1], 0, height - 1)
    column = np.minimum(x.astype(np.int64), width - 2)
    row = np.minimum(y.astype(np.int64), height - 2)
    right, down = x - column, y - row
    flat = image.ravel()
    start = row * width + column
    above = flat[start] * (1 - right) + flat[start + 1] * right
    below = flat[start + width] * (1 - right) + flat[start + width + 1] * right
    result: FloatArray = above * (1 - down) + below * down
    return result


def bicubic(image: NDArray[Any], xy_px: NDArray[Any]) -> FloatArray:
    """Interpolate between sixteen pixels with Catmull-Rom's cubic (doi:10.1109/TASSP.1981.1163711).

    Parameters
    ----------
    image : ndarray, shape (H, W)
        Values.
    xy_px : ndarray, shape (N, 2)
        Where; points nearer than two pixels to the border, or outside, are moved inside.

    Returns
    -------
    ndarray, shape (N,)
        Values.
    """
    height, width = image.shape
    x = np.clip(xy_px[:, 0], 1, width - 2 - 1e-9)
    y = np.clip(xy_px[:, 1], 1, height - 2 - 1e-9)
    column, row = x.astype(np.int64), y.astype(np.int64)
    across, down = _cubic(x - column), _cubic(y - row)
    flat = image.ravel()
    start = (row - 1) * width + column - 1
    total = np.zeros(len(x))
    for line in range(4):
        part = np.zeros(len(x))
        for place in range(4):
            part += across[place] * flat[start + line * width + place]
        total += down[line] * part
    return total


def _cubic(t: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    square = t * t
    cube = square * t
    return (
        -0.5 * t + square - 0.5 * cube,
        1 - 2.5 * square + 1.5 * cube,
        0.5 * t + 2 * square - 1.5 * cube,
        -0.5 * square + 0.5 * cube,
    )
