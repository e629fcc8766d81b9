"""How alike the texture around an edge point and around its candidate is."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from closerange.features.edges import EdgePoints
from closerange.geometry.arrays import FloatArray
from closerange.geometry.interpolation import bilinear
from closerange.matching.candidates import Candidates

REACH_PX = 4
"""Half-width of the patch: nine pixels across hold enough texture to tell places apart, and mostly
one surface."""

PATCH_PRICE = 2.0
"""Cost in px of patches without any likeness. Around the edge of a plain part every candidate
looks alike, a step, and pays nearly nothing: the price decides only where there is texture."""

ROWS_AT_ONCE = 20_000
"""Candidates that are worked on together: 13 MB for each array."""


def patch_cost(
    first: EdgePoints, candidates: Candidates, greys: tuple[NDArray[Any], NDArray[Any]]
) -> FloatArray:
    """Return the price of unlikeness of the patches around each candidate, shape (M,).

    Normalised cross-correlation of a square patch with its image on the level plane through the
    candidate's world point.
    """
    steps = np.arange(-REACH_PX, REACH_PX + 1, dtype=np.float64)
    offset = np.stack(np.meshgrid(steps, steps), axis=-1).reshape(-1, 2)
    patch = _normalised(bilinear(greys[0], first.xy_px[:, None] + offset))
    cost = np.zeros(len(candidates))
    for start in range(0, len(candidates), ROWS_AT_ONCE):
        rows = slice(start, start + ROWS_AT_ONCE)
        mapped = np.einsum("nij,kj->nki", np.nan_to_num(candidates.level[rows]), offset)
        there = _normalised(bilinear(greys[1], candidates.xy_px[rows, None] + mapped))
        likeness = np.einsum("nk,nk->n", patch[candidates.point[rows]], there)
        cost[rows] = PATCH_PRICE * np.clip(1.0 - likeness, 0.0, 1.0)
    return cost


def _normalised(patch: FloatArray) -> FloatArray:
    """Take away the mean and divide by the length, shape (N, K); zero for a flat patch."""
    centred = patch - patch.mean(axis=1, keepdims=True)
    length = np.linalg.norm(centred, axis=1, keepdims=True)
    return np.asarray(centred / np.maximum(length, 1e-9))
