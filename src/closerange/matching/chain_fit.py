"""Heights smoothed along chains: an edge of a part does not jump from pixel to pixel."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.linalg import solveh_banded

from closerange.features.edge_chains import chain_places
from closerange.features.edges import EdgePoints
from closerange.geometry.arrays import BoolArray, FloatArray, IntArray

BEND_PX = 0.015
"""Expected change, from step to step along a chain, of the step in disparity. A circle of 100 px
radius seen at 45 degrees bends by 0.01 px per step and step, a straight edge not at all."""

CORNER = 0.9
"""Cosine between the normals two steps apart below which the chain may turn into another edge."""

JUMP_PX = 3.0
"""Disparities of neighbours that differ by more belong to different edges."""

ROUNDS = 4
"""Re-weightings; outliers have lost their say after two or three."""

GROSS = 2.5
"""Residual, in standard deviations, at which a point has a quarter of its weight left."""

LOOSE = 1e-4
"""Weight of equal neighbours against equal steps: only where nothing else holds a point."""


@dataclass(frozen=True, slots=True, eq=False)
class ChainFit:
    """Smoothed disparities; N points.

    Attributes
    ----------
    value_px : ndarray, shape (N,)
        Smoothed; NaN on chains without any match.
    std_px : ndarray, shape (N,)
        Standard deviation.
    residual : ndarray, shape (N,)
        Measured minus smoothed, in standard deviations of the measurement; NaN without one.
    """

    value_px: FloatArray
    std_px: FloatArray
    residual: FloatArray


def fit_chains(edges: EdgePoints, value_px: FloatArray, std_px: FloatArray) -> ChainFit:
    """Smooth disparities along the chains of edges.

    Minimises the squared residuals plus the squared second differences along each chain, both in
    units of what is expected of them, with weights that let go of outliers; the prior is a doubly
    integrated random walk, whose smoother is a cubic spline (doi:10.1007/BF01389878).

    Parameters
    ----------
    edges : EdgePoints
        N points and their chains.
    value_px : ndarray, shape (N,)
        Measured disparity (any coordinate along the epipolar curve); NaN where unknown.
    std_px : ndarray, shape (N,)
        Standard deviation of each.

    Returns
    -------
    ChainFit
        One row for each point, also for those that were not measured.
    """
    chain, place = chain_places(edges.after)
    order = np.lexsort((place, chain))
    value, std, name = value_px[order], std_px[order], chain[order]
    known = np.isfinite(value) & np.isfinite(std)
    weight = np.where(known, 1.0 / np.where(known, std, 1.0) ** 2, 0.0)
    target = np.where(known, value, 0.0)
    joined = _joined(name, value)
    bends = _bends(joined, edges.normal[order])
    trust = np.ones(len(value))
    smooth = target
    for _ in range(ROUNDS if known.any() else 0):
        smooth = solveh_banded(
            _matrix(weight * trust, joined, bends), weight * trust * target, lower=True
        )
        residual = (target - smooth) * np.sqrt(weight)
        trust = 1.0 / (1.0 + (residual / GROSS) ** 2) ** 2
    reached = np.bincount(name, known, minlength=1)[name] > 0
    spread = _spread(weight * trust, name, known)
    back = np.empty_like(order)
    back[order] = np.arange(len(order))
    return ChainFit(
        np.where(reached, smooth, np.nan)[back],
        np.where(reached, spread, np.nan)[back],
        np.where(known, (target - smooth) * np.sqrt(weight), np.nan)[back],
    )


def _joined(chain: IntArray, value: FloatArray) -> BoolArray:
    """Mark the rows that go on from the row before."""
    joined = np.zeros(len(chain), dtype=bool)
    joined[1:] = chain[1:] == chain[:-1]
    with np.errstate(invalid="ignore"):
        joined[1:] &= ~(np.abs(np.diff(value)) > JUMP_PX)
    return joined


def _bends(joined: BoolArray, normal: FloatArray) -> IntArray:
    """Return the rows in the middle of three that form one smooth piece."""
    middle = np.flatnonzero(joined[1:-1] & joined[2:]) + 1
    turn = np.einsum("ni,ni->n", normal[middle - 1], normal[middle + 1])
    return np.asarray(middle[turn > CORNER])


def _matrix(weight: FloatArray, joined: BoolArray, bends: IntArray) -> FloatArray:
    """Return the lower bands of the normal matrix, shape (3, N)."""
    count = len(weight)
    stiff = BEND_PX**-2
    bands = np.zeros((3, count))
    bands[0] = weight + 1e-9 * stiff
    second = np.zeros(count)
    second[bends] = stiff
    # a second difference at k has coefficients 1, -2, 1 at k - 1, k, k + 1
    bands[0] += 4 * second
    bands[0, :-1] += second[1:]
    bands[0, 1:] += second[:-1]
    bands[1, :-1] -= 2 * (second[1:] + second[:-1])
    bands[2, :-2] += second[1:-1]
    tie = np.where(joined, LOOSE * stiff, 0.0)
    bands[0] += tie
    bands[0, :-1] += tie[1:]
    bands[1, :-1] -= tie[1:]
    return bands


def _spread(weight: FloatArray, chain: IntArray, known: BoolArray) -> FloatArray:
    """Return the standard deviation of the smoothed values.

    For a constant weight w the smoother averages over ``(B^2 w)^(-1/4)`` points and leaves the
    variance ``B^(1/2) w^(-3/4) / (2 sqrt 2)`` (B = `BEND_PX`); w is taken as the local mean, and
    a point at an end of its chain, which is held from one side only, has four times the variance.
    """
    if not len(weight):
        return weight
    reach = 10
    kernel = np.ones(2 * reach + 1)
    # not mode "same", which returns the longer of the two: chains may be shorter than the kernel
    middle = slice(reach, reach + len(weight))
    summed = np.convolve(weight, kernel)[middle]
    filled = np.convolve(np.ones(len(weight)), kernel)[middle]
    first = np.r_[True, chain[1:] != chain[:-1]]
    start = np.maximum.accumulate(np.where(first, np.arange(len(chain)), 0))
    length = np.bincount(chain)[chain]
    edge = np.minimum(np.arange(len(chain)) - start, start + length - 1 - np.arange(len(chain)))
    mean = np.maximum(summed / filled, 1e-12)
    variance = BEND_PX**0.5 * mean**-0.75 / (2 * np.sqrt(2))
    scale = (BEND_PX**2 * mean) ** -0.25
    variance *= 1 + 3 * np.exp(-edge / scale)
    single = np.where(known, 1 / np.maximum(weight, 1e-12), np.inf)
    return np.asarray(np.sqrt(np.minimum(variance, np.maximum(single, 1e-12))))
