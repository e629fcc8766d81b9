"""Border following and the centroid of border points."""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from closerange.geometry.arrays import FloatArray, IntArray


def follow_borders(mask: NDArray[Any], *, holes: bool = False) -> list[IntArray]:
    """Follow the borders of all 8-connected regions.

    Parameters
    ----------
    mask : ndarray, shape (H, W), bool or uint8
        Non-zero pixels belong to regions.
    holes : bool, optional
        Also follow the borders of holes (the region's pixels around them).

    Returns
    -------
    list of ndarray of int, each (N, 2)
        The border pixels x, y of one border in order of following; no pixel between them is
        left out. Regions come from the bottom of the image to its top.

    Notes
    -----
    The 8-neighbourhood border following of the thesis' section 2.3, by the method of
    doi:10.1016/0734-189X(85)90016-7.
    OpenCV's border points have shape (N, 1, 2) in version 4 and (N, 2) or (N, 1, 2) in version 5.
    """
    mode = cv2.RETR_CCOMP if holes else cv2.RETR_EXTERNAL
    image = np.ascontiguousarray(mask).astype(np.uint8, copy=False)
    found = cv2.findContours(image, mode, cv2.CHAIN_APPROX_NONE)[-2]
    return [np.asarray(border).reshape(-1, 2).astype(np.int64) for border in found]


def border_centroid(border: ArrayLike) -> FloatArray:
    """Return the mean of border points (equation 2.7 of the thesis).

    Parameters
    ----------
    border : array_like, shape (N, 2)
        Border pixels x, y.

    Returns
    -------
    ndarray, shape (2,)
        Centroid x, y in px.
    """
    return np.asarray(np.asarray(border, dtype=np.float64).reshape(-1, 2).mean(axis=0))


def border_centroid_covariance(border: ArrayLike) -> FloatArray:
    """Estimate the covariance that pixel quantisation leaves in a border centroid.

    Parameters
    ----------
    border : array_like, shape (N, 2)
        Border pixels x, y of a closed border.

    Returns
    -------
    ndarray, shape (2, 2)
        Covariance in px^2, diagonal.

    Notes
    -----
    Two roundings do not average out along a closed smooth border. The run of n pixels at each
    of its four extremes is rounded as a whole: (n / N)^2 / 12 for each. And a border counts
    columns where it is flat and rows where it is steep: where it changes over, at the four
    diagonals, that count is rounded to a whole pixel, with the radius as its lever:
    4 / 12 * variance of the border / N^2, which does not shrink with the size (0.07 px).
    Together they lie 0 to 15 % above the scatter of simulated borders of radius 4 to 60 px
    (a third above it at 2.5 px).
    Image noise is left out: with a contrast of twenty times the noise, rounding is far larger.
    """
    points = np.asarray(border, dtype=np.float64).reshape(-1, 2)
    total = len(points)
    runs = sum((points == extreme(points, axis=0)).sum(axis=0) ** 2 for extreme in (np.min, np.max))
    return np.diag((runs / 12 + points.var(axis=0) / 3) / total**2)
