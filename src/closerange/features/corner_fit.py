"""Measuring a corner of a chessboard by fitting a model of its grey values.

Two straight, blurred edges cross and the contrast changes sign at each::

    I = m + g . (x - x0) + c E(d1 / s) E(d2 / s),   E(t) = erf(t / sqrt(2))

with signed distances d1, d2 from the two edges. Nine unknowns (position, two directions,
blur s, contrast c, mean m, its gradient g) are fitted to the pixels in a round window by
Gauss-Newton with all corners at once. Their covariance follows from the Jacobian and the
residual: white pixel noise is the only random part, and what the model does not explain
enlarges the residual, so it is counted too.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.special import erf

from closerange.geometry.arrays import BoolArray, FloatArray

ITERATIONS = 15
CONVERGED_PX = 1e-4
"""Far below the noise of any corner."""

UNKNOWNS = 9
MIN_BLUR_PX, MAX_BLUR_PX = 0.2, 8.0


@dataclass(frozen=True, slots=True, eq=False)
class CornerFits:
    """Result of `fit_corners`; n corners.

    Attributes
    ----------
    xy_px, cov_px2 : ndarray, shapes (n, 2) and (n, 2, 2)
        Position and its covariance; the covariance is NaN where the fit failed.
    blur_px, contrast, noise : ndarray, shape (n,)
        Edge blur (sigma, px), grey difference of the squares, standard deviation of the
        residual in grey values.
    saturated : ndarray, shape (n,)
        Share of the window's pixels at full scale.
    good, cut : ndarray of bool, shape (n,)
        Whether the fit converged inside its window; whether the image border cuts the window.
    """

    xy_px: FloatArray
    cov_px2: FloatArray
    blur_px: FloatArray
    contrast: FloatArray
    noise: FloatArray
    saturated: FloatArray
    good: BoolArray
    cut: BoolArray


@dataclass(slots=True, eq=False)
class _Windows:
    """Pixels around each corner, relative to the start position; padded to one size P."""

    grey: FloatArray  # (n, P)
    offset: FloatArray  # (n, P, 2)
    inside: BoolArray  # (n, P)


def fit_corners(
    pixels: NDArray[Any], start_px: FloatArray, steps_px: FloatArray, radius_px: FloatArray
) -> CornerFits:
    """Fit the corner model at n places.

    Parameters
    ----------
    pixels : ndarray, shape (H, W), uint8 or uint16
        The image.
    start_px : ndarray, shape (n, 2)
        Where the corners are to within a pixel or two.
    steps_px : ndarray, shape (n, 2, 2)
        Steps to the next column and to the next row, px: the directions of the edges.
    radius_px : ndarray, shape (n,)
        Radius of each window; no other edge of the board crosses it.

    Returns
    -------
    CornerFits
        n corners in the same order.
    """
    windows, cut, saturated = _cut_out(pixels, start_px, radius_px)
    unknowns = _start(windows, steps_px)
    moved = np.full(len(start_px), np.inf)
    for _ in range(ITERATIONS):
        residual, jacobian = _linearised(windows, unknowns)
        normal, right = _normal(residual, jacobian)
        step = np.linalg.solve(normal, right[..., None])[..., 0]
        limit = np.minimum(1.0, 0.5 * radius_px / np.maximum(_length(step), 1e-12))
        step *= limit[:, None]
        unknowns = unknowns + step
        unknowns[:, 4] = np.clip(unknowns[:, 4], MIN_BLUR_PX, MAX_BLUR_PX)
        moved = _length(step)
        if np.all(moved < CONVERGED_PX):
            break
    residual, jacobian = _linearised(windows, unknowns)
    normal, _ = _normal(residual, jacobian)
    free = np.maximum(windows.inside.sum(axis=1) - UNKNOWNS, 1)
    variance = np.sum(residual**2, axis=1) / free
    cov = np.linalg.inv(normal)[:, :2, :2] * variance[:, None, None]
    good = (moved < 0.01) & (_length(unknowns) < 0.5 * radius_px)
    good &= windows.inside.sum(axis=1) > 2 * UNKNOWNS
    good &= (cov[:, 0, 0] > 0) & (cov[:, 1, 1] > 0) & (cov[:, :2, :2].trace(0, 1, 2) < 1)
    cov[~good] = np.nan
    return CornerFits(
        xy_px=start_px + unknowns[:, :2],
        cov_px2=cov,
        blur_px=unknowns[:, 4],
        contrast=2 * np.abs(unknowns[:, 5]),
        noise=np.sqrt(variance),
        saturated=saturated,
        good=good,
        cut=cut,
    )


def _length(unknowns: FloatArray) -> FloatArray:
    length: FloatArray = np.linalg.norm(unknowns[:, :2], axis=1)
    return length


def _cut_out(
    pixels: NDArray[Any], start_px: FloatArray, radius_px: FloatArray
) -> tuple[_Windows, BoolArray, FloatArray]:
    reach = int(np.ceil(radius_px.max(initial=1.0))) + 1
    span = np.arange(-reach, reach + 1)
    dx, dy = (part.ravel() for part in np.meshgrid(span, span))
    middle = np.rint(start_px).astype(np.int64)
    x, y = middle[:, :1] + dx, middle[:, 1:] + dy
    offset = np.stack([x - start_px[:, :1], y - start_px[:, 1:]], axis=-1)
    near = np.hypot(offset[..., 0], offset[..., 1]) <= radius_px[:, None]
    height, width = pixels.shape
    inside = near & (x >= 0) & (x < width) & (y >= 0) & (y < height)
    grey = pixels[np.clip(y, 0, height - 1), np.clip(x, 0, width - 1)].astype(np.float64)
    full = grey >= np.iinfo(pixels.dtype).max
    count = np.maximum(inside.sum(axis=1), 1)
    saturated = (full & inside).sum(axis=1) / count
    cut = inside.sum(axis=1) < near.sum(axis=1)
    return _Windows(grey, offset, inside), cut, saturated


def _start(windows: _Windows, steps_px: FloatArray) -> FloatArray:
    """Begin at the given place, along the board's lines, with the window's own grey values."""
    columns, rows = steps_px[:, 0], steps_px[:, 1]
    unknowns = np.zeros((len(steps_px), UNKNOWNS))
    unknowns[:, 2] = np.arctan2(columns[:, 1], columns[:, 0])
    unknowns[:, 3] = np.arctan2(rows[:, 1], rows[:, 0])
    unknowns[:, 4] = 1.0
    first, second = (_distance(windows.offset, unknowns[:, k]) for k in (2, 3))
    weight = windows.inside / windows.inside.sum(axis=1, keepdims=True).clip(1)
    mean = np.sum(weight * windows.grey, axis=1)
    sign = np.sign(first * second)
    unknowns[:, 5] = np.sum(weight * sign * (windows.grey - mean[:, None]), axis=1)
    unknowns[:, 5] += np.where(unknowns[:, 5] < 0, -1.0, 1.0)  # never exactly 0
    unknowns[:, 6] = mean
    return unknowns


def _distance(offset: FloatArray, angle: FloatArray) -> FloatArray:
    """Return signed distances from lines through the origin."""
    normal = np.stack([-np.sin(angle), np.cos(angle)], axis=-1)
    distance: FloatArray = np.einsum("npk,nk->np", offset, normal)
    return distance


def _linearised(windows: _Windows, unknowns: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return observed minus model, and the model's Jacobian; 0 outside of the windows."""
    offset = windows.offset - unknowns[:, None, :2]
    blur, contrast = unknowns[:, 4:5], unknowns[:, 5:6]
    values, slopes, distances, along = [], [], [], []
    for k in (2, 3):
        angle = unknowns[:, k]
        distance = _distance(offset, angle)
        values.append(erf(distance / (np.sqrt(2) * blur)))
        slopes.append(np.sqrt(2 / np.pi) / blur * np.exp(-0.5 * (distance / blur) ** 2))
        distances.append(distance)
        direction = np.stack([np.cos(angle), np.sin(angle)], axis=-1)
        along.append(np.einsum("npk,nk->np", offset, direction))
    # d model / d distance of each edge
    by_edge = [contrast * slopes[0] * values[1], contrast * values[0] * slopes[1]]
    model = unknowns[:, 6:7] + contrast * values[0] * values[1]
    model += np.einsum("npk,nk->np", windows.offset, unknowns[:, 7:9])
    jacobian = np.empty((*model.shape, UNKNOWNS))
    jacobian[..., 0] = sum(
        edge * np.sin(unknowns[:, k])[:, None] for edge, k in zip(by_edge, (2, 3), strict=True)
    )
    jacobian[..., 1] = -sum(
        edge * np.cos(unknowns[:, k])[:, None] for edge, k in zip(by_edge, (2, 3), strict=True)
    )
    jacobian[..., 2] = -by_edge[0] * along[0]
    jacobian[..., 3] = -by_edge[1] * along[1]
    jacobian[..., 4] = -(by_edge[0] * distances[0] + by_edge[1] * distances[1]) / blur
    jacobian[..., 5] = values[0] * values[1]
    jacobian[..., 6] = 1.0
    jacobian[..., 7:9] = windows.offset
    mask = windows.inside
    return np.where(mask, windows.grey - model, 0.0), jacobian * mask[..., None]


def _normal(residual: FloatArray, jacobian: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return normal matrices, held invertible by a trace of damping, and right-hand sides."""
    normal = np.einsum("npi,npj->nij", jacobian, jacobian)
    diagonal = np.einsum("nii->ni", normal)
    normal = normal + np.eye(UNKNOWNS) * (1e-9 * diagonal + 1e-12)[:, None, :]
    return normal, np.einsum("npi,np->ni", jacobian, residual)
