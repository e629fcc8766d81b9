"""The same points in several views: the matches table as a type."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike, NDArray

from closerange.errors import InputError
from closerange.features.image_points import ImagePoints
from closerange.geometry.arrays import (
    BoolArray,
    FloatArray,
    IntArray,
    all_finite,
    frozen_array,
    frozen_ints,
)


@dataclass(frozen=True, slots=True, eq=False)
class Correspondences:
    """Points and where each camera sees them; M points, C cameras.

    The seed, the point for which a match was sought, stands in the column of its own camera
    like every match; by custom that camera is the first.

    Attributes
    ----------
    placement, point : tuple of str
        Names of the M points; (placement, reading, point) is unique.
    cameras : tuple of str
        Names of the C cameras, all different.
    xy_px : ndarray, shape (M, C, 2)
        Position in px as seen; NaN where there is no match.
    cov_px2 : ndarray, shape (M, C, 2, 2)
        Covariance in px^2; NaN where unknown.
    mismatch : ndarray, shape (M,)
        How badly the views fit, 0 or more; NaN where nothing was compared. Its unit depends on
        the method that made the match.
    flags : ndarray of int, shape (M, C)
        `Flag` bits of each view: the seed's own and those of each match. NaN without a flag
        means that this camera was not asked; such a view has no row in a table.
    reading : tuple of str
        Repeated measurement of the same placement; blank when there is only one.
    """

    placement: tuple[str, ...]
    point: tuple[str, ...]
    cameras: tuple[str, ...]
    xy_px: FloatArray
    cov_px2: FloatArray
    mismatch: FloatArray
    flags: IntArray
    reading: tuple[str, ...]

    def __post_init__(self) -> None:
        shape = (len(self.point), len(self.cameras))
        for name in ("placement", "point", "reading", "cameras"):
            object.__setattr__(self, name, tuple(getattr(self, name)))
        if len(self.placement) != shape[0] or len(self.reading) != shape[0]:
            raise ValueError("placement, reading and point differ in length")
        if len(set(self.cameras)) < shape[1]:
            raise ValueError(f"a camera is named twice: {', '.join(self.cameras)}")
        xy = np.array(_shaped(self.xy_px, (*shape, 2)))
        xy[~all_finite(xy, 2)] = np.nan  # half a position is none
        cov = _shaped(self.cov_px2, (*shape, 2, 2))
        object.__setattr__(self, "xy_px", frozen_array(xy, (*shape, 2), "xy_px"))
        object.__setattr__(self, "cov_px2", frozen_array(cov, (*shape, 2, 2), "cov_px2"))
        object.__setattr__(self, "mismatch", frozen_array(self.mismatch, shape[:1], "mismatch"))
        flags = _shaped(self.flags, shape).astype(np.int64)
        object.__setattr__(self, "flags", frozen_ints(flags, shape, "flags"))
        keys = self.keys()
        if len(set(keys)) < shape[0]:
            twice = next(key for key in keys if keys.count(key) > 1)
            raise InputError(
                f"point {twice[2]!r} of placement {twice[0]!r} appears twice",
                remedy="give each point its own name, or remove one row",
            )

    @classmethod
    def of(
        cls,
        *,
        cameras: Sequence[str],
        point: Sequence[str],
        xy_px: ArrayLike,
        placement: str | Sequence[str] = "",
        reading: str | Sequence[str] = "",
        cov_px2: ArrayLike | None = None,
        mismatch: ArrayLike | None = None,
        flags: ArrayLike | None = None,
    ) -> Correspondences:
        """Build what a matcher has found; what is not given becomes NaN, blank or 0.

        Parameters
        ----------
        cameras, point : sequence of str
            C and M names.
        xy_px, cov_px2, mismatch, flags
            As the attributes.
        placement, reading : str or sequence of str
            One name for all points, or one each.

        Returns
        -------
        Correspondences
            M points.

        Raises
        ------
        ValueError
            If a view without position has no flag: the reason would be lost.
        """
        shape = (len(point), len(cameras))
        given = np.zeros(shape) if flags is None else _shaped(flags, shape)
        bits = frozen_ints(given.astype(np.int64), shape, "flags")
        xy = frozen_array(_shaped(xy_px, (*shape, 2)), (*shape, 2), "xy_px")
        silent = ~all_finite(xy, 2) & (bits == 0)
        if silent.any():
            row, column = (int(i) for i in np.argwhere(silent)[0])
            raise ValueError(
                f"point {point[row]!r}, camera {cameras[column]!r}: no position and no flag"
            )

        def names(value: str | Sequence[str]) -> tuple[str, ...]:
            return (value,) * len(point) if isinstance(value, str) else tuple(value)

        unknown = np.full((*shape, 2, 2), np.nan)
        return cls(
            placement=names(placement),
            point=tuple(point),
            cameras=tuple(cameras),
            xy_px=xy,
            cov_px2=unknown if cov_px2 is None else np.asarray(cov_px2, np.float64),
            mismatch=np.full(len(point), np.nan) if mismatch is None else np.asarray(mismatch),
            flags=bits,
            reading=names(reading),
        )

    def __len__(self) -> int:
        return len(self.point)

    def __add__(self, other: Correspondences) -> Correspondences:
        """Join two sets; a camera that is only in one was not asked for the other's points."""
        cameras = tuple(dict.fromkeys(self.cameras + other.cameras))
        first, second = self._among(cameras), other._among(cameras)
        return Correspondences(
            placement=self.placement + other.placement,
            point=self.point + other.point,
            cameras=cameras,
            xy_px=np.concatenate([first.xy_px, second.xy_px]),
            cov_px2=np.concatenate([first.cov_px2, second.cov_px2]),
            mismatch=np.concatenate([first.mismatch, second.mismatch]),
            flags=np.concatenate([first.flags, second.flags]),
            reading=self.reading + other.reading,
        )

    def keys(self) -> list[tuple[str, str, str]]:
        """Return (placement, reading, point) of each point."""
        return list(zip(self.placement, self.reading, self.point, strict=True))

    @property
    def found(self) -> BoolArray:
        """Which views have a position, shape (M, C)."""
        return all_finite(self.xy_px, 2)

    @property
    def matched(self) -> NDArray[np.bool_]:
        """Which points have a position in at least two views, flagged or not, shape (M,)."""
        return np.asarray(self.found.sum(axis=1) >= 2)

    @property
    def clean(self) -> NDArray[np.bool_]:
        """Which points have a position without a flag in at least two views, shape (M,)."""
        return np.asarray((self.found & (self.flags == 0)).sum(axis=1) >= 2)

    @property
    def point_flags(self) -> IntArray:
        """Union of the flags of all views of each point, shape (M,)."""
        if not self.cameras:
            return np.zeros(len(self), np.int64)
        return np.asarray(np.bitwise_or.reduce(self.flags, axis=1), np.int64)

    def select(self, rows: ArrayLike) -> Correspondences:
        """Keep some points.

        Parameters
        ----------
        rows : array_like of bool, shape (M,), or of int
            Mask or indices.

        Returns
        -------
        Correspondences
            The chosen points in the given order, all cameras.
        """
        chosen = np.asarray(rows)
        index = np.arange(len(self))[chosen if chosen.size else slice(0)]  # [] has a float's type
        return Correspondences(
            placement=tuple(self.placement[i] for i in index),
            point=tuple(self.point[i] for i in index),
            cameras=self.cameras,
            xy_px=self.xy_px[index],
            cov_px2=self.cov_px2[index],
            mismatch=self.mismatch[index],
            flags=self.flags[index],
            reading=tuple(self.reading[i] for i in index),
        )

    def to_image_points(self) -> ImagePoints:
        """Return one row for each point and camera that was asked, point by point.

        Returns
        -------
        ImagePoints
            What `measure` takes. There are no ellipses: a match is the same surface point seen
            again, not a second disc centre, so that nothing is to be corrected for.
        """
        rows, columns = np.nonzero(self.found | (self.flags != 0))
        return ImagePoints.of(
            camera=[self.cameras[i] for i in columns],
            placement=[self.placement[i] for i in rows],
            reading=[self.reading[i] for i in rows],
            point=[self.point[i] for i in rows],
            xy_px=self.xy_px[rows, columns],
            cov_px2=self.cov_px2[rows, columns],
            flags=self.flags[rows, columns],
        )

    def to_csv(self, path: Path | str) -> None:
        """Write the matches table; see `closerange.matching.matches_table`."""
        from closerange.matching.matches_table import write_matches  # noqa: PLC0415  # cycle

        write_matches(self, path)

    def _among(self, cameras: tuple[str, ...]) -> Correspondences:
        """Return the same points with columns for more cameras."""
        places = [cameras.index(name) for name in self.cameras]
        shape = (len(self), len(cameras))
        xy, cov = np.full((*shape, 2), np.nan), np.full((*shape, 2, 2), np.nan)
        flags = np.zeros(shape, np.int64)
        xy[:, places], cov[:, places], flags[:, places] = self.xy_px, self.cov_px2, self.flags
        return Correspondences(
            self.placement, self.point, cameras, xy, cov, self.mismatch, flags, self.reading
        )


def _shaped(values: ArrayLike, shape: tuple[int, ...]) -> FloatArray:
    """Give an empty list the shape of no rows; leave all else to the check of shapes."""
    array = np.asarray(values, np.float64)
    return array.reshape(shape) if array.size == 0 and 0 in shape else array
