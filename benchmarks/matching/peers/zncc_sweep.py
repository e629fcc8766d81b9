"""Plane sweep with zero-mean normalised cross-correlation, 15 x 15.

Both images are freed of lens distortion; for each of the planes of the volume, 1 px apart along
the epipolar segment, the other image is warped by the plane's homography and correlated. The best
plane and a parabola through three give the depth. R. T. Collins, 1996,
doi:10.1109/CVPR.1996.517097. The left-right check sweeps the second image in the same way.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from matching.peers.opencv_view import OpenCvView, on_plane, sweep_axis, sweep_heights

FloatArray = NDArray[np.float64]
Image = NDArray[np.float32]

SIDE = 15
RETURN_PX = 1.5
LEAST_SPREAD = 0.5
"""Grey values; windows with less are blank."""


def match(
    images: Sequence[NDArray[Any]],
    cameras: Sequence[Any],
    points_px: FloatArray,
    volume_mm: FloatArray,
) -> tuple[FloatArray, NDArray[np.bool_]]:
    """Return places in the second view and which of them come back."""
    views = (OpenCvView(cameras[0]), OpenCvView(cameras[1]))
    ideal = tuple(_without_lens(image, view) for image, view in zip(images, views, strict=False))
    axis = sweep_axis(views)
    heights = sweep_heights(views, points_px, axis, volume_mm)
    scores, _ = _sweep(ideal, views, axis, heights, views[0].ideal(points_px))
    best = scores.argmax(axis=1)
    place = best + _parabola(scores, best)
    height = np.interp(place, np.arange(len(heights)), heights)
    found = views[1].project(on_plane(views[0], points_px, axis, height))
    found[scores.max(axis=1) < 0] = np.nan
    _, winner = _sweep(ideal[::-1], views[::-1], axis, heights, None)
    back = _at(winner, views[1].ideal(np.nan_to_num(found)))
    return found, np.isfinite(found).all(axis=1) & (np.abs(back - place) < RETURN_PX)


def _without_lens(image: NDArray[Any], view: OpenCvView) -> Image:
    x, y = view.maps(np.eye(3), view.matrix, view.size)
    return np.asarray(cv2.remap(image.astype(np.float32), x, y, cv2.INTER_CUBIC), np.float32)


def _sweep(
    ideal: tuple[Image, ...],
    views: tuple[OpenCvView, ...],
    axis: int,
    heights: FloatArray,
    at: FloatArray | None,
) -> tuple[FloatArray, Image]:
    """Return scores of the points at all planes, or (without points) each pixel's best plane."""
    first, second = ideal[0], ideal[1]
    mean = _mean(first)
    spread = np.sqrt(np.maximum(_mean(first * first) - mean * mean, 0))
    spread = np.where(spread > LEAST_SPREAD, spread, np.inf)
    scores = np.full((0 if at is None else len(at), len(heights)), -1.0)
    best, winner = np.full(first.shape, -2, np.float32), np.zeros(first.shape, np.float32)
    across = [other for other in range(3) if other != axis]
    for index, height in enumerate(heights):
        bases = [
            np.column_stack([p[:, across], p[:, axis] * height + p[:, 3]])
            for p in (view.projection for view in views)
        ]
        homography = bases[1] @ np.linalg.inv(bases[0])
        warped = cv2.warpPerspective(
            second, homography, first.shape[::-1], flags=cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
        )
        other = _mean(warped)
        variance = np.maximum(_mean(warped * warped) - other * other, LEAST_SPREAD**2)
        score = (_mean(first * warped) - mean * other) / (spread * np.sqrt(variance))
        if at is not None:
            scores[:, index] = _at(score, at)
            continue
        better = score > best
        best[better], winner[better] = score[better], index
    return scores, winner


def _mean(image: Image) -> Image:
    return np.asarray(cv2.blur(image, (SIDE, SIDE)), np.float32)


def _at(image: Image, xy: FloatArray) -> FloatArray:
    height, width = image.shape
    column = np.clip(np.rint(xy[:, 0]).astype(int), 0, width - 1)
    row = np.clip(np.rint(xy[:, 1]).astype(int), 0, height - 1)
    return image[row, column].astype(np.float64)


def _parabola(scores: FloatArray, best: NDArray[np.intp]) -> FloatArray:
    rows, inner = np.arange(len(best)), np.clip(best, 1, scores.shape[1] - 2)
    low, middle, high = (scores[rows, inner + k] for k in (-1, 0, 1))
    bend = low - 2 * middle + high
    shift = np.where(bend < -1e-9, 0.5 * (low - high) / np.where(bend < -1e-9, bend, 1.0), 0.0)
    return np.where(inner == best, np.clip(shift, -0.5, 0.5), 0.0)
