"""What the literal matcher finds."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields

import numpy as np
from numpy.typing import ArrayLike

from closerange.flags import Flag
from closerange.geometry.arrays import (
    FloatArray,
    IntArray,
    all_finite,
    frozen_array,
    frozen_ints,
)
from closerange.matching.correspondences import Correspondences

VARIANCE_PX2 = 1.0 / 3.0
"""Of a right match: bands of edge pixels, three wide, still cover each other a pixel to either
side, and within that any whole pixel may win. Found on four rendered scenes: 0.5 to 0.7 px along
the segment for 0.58; across it the rounding alone, 0.25 px. Wrong matches are another matter."""


@dataclass(frozen=True, slots=True, eq=False)
class LiteralMatches:
    """Matches of N points.

    Attributes
    ----------
    seed_px : ndarray, shape (N, 2)
        Points of view 1.
    xy_px : ndarray, shape (N, 2)
        Matches in view 2, whole pixels; NaN without one.
    mismatch : ndarray, shape (N,)
        Pixels of the element that are missing in image 2; NaN without a match.
    pixels : ndarray of int, shape (N,)
        Pixels of the element in view 2.
    ties : ndarray of int, shape (N,)
        Places at which as few are missing, the chosen one included.
    flags : ndarray of int, shape (N,)
        `Flag` bits of each match. `ambiguous`: an equally good place is farther than a pixel's
        neighbours. `at_border`: the element is cut by the border of either image. Without a
        match: `no_edge` (the element has no pixel, or none of it is anywhere in the
        neighbourhood), `outside_image` (the point, the segment or an oversized element),
        `not_found` (no point), and those of `EpipolarSegments`.
    """

    seed_px: FloatArray
    xy_px: FloatArray
    mismatch: FloatArray
    pixels: IntArray
    ties: IntArray
    flags: IntArray

    def __post_init__(self) -> None:
        count = len(self.flags)
        for name in ("seed_px", "xy_px"):
            object.__setattr__(self, name, frozen_array(getattr(self, name), (count, 2), name))
        object.__setattr__(self, "mismatch", frozen_array(self.mismatch, (count,), "mismatch"))
        for name in ("pixels", "ties", "flags"):
            object.__setattr__(self, name, frozen_ints(getattr(self, name), (count,), name))

    def __len__(self) -> int:
        return len(self.flags)

    def to_correspondences(
        self, cameras: Sequence[str], point: Sequence[str], placement: str = ""
    ) -> Correspondences:
        """Return the matches as rows of a matches table.

        Parameters
        ----------
        cameras : sequence of str
            Names of view 1 and view 2.
        point : sequence of str
            Names of the N points.
        placement : str, optional
            Name of the placement.

        Returns
        -------
        Correspondences
            `mismatch` is the count. The method states no uncertainty; the covariance of a match
            is that of its construction, `VARIANCE_PX2` in both directions.
        """
        first, second = cameras
        missing = ~all_finite(self.seed_px, 1)
        seed_flags = np.where(missing, int(Flag.not_found), 0)
        cov = np.full((len(self), 2, 2, 2), np.nan)
        cov[all_finite(self.xy_px, 1), 1] = VARIANCE_PX2 * np.eye(2)
        return Correspondences.of(
            cameras=(first, second),
            point=point,
            placement=placement,
            xy_px=np.stack([self.seed_px, self.xy_px], axis=1),
            cov_px2=cov,
            mismatch=self.mismatch,
            flags=np.column_stack([seed_flags, self.flags]),
        )


def join_matches(parts: Sequence[LiteralMatches], order: ArrayLike | None = None) -> LiteralMatches:
    """Join matches of several sets of points.

    Parameters
    ----------
    parts : sequence of LiteralMatches
        Any number, none too.
    order : array_like of int, optional
        Rows of the result among all rows in turn; all of them by default.

    Returns
    -------
    LiteralMatches
        All points.
    """
    empty = LiteralMatches(
        np.zeros((0, 2)), np.zeros((0, 2)), np.zeros(0), *(np.zeros(0, np.int64) for _ in range(3))
    )
    kept = slice(None) if order is None else np.asarray(order, np.int64)
    return LiteralMatches(
        *(
            np.concatenate([getattr(part, field.name) for part in (empty, *parts)])[kept]
            for field in fields(LiteralMatches)
        )
    )
