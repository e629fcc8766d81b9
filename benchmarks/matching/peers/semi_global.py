"""OpenCV's semi-global matching on rectified images, all eight paths (``MODE_HH``).

`cv2.stereoRectify` gives the turns; the window of the rectified images holds all points and all
places where they may be, at the first image's resolution. Disparities are looked up at the rounded
place of each point and mapped back. Block and penalties as OpenCV's examples have them, and its
own checks (uniqueness, left-right, speckles) on. H. Hirschmueller, 2008,
doi:10.1109/TPAMI.2007.1166.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from matching.peers.opencv_view import OpenCvView, on_plane, sweep_axis

FloatArray = NDArray[np.float64]

BLOCK = 5
MARGIN = 32  # px around the points, for the paths of the method
SLACK = 2  # px of disparity beyond the volume, for noise


def match(
    images: Sequence[NDArray[Any]],
    cameras: Sequence[Any],
    points_px: FloatArray,
    volume_mm: FloatArray,
) -> tuple[FloatArray, NDArray[np.bool_]]:
    """Return places in the second view, NaN where the disparity is unknown, and which are known."""
    views = (OpenCvView(cameras[0]), OpenCvView(cameras[1]))
    axis = sweep_axis(views)
    ends = [
        views[1].project(on_plane(views[0], points_px, axis, np.full(len(points_px), height)))
        for height in volume_mm[:, axis]
    ]
    pair = _rectified(views, points_px, ends)
    mapped = []
    for image, view, turn, matrix in zip(images, views, pair.turns, pair.matrices, strict=False):
        x, y = view.maps(turn, matrix, pair.size)
        found = cv2.remap(image, x, y, cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE)
        mapped.append(np.ascontiguousarray(found.T) if pair.upright else found)
    along = 1 if pair.upright else 0
    here = _place(views[0], points_px, pair.turns[0], pair.matrices[0])
    away = [
        (here - _place(views[1], end, pair.turns[1], pair.matrices[1]))[:, along] for end in ends
    ]
    low, high = int(np.floor(np.min(away))) - SLACK, int(np.ceil(np.max(away))) + SLACK
    disparity = _disparity(mapped, low, high)
    pixel = np.rint(here[:, ::-1] if pair.upright else here).astype(int)
    value = disparity[pixel[:, 1], pixel[:, 0]]
    there = here.copy()
    there[:, along] -= value
    found = _back(views[1], there, pair.turns[1], pair.matrices[1])
    found[value < low] = np.nan
    return found, np.isfinite(found).all(axis=1)


@dataclass(frozen=True, slots=True, eq=False)
class _Pair:
    """Turns and matrices of both rectified cameras, their size, are rows columns."""

    turns: list[FloatArray]
    matrices: list[FloatArray]
    size: tuple[int, int]
    upright: bool


def _rectified(
    views: tuple[OpenCvView, OpenCvView], points: FloatArray, ends: list[FloatArray]
) -> _Pair:
    """Turn both cameras and lay a window over the points and over where they may be."""
    first, second = views
    rotation = second.rotation @ first.rotation.T
    shift = second.shift - rotation @ first.shift
    lenses = (first.matrix, first.lens, second.matrix, second.lens)
    found = cv2.stereoRectify(*lenses, first.size, rotation, shift[:, None], flags=0)
    turns = [np.asarray(found[0]), np.asarray(found[1])]
    upright = bool(abs(found[3][1, 3]) > abs(found[3][0, 3]))
    plain = np.diag([1.0, 1.0, 1.0])
    # oblique views are stretched: the first image keeps its area
    corner = points.mean(axis=0) + np.array([[0.0, 0.0], [1.0, 0.0], [0.0, 1.0]])
    mapped = _place(first, corner, turns[0], plain)
    plain[0, 0] = plain[1, 1] = abs(np.linalg.det(mapped[1:] - mapped[0])) ** -0.5
    boxes = [_place(first, points, turns[0], plain)]
    boxes.append(_place(second, np.concatenate(ends), turns[1], plain))
    start = np.array([box.min(axis=0) for box in boxes]) - MARGIN
    across = 0 if upright else 1
    start[:, across] = start[:, across].min()  # rows must stay in step
    stop = np.array([box.max(axis=0) for box in boxes]) + MARGIN
    matrices = []
    for origin in start:
        matrix = plain.copy()
        matrix[:2, 2] = -origin
        matrices.append(matrix)
    width, height = np.ceil((stop - start).max(axis=0)).astype(int) + 1
    return _Pair(turns, matrices, (int(width), int(height)), upright)


def _disparity(rectified: list[NDArray[np.uint8]], low: int, high: int) -> FloatArray:
    count = (high - low + 15) // 16 * 16
    matcher = cv2.StereoSGBM_create(
        minDisparity=low,
        numDisparities=count,
        blockSize=BLOCK,
        P1=8 * BLOCK**2,
        P2=32 * BLOCK**2,
        disp12MaxDiff=1,
        uniquenessRatio=5,
        speckleWindowSize=50,
        speckleRange=2,
        mode=cv2.STEREO_SGBM_MODE_HH,
    )
    # OpenCV leaves out columns whose search would leave the image
    pad = max(abs(low), abs(low + count)) + BLOCK
    wide = [cv2.copyMakeBorder(image, 0, 0, pad, pad, cv2.BORDER_REPLICATE) for image in rectified]
    found = np.asarray(matcher.compute(*wide), np.float64) / 16
    return found[:, pad:-pad]


def _place(view: OpenCvView, xy: FloatArray, turn: FloatArray, matrix: FloatArray) -> FloatArray:
    rays = np.column_stack([view.ideal(xy), np.ones(len(xy))]) @ np.linalg.inv(view.matrix).T
    return _dehomogenised(rays @ turn.T @ matrix.T)


def _back(view: OpenCvView, xy: FloatArray, turn: FloatArray, matrix: FloatArray) -> FloatArray:
    rays = np.column_stack([xy, np.ones(len(xy))]) @ np.linalg.inv(matrix).T @ turn
    return view.project((rays - view.shift) @ view.rotation)


def _dehomogenised(points: FloatArray) -> FloatArray:
    return np.asarray(points[:, :2] / points[:, 2:])
