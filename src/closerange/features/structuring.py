"""Structuring elements: sets of pixels around an origin, with or without heights."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from closerange.errors import InputError
from closerange.geometry.arrays import BoolArray, FloatArray, IntArray, frozen_array, frozen_ints

MAX_REACH_PX = 2**16
"""Farthest that a pixel of an element may lie from its origin. No image is longer."""

MAX_SIDE_PX = 4097
"""Longest side of a box or disc that is built here: 17 million pixels, a quarter of a gigabyte."""


@dataclass(frozen=True, slots=True, eq=False)
class StructuringElement:
    """A structuring element b: its domain and, if it is not flat, its heights.

    Any shape and any origin are allowed; the origin need not belong to the domain. Offsets are
    (row, column) as the (i, j) of equations 4.5 and 4.6, rows downwards.

    Attributes
    ----------
    offsets : ndarray of int, shape (K, 2)
        The domain: pixels (i, j) counted from the origin, in row-major order, each once.
    heights : ndarray, shape (K,), or None
        b(i, j) in grey levels; None for a flat element, whose heights are all 0.

    Raises
    ------
    InputError
        If there is no pixel, one occurs twice, lies farther than 65536 px from the origin, or
        a height is not finite.
    """

    offsets: IntArray
    heights: FloatArray | None = None

    def __post_init__(self) -> None:
        offsets = np.asarray(self.offsets)
        _check_offsets(offsets)
        order = np.lexsort((offsets[:, 1], offsets[:, 0]))
        offsets = offsets[order]
        if (np.diff(offsets, axis=0) == 0).all(axis=1).any():
            raise InputError(
                "a pixel of the structuring element occurs twice",
                remedy="name each pixel once; a height belongs to one pixel",
            )
        object.__setattr__(self, "offsets", frozen_ints(offsets, (len(offsets), 2), "offsets"))
        if self.heights is not None:
            heights = np.asarray(self.heights, dtype=np.float64)[order]
            if not np.isfinite(heights).all():
                raise InputError(
                    "a height of the structuring element is not finite",
                    remedy="leave a pixel out of the element where it is not defined",
                )
            flat = not heights.any()
            stored = None if flat else frozen_array(heights, (len(offsets),), "heights")
            object.__setattr__(self, "heights", stored)

    @classmethod
    def of_points(cls, points: ArrayLike, heights: ArrayLike | None = None) -> StructuringElement:
        """Build from a set of points.

        Parameters
        ----------
        points : array_like of int, shape (K, 2)
            (row, column) from the origin, as the sets of section 4.2 are written.
        heights : array_like, shape (K,), optional
            b(i, j) of each point.

        Returns
        -------
        StructuringElement
            Flat without heights, or if all are 0.
        """
        offsets = np.asarray(points)
        if heights is None:
            return cls(offsets)
        tops = np.asarray(heights, dtype=np.float64)
        if tops.shape != offsets.shape[:1]:
            raise InputError(
                f"{tops.size} heights for {len(offsets)} pixels of the structuring element",
                remedy="give one height for each pixel",
            )
        return cls(offsets, tops)

    @classmethod
    def of_mask(cls, mask: ArrayLike, origin: tuple[int, int] | None = None) -> StructuringElement:
        """Build a flat element from a mask.

        Parameters
        ----------
        mask : array_like of bool, shape (h, w)
            True where the element is defined.
        origin : (int, int), optional
            Row and column of the origin in the mask, also outside of it; by default the
            centre (h // 2, w // 2).

        Returns
        -------
        StructuringElement
            Flat.
        """
        inside = np.asarray(mask, dtype=bool)
        if inside.ndim != 2:
            raise InputError(
                f"the mask has {inside.ndim} axes, expected rows and columns",
                remedy="give a two-dimensional mask",
            )
        return cls(np.argwhere(inside) - _origin(inside.shape, origin))

    @classmethod
    def of_rows(
        cls,
        rows: Sequence[Sequence[float | None]],
        origin: tuple[int, int] | None = None,
    ) -> StructuringElement:
        """Build from rows of heights, None where the element is not defined.

        Parameters
        ----------
        rows : sequence of sequence of float or None
            Heights b(i, j) as one would print them; NaN counts as None.
        origin : (int, int), optional
            As in `of_mask`.

        Returns
        -------
        StructuringElement
            Flat if all heights are 0.

        Examples
        --------
        The thesis' rod of radius 1, whose centre is the origin but not part of it:

        >>> StructuringElement.of_rows([[None, 0, None], [0, None, 0], [None, 0, None]])
        """
        if len({len(row) for row in rows}) != 1:
            raise InputError(
                "the rows of the structuring element have different lengths, or there is none",
                remedy="write rows of one length, None where the element is not defined",
            )
        heights = np.array(
            [[np.nan if value is None else value for value in row] for row in rows], np.float64
        )
        defined = ~np.isnan(heights)
        return cls(np.argwhere(defined) - _origin(heights.shape, origin), heights[defined])

    @classmethod
    def box(cls, rows: int, columns: int | None = None) -> StructuringElement:
        """Build a flat rectangle.

        Parameters
        ----------
        rows, columns : int
            Size in px; a square without the second. The origin is the pixel
            (rows // 2, columns // 2).

        Returns
        -------
        StructuringElement
            rows x columns pixels.
        """
        size = (rows, rows if columns is None else columns)
        _check_side(max(size))
        return cls.of_mask(np.ones(np.maximum(size, 0), dtype=bool))

    @classmethod
    def disc(cls, radius_px: float) -> StructuringElement:
        """Build a flat disc around its origin.

        Parameters
        ----------
        radius_px : float
            All pixels whose centres are at most so far from the origin's.

        Returns
        -------
        StructuringElement
            A single pixel below radius 1, a cross of five at radius 1.
        """
        _check_side(2 * radius_px + 1)
        reach = int(max(radius_px, 0.0))
        i, j = np.ogrid[-reach : reach + 1, -reach : reach + 1]
        return cls.of_mask((i**2 + j**2 <= radius_px**2) & (radius_px >= 0))

    def __len__(self) -> int:
        return len(self.offsets)

    @property
    def flat(self) -> bool:
        """Whether all heights are 0."""
        return self.heights is None

    @property
    def reflected(self) -> StructuringElement:
        """The element turned by 180 degrees about its origin: b'(i, j) = b(-i, -j)."""
        return StructuringElement(-self.offsets, self.heights)

    def shifted(self, rows: int, columns: int) -> StructuringElement:
        """Move the element away from its origin.

        Parameters
        ----------
        rows, columns : int
            Added to each offset.

        Returns
        -------
        StructuringElement
            The same shape with another origin.
        """
        return StructuringElement(self.offsets + np.array([rows, columns], np.int64), self.heights)

    def mask(self) -> tuple[BoolArray, tuple[int, int]]:
        """Return the smallest mask that holds the element, and the origin in it.

        Returns
        -------
        mask : ndarray of bool, shape (h, w)
            True where the element is defined.
        origin : (int, int)
            Row and column of the origin, negative or beyond the mask if it lies outside.
        """
        first = self.offsets.min(axis=0)
        mask = np.zeros(self.offsets.max(axis=0) - first + 1, dtype=bool)
        mask[tuple((self.offsets - first).T)] = True
        return mask, (-int(first[0]), -int(first[1]))


def _origin(shape: tuple[int, ...], origin: tuple[int, int] | None) -> tuple[int, int]:
    return (shape[0] // 2, shape[1] // 2) if origin is None else origin


def _check_side(side_px: float) -> None:
    if not side_px <= MAX_SIDE_PX:  # NaN is refused too
        raise InputError(
            f"the structuring element would be {side_px:.6g} px long, the limit is {MAX_SIDE_PX}",
            remedy="choose an element smaller than the parts it is meant for",
        )


def _check_offsets(offsets: IntArray) -> None:
    if offsets.size == 0:
        raise InputError(
            "the structuring element has no pixel", remedy="give it at least one pixel"
        )
    if offsets.ndim != 2 or offsets.shape[1] != 2 or offsets.dtype.kind not in "iu":
        raise InputError(
            f"the structuring element's points are {offsets.dtype} of shape {offsets.shape}, "
            "expected whole numbers of shape (K, 2)",
            remedy="give (row, column) from the origin for each pixel",
        )
    farthest = int(np.abs(offsets).max())
    if farthest > MAX_REACH_PX:
        raise InputError(
            f"a pixel of the structuring element lies {farthest} px from its origin, the limit "
            f"is {MAX_REACH_PX}",
            remedy="give offsets from the origin, not positions in an image",
        )
