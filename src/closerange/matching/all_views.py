"""What every matcher of single pairs has in common: its answers from all views become one table."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TypeVar

import numpy as np

from closerange.geometry.arrays import FloatArray, IntArray
from closerange.matching.correspondences import Correspondences

V = TypeVar("V")


@dataclass(frozen=True, slots=True, eq=False)
class Found:
    """Where points of the first view were found in one other; M points, arrays may be filled in.

    Attributes
    ----------
    xy_px : ndarray, shape (M, 2)
        NaN where nothing was found.
    cov_px2 : ndarray, shape (M, 2, 2)
        Covariance, given that of the point itself.
    mismatch : ndarray, shape (M,)
        In px of misfit.
    flags : ndarray of int, shape (M,)
        `Flag` bits.
    """

    xy_px: FloatArray
    cov_px2: FloatArray
    mismatch: FloatArray
    flags: IntArray


def in_all_views(
    views: Sequence[V],
    pair: Callable[[V, Sequence[V]], Found],
    seeds: Found,
    *,
    cameras: Sequence[str],
    point: Sequence[str],
    placement: str,
    progress: Callable[[int, int], None] | None,
) -> Correspondences:
    """Match the first view with each other one.

    Parameters
    ----------
    views : sequence
        At least two; the first holds the points.
    pair : callable
        Finds the points in one other view; it is given that view, and the rest.
    seeds : Found
        The points themselves; their mismatch is not used.
    cameras, point : sequence of str
        Names of views and points.
    placement : str
        For the rows of the table.
    progress : callable or None
        Called with (done, total) after each view.

    Returns
    -------
    Correspondences
        One column for each view; the mismatch is that of the view that fits best.
    """
    columns = [seeds]
    for other in views[1:]:
        columns.append(pair(other, [view for view in views[1:] if view is not other]))
        if progress:
            progress(len(columns) - 1, len(views) - 1)
    return Correspondences.of(
        cameras=cameras,
        point=point,
        placement=placement,
        xy_px=np.stack([found.xy_px for found in columns], axis=1),
        cov_px2=np.stack([found.cov_px2 for found in columns], axis=1),
        mismatch=np.fmin.reduce([found.mismatch for found in columns[1:]]),
        flags=np.stack([found.flags for found in columns], axis=1),
    )


def along_and_across(way: FloatArray, along_px2: FloatArray, across_px2: FloatArray) -> FloatArray:
    """Return covariances of given variances along unit vectors and across them, shape (M, 2, 2)."""
    outer = way[:, :, None] * way[:, None, :]
    return np.asarray(
        along_px2[:, None, None] * outer + across_px2[:, None, None] * (np.eye(2) - outer)
    )
