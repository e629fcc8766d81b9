"""SIFT keypoints with ratio test and epipolar filter, carried over to the points asked for.

SIFT finds its own points. Its matches pass Lowe's ratio test (0.8), must lie within 1.5 px of the
epipolar line and inside of the volume. A point asked for takes the depth of the nearest match
within `REACH_PX` and is projected with it; without one it has no match. D. G. Lowe, 2004,
doi:10.1023/B:VISI.0000029664.99615.94.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from matching.peers.opencv_view import OpenCvView, on_plane, sweep_axis

FloatArray = NDArray[np.float64]

RATIO = 0.8
EPIPOLAR_PX = 1.5
REACH_PX = 4.0
"""A keypoint describes about that much around it; farther surfaces need not be the same."""


def match(
    images: Sequence[NDArray[Any]],
    cameras: Sequence[Any],
    points_px: FloatArray,
    volume_mm: FloatArray,
) -> tuple[FloatArray, NDArray[np.bool_]]:
    """Return places in the second view, NaN without a keypoint match near, and which have one."""
    views = (OpenCvView(cameras[0]), OpenCvView(cameras[1]))
    first, second = keypoint_matches(images, cameras, volume_mm)
    found = np.full(np.shape(points_px), np.nan)
    if len(first):
        axis = sweep_axis(views)
        height = _triangulated(views, first, second)[:, axis]
        away, nearest = cKDTree(first).query(points_px)
        near = away <= REACH_PX
        point = on_plane(views[0], points_px[near], axis, height[nearest[near]])
        found[near] = views[1].project(point)
    return found, np.isfinite(found).all(axis=1)


def keypoint_matches(
    images: Sequence[NDArray[Any]], cameras: Sequence[Any], volume_mm: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Return the matched keypoints of both views, shape (K, 2) each."""
    views = (OpenCvView(cameras[0]), OpenCvView(cameras[1]))
    detector = cv2.SIFT_create(contrastThreshold=0.01)  # plain parts have little contrast
    (points_1, words_1), (points_2, words_2) = (
        detector.detectAndCompute(np.asarray(image, np.uint8), None) for image in images[:2]
    )
    if words_1 is None or words_2 is None or len(points_2) < 2:
        return np.empty((0, 2)), np.empty((0, 2))
    pairs = cv2.BFMatcher(cv2.NORM_L2).knnMatch(words_1, words_2, k=2)
    chosen = [best for best, other in pairs if best.distance < RATIO * other.distance]
    first = np.array([points_1[m.queryIdx].pt for m in chosen], np.float64).reshape(-1, 2)
    second = np.array([points_2[m.trainIdx].pt for m in chosen], np.float64).reshape(-1, 2)
    if not len(first):
        return first, second
    xyz = _triangulated(views, first, second)
    missed = [
        np.linalg.norm(view.project(xyz) - seen, axis=1)
        for view, seen in zip(views, (first, second), strict=True)
    ]
    inside = ((xyz >= volume_mm[0]) & (xyz <= volume_mm[1])).all(axis=1)
    kept = (np.sum(missed, axis=0) < EPIPOLAR_PX) & inside
    return first[kept], second[kept]


def _triangulated(
    views: tuple[OpenCvView, OpenCvView], first: FloatArray, second: FloatArray
) -> FloatArray:
    points = cv2.triangulatePoints(
        views[0].projection, views[1].projection, views[0].ideal(first).T, views[1].ideal(second).T
    )
    return np.asarray((points[:3] / points[3]).T)
