"""How well windows of several shapes fit at given places of their epipolar curves."""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from closerange.geometry.arrays import FloatArray, IntArray
from closerange.matching.window_information import SIGMA_SHARE
from closerange.matching.window_planes import SeedRays, segment_warps

REACH = 5
"""Samples on each side of the seed: 11 x 11 on every level of the pyramid."""

SIGMA = SIGMA_SHARE * REACH
"""Standard deviation of the Gaussian weights, samples."""

SHAPES = 6
"""Structuring elements that are tried: see `shape_weights`."""

INDEPENDENT = 0.25
"""Independent values per sample: an image in focus is correlated over two pixels in x and y."""

LEAST_MISFIT = 0.01
"""Share of unexplained variance below which fits are equally good: lenses, surfaces and the light
leave a tenth of a window's contrast."""

MOST_SAMPLES = 4_000_000
"""Samples that are taken at once: 50 MB."""

ROW = 4096
"""Samples in a row of the map for OpenCV, which takes fewer than 32 767 rows and columns."""


def grid() -> FloatArray:
    """Return the offsets of a window's samples, shape (121, 2), x before y."""
    y, x = np.mgrid[-REACH : REACH + 1, -REACH : REACH + 1]
    return np.column_stack([x.ravel(), y.ravel()]).astype(np.float64)


def shape_weights(offset: FloatArray, sigma: float) -> FloatArray:
    """Return the weights of the shapes of structuring elements that are tried, shape (6, P).

    The whole window, its core, and its right, left, lower and upper half: where a window straddles
    two surfaces, one of the halves lies nearly on one of them.

    Parameters
    ----------
    offset : ndarray, shape (P, 2)
        From the seed, px.
    sigma : float
        Standard deviation of the Gaussian weights, px.
    """
    x, y = offset.T
    whole = np.exp(-(x * x + y * y) / (2 * sigma**2))
    core = np.exp(-(x * x + y * y) / sigma**2)
    # two fifths of sigma fade a half over about a pixel of the smallest window
    halves = [whole / (1 + np.exp(-side / (0.2 * sigma))) for side in (x, -x, y, -y)]
    return np.stack([whole, core, *halves])


def independent_values(weights: FloatArray) -> FloatArray:
    """Return how many independent values windows hold, shape (S,)."""
    return np.asarray(INDEPENDENT * weights.sum(axis=1) ** 2 / (weights**2).sum(axis=1))


