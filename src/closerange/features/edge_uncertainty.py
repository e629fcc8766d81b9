"""How far an edge point may be off because the edge is no ideal step."""

from __future__ import annotations

import numpy as np

from closerange.features.edge_chains import chain_window
from closerange.geometry.arrays import FloatArray, IntArray

WIDE = 2.0
"""Scale of the second look, per scale of the first."""

FLOOR_PX = 0.02
"""Of any edge: interpolation leaves 0.013 px (edges drawn by formula), parts are not ideal."""

DRIFT_SHARE = 0.6
"""Standard deviation per px that the point moves between the two looks. A corner, a curve, shading
beside the edge or a neighbouring edge moves it with the square of the blur; the step from the
first look to an ideal image is about half of the step between the two looks."""

WIDTH_SHARE = 0.1
"""Standard deviation per px of additional blur. The gradient of two steps at a distance d has its
second moment enlarged by p (1 - p) d^2, and its peak is off by up to the root of that; most
of what is wider than the sharpest edges is out of focus or rounded alike in both views."""

BY_DIRECTION = 2 / 3
"""Px^2 of blur by which the operator widens an edge along the rows or columns, in the direction's
fourth powers. A central difference spans 2 px there and 1.4 px in the diagonal, which makes 1/3;
the three samples of the peak see as much again of its flat top. Ideal edges of all directions then
have the same blur within 0.05 px^2, where they differ by 0.33 px^2 without."""

LEAST_WIDTH_PX2 = 0.6
"""No peak of a gradient is narrower than a pixel: its three samples would be 0, 1 and 0 at 0.5."""

REACH = 2
"""Points of the chain on each side over which drift and width are averaged."""


def model_std(
    strength: FloatArray, width_px2: FloatArray, drift_px: FloatArray, after: IntArray
) -> FloatArray:
    """Return the standard deviation that the shape of each edge causes, px, shape (N,).

    Parameters
    ----------
    strength : ndarray, shape (N,)
        Gradient at the edge points.
    width_px2 : ndarray, shape (N,)
        Second moment of the gradient's profile.
    drift_px : ndarray, shape (N,)
        Way along the normal between a fine and a coarse look.
    after : ndarray of int, shape (N,)
        Chains.
    """
    if not len(strength):
        return np.zeros(0)
    width = chain_mean(width_px2, after)
    drift2 = chain_mean(drift_px**2, after)
    strong = strength >= np.median(strength)
    sharpest = np.quantile(width[strong], 0.1)
    excess = np.maximum(width - sharpest, 0.0)
    return np.asarray(np.sqrt(FLOOR_PX**2 + DRIFT_SHARE**2 * drift2 + WIDTH_SHARE**2 * excess))


def blur_px2(width_px2: FloatArray, normal: FloatArray) -> FloatArray:
    """Return the variance of the blur across each edge, but for a constant, px^2, shape (N,).

    The width of an edge depends on its direction in the pixel grid by more than on what it is; its
    blur does not, so that two views of one edge can be compared.

    Parameters
    ----------
    width_px2 : ndarray, shape (N,)
        Height of the gradient's peak over its second difference at steps of 1 px.
    normal : ndarray, shape (N, 2)
        Unit vectors across the edges.
    """
    width = np.maximum(width_px2, LEAST_WIDTH_PX2)
    # of a Gaussian of variance v: width = 1 / (2 - 2 exp(-1 / 2v))
    variance = -0.5 / np.log1p(-0.5 / width)
    return np.asarray(variance - BY_DIRECTION * (normal**4).sum(axis=1))


def chain_mean(value: FloatArray, after: IntArray) -> FloatArray:
    """Average a property of edge points over `REACH` neighbours on each side of the chain."""
    before = np.full(len(after), -1, dtype=np.int64)
    linked = after >= 0
    before[after[linked]] = np.flatnonzero(linked)
    window = chain_window(after, before, REACH)
    there = window >= 0
    return np.asarray(np.where(there, value[window], 0.0).sum(axis=1) / there.sum(axis=1))
