"""Points seen in images: the points table as a type."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike, NDArray

from closerange.errors import InputError
from closerange.features.threshold import Thresholds
from closerange.geometry.arrays import FloatArray, IntArray, frozen_array, frozen_ints

SYMMETRY = 1e-9
"""Share of the standard deviations' product by which a computed matrix may be unsymmetric."""

Key = tuple[str, str, str, str]
"""(camera, placement, reading, point): names one row."""


@dataclass(frozen=True, slots=True, eq=False)
class ImagePoints:
    """Image points of any number of cameras, placements and readings; N rows.

    Attributes
    ----------
    camera, placement, point : tuple of str
        Names; (camera, placement, reading, point) is unique. `placement` is blank when there
        is only one state of the world.
    xy_px : ndarray, shape (N, 2)
        Position in px as seen, neither lens nor perspective corrected; NaN where not found.
    cov_px2 : ndarray, shape (N, 2, 2)
        Covariance in px^2; NaN where unknown.
    flags : ndarray of int, shape (N,)
        `Flag` bits.
    ellipse : ndarray, shape (N, 3)
        Image ellipse of a disc: semi-axes a >= b in px, angle of the major axis from +x
        towards +y in rad; NaN for other features.
    disc_diameter_mm : ndarray, shape (N,)
        True diameter of a disc; NaN for other features.
    reading : tuple of str
        Repeated measurement of the same placement; blank when there is only one.
    size_px : dict of str to (int, int)
        Width and height of a camera's images, where known.
    noise_cov_px2 : ndarray, shape (N, 2, 2)
        The part of `cov_px2` that differs between readings of a still scene, in px^2; NaN
        where unknown.
    thresholds : dict of (str, str, str) to ThresholdReport
        How discs were separated from the background, by camera, placement and reading; only
        of images that were searched for discs. Tables in files do not hold it.
    """

    camera: tuple[str, ...]
    placement: tuple[str, ...]
    point: tuple[str, ...]
    xy_px: FloatArray
    cov_px2: FloatArray
    flags: IntArray
    ellipse: FloatArray
    disc_diameter_mm: FloatArray
    reading: tuple[str, ...]
    size_px: Mapping[str, tuple[int, int]] = field(default_factory=dict)
    noise_cov_px2: FloatArray = field(default_factory=lambda: np.array(np.nan))
    thresholds: Thresholds = field(default_factory=dict)

    def __post_init__(self) -> None:
        count = len(self.camera)
        for name in ("camera", "placement", "point", "reading"):
            texts = tuple(getattr(self, name))
            if len(texts) != count:
                raise ValueError(f"{name} has {len(texts)} rows, camera has {count}")
            object.__setattr__(self, name, texts)
        set_field = object.__setattr__
        set_field(self, "xy_px", frozen_array(self.xy_px, (count, 2), "xy_px"))
        set_field(self, "cov_px2", frozen_array(self.cov_px2, (count, 2, 2), "cov_px2"))
        noise = np.asarray(self.noise_cov_px2)
        noise = noise if noise.ndim else np.full((count, 2, 2), noise)
        set_field(self, "noise_cov_px2", frozen_array(noise, (count, 2, 2), "noise_cov_px2"))
        set_field(self, "flags", frozen_ints(self.flags, (count,), "flags"))
        set_field(self, "ellipse", frozen_array(self.ellipse, (count, 3), "ellipse"))
        set_field(
            self,
            "disc_diameter_mm",
            frozen_array(self.disc_diameter_mm, (count,), "disc_diameter_mm"),
        )
        set_field(self, "size_px", dict(self.size_px))
        set_field(self, "thresholds", dict(self.thresholds))
        self._require_covariances("cov_px2")
        self._require_covariances("noise_cov_px2")
        keys = self.keys()
        if len(set(keys)) < count:
            twice = next(key for key in keys if keys.count(key) > 1)
            raise InputError(
                f"point {twice[3]!r} of camera {twice[0]!r}, placement {twice[1]!r} appears twice",
                remedy="give each placement its own name, or remove one row",
            )

    def _require_covariances(self, name: str) -> None:
        """Refuse what is neither unknown (NaN) nor symmetric and positive definite."""
        cov: FloatArray = getattr(self, name)
        # a table holds three of the four numbers: what is read back must be what was there
        even = (cov + cov.transpose(0, 2, 1)) / 2
        object.__setattr__(self, name, frozen_array(even, cov.shape, name))
        xx, xy, yx, yy = cov.reshape(-1, 4).T
        with np.errstate(invalid="ignore"):
            size = np.sqrt(xx) * np.sqrt(yy)  # of negative numbers NaN, which no comparison passes
            good = (size > 0) & (np.maximum(abs(xy), abs(yx)) < size) & np.isfinite(size)
            good &= abs(xy - yx) <= SYMMETRY * size
        for row in np.flatnonzero(~good & ~np.isnan(cov).all(axis=(1, 2))):
            camera, placement, _, point = self.keys()[row]
            where = f", placement {placement!r}" if placement else ""
            raise InputError(
                f"camera {camera!r}{where}, point {point!r}: {name} = {cov[row].tolist()} is not a "
                "covariance",
                remedy="give a symmetric positive definite matrix, or NaN where it is not known",
            )

    @classmethod
    def of(  # noqa: PLR0913
        cls,
        *,
        camera: str | Sequence[str],
        point: Sequence[str],
        xy_px: ArrayLike,
        placement: str | Sequence[str] = "",
        reading: str | Sequence[str] = "",
        cov_px2: ArrayLike | None = None,
        flags: ArrayLike | None = None,
        ellipse: ArrayLike | None = None,
        disc_diameter_mm: ArrayLike | None = None,
        size_px: Mapping[str, tuple[int, int]] | None = None,
        noise_cov_px2: ArrayLike | None = None,
        thresholds: Thresholds | None = None,
    ) -> ImagePoints:
        """Build from whatever is known; the rest becomes NaN, blank or 0.

        Parameters
        ----------
        camera, placement, reading : str or sequence of str
            One name for all rows, or one a row.
        point : sequence of str
            One name a row.
        xy_px, cov_px2, flags, ellipse, disc_diameter_mm, size_px, noise_cov_px2, thresholds
            As the attributes; `disc_diameter_mm` may be one number for all rows.

        Returns
        -------
        ImagePoints
            N = len(point) rows.
        """
        count = len(point)

        def names(value: str | Sequence[str]) -> tuple[str, ...]:
            return (value,) * count if isinstance(value, str) else tuple(value)

        def numbers(value: ArrayLike | None, shape: tuple[int, ...]) -> FloatArray:
            if not count:  # an empty list has no columns
                return np.empty(shape)
            return np.broadcast_to(
                np.float64(np.nan) if value is None else np.asarray(value), shape
            )

        return cls(
            camera=names(camera),
            placement=names(placement),
            point=tuple(point),
            xy_px=numbers(xy_px, (count, 2)),
            cov_px2=numbers(cov_px2, (count, 2, 2)),
            flags=np.zeros(count, np.int64) if flags is None else np.asarray(flags, np.int64),
            ellipse=numbers(ellipse, (count, 3)),
            disc_diameter_mm=numbers(disc_diameter_mm, (count,)),
            reading=names(reading),
            size_px=size_px or {},
            noise_cov_px2=numbers(noise_cov_px2, (count, 2, 2)),
            thresholds=thresholds or {},
        )

    def __len__(self) -> int:
        return len(self.camera)

    def __add__(self, other: ImagePoints) -> ImagePoints:
        """Join two tables; a row that is in both is an `InputError`."""
        for camera in self.size_px.keys() & other.size_px.keys():
            if self.size_px[camera] != other.size_px[camera]:
                raise InputError(
                    f"camera {camera!r} has images of {_size(self.size_px[camera])} "
                    f"and of {_size(other.size_px[camera])}",
                    remedy="use images of one size, or name the cameras apart",
                )
        return ImagePoints(
            camera=self.camera + other.camera,
            placement=self.placement + other.placement,
            point=self.point + other.point,
            xy_px=np.concatenate([self.xy_px, other.xy_px]),
            cov_px2=np.concatenate([self.cov_px2, other.cov_px2]),
            flags=np.concatenate([self.flags, other.flags]),
            ellipse=np.concatenate([self.ellipse, other.ellipse]),
            disc_diameter_mm=np.concatenate([self.disc_diameter_mm, other.disc_diameter_mm]),
            reading=self.reading + other.reading,
            size_px={**self.size_px, **other.size_px},
            noise_cov_px2=np.concatenate([self.noise_cov_px2, other.noise_cov_px2]),
            thresholds={**self.thresholds, **other.thresholds},
        )

    def keys(self) -> list[Key]:
        """Return (camera, placement, reading, point) of each row."""
        return list(zip(self.camera, self.placement, self.reading, self.point, strict=True))

    @property
    def cameras(self) -> tuple[str, ...]:
        """Camera names in the order of their first row."""
        return tuple(dict.fromkeys(self.camera))

    @property
    def found(self) -> NDArray[np.bool_]:
        """Which rows have a position."""
        known: NDArray[np.bool_] = np.asarray(np.isfinite(self.xy_px).all(axis=1))
        return known

    def select(self, rows: ArrayLike) -> ImagePoints:
        """Keep some rows.

        Parameters
        ----------
        rows : array_like of bool, shape (N,), or of int
            Mask or row indices.

        Returns
        -------
        ImagePoints
            The chosen rows in the given order.
        """
        chosen = np.asarray(rows)
        index = np.arange(len(self))[chosen if chosen.size else slice(0)]  # [] has a float's type
        return ImagePoints(
            camera=tuple(self.camera[i] for i in index),
            placement=tuple(self.placement[i] for i in index),
            point=tuple(self.point[i] for i in index),
            xy_px=self.xy_px[index],
            cov_px2=self.cov_px2[index],
            flags=self.flags[index],
            ellipse=self.ellipse[index],
            disc_diameter_mm=self.disc_diameter_mm[index],
            reading=tuple(self.reading[i] for i in index),
            size_px=self.size_px,
            noise_cov_px2=self.noise_cov_px2[index],
            thresholds=self.thresholds,
        )

    def of_camera(self, camera: str) -> ImagePoints:
        """Keep the rows of one camera."""
        return self.select([name == camera for name in self.camera])

    def shifted(self, offset_px: ArrayLike) -> ImagePoints:
        """Add an offset to all positions, as for a crop of a larger image.

        Parameters
        ----------
        offset_px : array_like, shape (2,) or (N, 2)
            Full-image coordinates of the crop's pixel (0, 0).

        Returns
        -------
        ImagePoints
            Covariances and ellipses are unchanged; image sizes are forgotten.
        """
        return replace(self, xy_px=self.xy_px + np.asarray(offset_px), size_px={})

    def to_csv(self, path: Path | str) -> None:
        """Write the points table; see `closerange.features.points_table`."""
        from closerange.features.points_table import write_points  # noqa: PLC0415  # cycle

        write_points(self, path)


def _size(size_px: tuple[int, int]) -> str:
    return f"{size_px[0]}x{size_px[1]}"