def scores(
    rays: SeedRays,
    omega: FloatArray,
    images: tuple[NDArray[np.float32], NDArray[np.float32]],
    scale: int,
    tilts: FloatArray,
) -> tuple[FloatArray, IntArray]:
    """Compare the windows of seeds with the other view.

    Parameters
    ----------
    rays : SeedRays
        N seeds.
    omega : ndarray, shape (N, K)
        Inverse depths that are tried, ascending or descending in each row; NaN fills up.
    images : tuple of two ndarrays of float32
        Both views, made smaller.
    scale : int
        How many times smaller.
    tilts : ndarray, shape (H, 2)
        Hypotheses of the surface's tilt.

    Returns
    -------
    log_likelihood : ndarray, shape (N, K, S)
        Of each shape under the best tilt, less that of a window that explains nothing; minus
        infinity where omega is NaN. The noise being unknown, it is minus half the number of
        independent values times the logarithm of the unexplained share of the variance.
    tilt : ndarray of int, shape (N, K)
        The best tilt of the whole window.
    """
    weights = shape_weights(grid(), SIGMA)
    value = np.full((*omega.shape, len(weights)), -np.inf)
    tilt = np.zeros(omega.shape, dtype=np.int64)
    independent = independent_values(weights)
    step = max(MOST_SAMPLES // (omega.shape[1] * len(tilts) * weights.shape[1] + 1), 1)
    for start in range(0, len(rays), step):
        rows = slice(start, start + step)
        there = np.isfinite(omega[rows])
        misfit = _misfits(rays.select(rows), omega[rows], images, scale, tilts, weights)
        tilt[rows] = misfit[..., 0].argmin(axis=2)
        gain = -0.5 * independent * np.log(np.maximum(misfit.min(axis=2), LEAST_MISFIT))
        value[rows] = np.where(there[:, :, None], gain, -np.inf)
    return value, tilt


def _misfits(
    rays: SeedRays,
    omega: FloatArray,
    images: tuple[NDArray[np.float32], NDArray[np.float32]],
    scale: int,
    tilts: FloatArray,
    weights: FloatArray,
) -> NDArray[np.float32]:
    """Return the unexplained share of the variance, shape (N, K, H, S)."""
    offset = grid().astype(np.float32)
    share = (weights / weights.sum(axis=1, keepdims=True)).astype(np.float32)
    here = (rays.xy_px / scale).astype(np.float32)
    template = _template(sampled(images[0], here[:, None, :] + offset), share)
    there = np.isfinite(omega)
    known = there.any(axis=1)
    # what fills up must be on the ray too; it is overwritten by the caller
    spare = np.where(known, np.nanmax(np.where(there, omega, 0.0), axis=1), np.nan)
    filled = np.where(there, omega, spare[:, None])
    rows, columns = omega.shape
    repeated = rays.select(np.repeat(np.arange(rows), columns))
    centre = rays.second.project(repeated.at(filled.ravel())) / scale
    count = np.maximum(there.sum(axis=1), 1)
    warps = segment_warps(rays, filled, count, tilts)
    misfit = np.empty((rows, columns, len(tilts), len(weights)), dtype=np.float32)
    basis = _affine(offset)
    for number in range(len(tilts)):
        warp = warps[:, :, number].reshape(rows * columns, 4)
        place = np.concatenate([warp, centre], axis=1, dtype=np.float32) @ basis
        values = sampled(images[1], place.reshape(rows, columns, -1, 2))
        misfit[:, :, number] = _unexplained(values, template, share)
    return misfit


def _affine(offset: NDArray[np.float32]) -> NDArray[np.float32]:
    """Return what makes places of all samples from a warp and a centre, shape (6, 2 P)."""
    basis = np.zeros((6, len(offset), 2), dtype=np.float32)
    basis[0:2, :, 0] = offset.T
    basis[2:4, :, 1] = offset.T
    basis[4, :, 0] = basis[5, :, 1] = 1.0
    return basis.reshape(6, -1)


def _template(patch: NDArray[np.float32], share: NDArray[np.float32]) -> NDArray[np.float32]:
    """Return weighted patches of zero mean and unit variance for every shape, shape (N, P, S)."""
    mean = patch @ share.T
    centred = patch[:, :, None] - mean[:, None, :]
    weighted = centred * share.T
    variance = np.einsum("nps,nps->ns", weighted, centred)
    return np.asarray(weighted / np.sqrt(np.maximum(variance, 1e-12))[:, None, :])


def _unexplained(
    values: NDArray[np.float32], template: NDArray[np.float32], share: NDArray[np.float32]
) -> NDArray[np.float32]:
    """Return one minus the signed square of the correlation, shape (N, K, S)."""
    values = values - values.mean(axis=2, keepdims=True)
    mean = values @ share.T
    variance = (values * values) @ share.T - mean * mean
    # the template has a weighted mean of zero, hence no term for the mean of the values
    rho = (values @ template) / np.sqrt(np.maximum(variance, 1e-6))
    return np.asarray(np.nan_to_num(1.0 - rho * np.abs(rho), nan=2.0), dtype=np.float32)


def sampled(image: NDArray[np.float32], xy_px: NDArray[Any]) -> NDArray[np.float32]:
    """Interpolate linearly at places, shape (..., 2); the border goes on outside."""
    flat = xy_px.reshape(-1, 2)
    rows = -(-len(flat) // ROW)
    padded = np.zeros((rows * ROW, 2), dtype=np.float32)
    padded[: len(flat)] = flat
    blocks = padded.reshape(rows, ROW, 2)
    taken = [
        cv2.remap(
            image,
            blocks[start : start + ROW],
            None,
            cv2.INTER_LINEAR,
            borderMode=cv2.BORDER_REPLICATE,
        )
        for start in range(0, rows, ROW)
    ]
    return np.concatenate(taken).ravel()[: len(flat)].reshape(xy_px.shape[:-1])
