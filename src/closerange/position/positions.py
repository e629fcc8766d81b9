"""World points with covariance: the positions table as a type."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike, NDArray

from closerange.geometry.arrays import FloatArray, IntArray, frozen_array, frozen_ints


@dataclass(frozen=True, slots=True, eq=False)
class Positions:
    """World positions; M rows.

    Attributes
    ----------
    placement, point : tuple of str
        Names; (placement, reading, point) is unique.
    xyz_mm : ndarray, shape (M, 3)
        World position in mm; NaN where fewer than two rays define it.
    cov_mm2 : ndarray, shape (M, 3, 3)
        Covariance from image and calibration uncertainty, mm^2.
    residual_px : ndarray, shape (M,)
        sqrt(sum of squared residuals / (2 x cameras)), px.
    cameras : ndarray of int, shape (M,)
        How many cameras were used.
    flags : ndarray of int, shape (M,)
        `Flag` bits.
    reading : tuple of str
        Repeated measurement of the same placement; blank when there is only one.
    dof : int or None
        Degrees of freedom of the variance behind `cov_mm2`; None when the covariances of the
        image points were given and nothing was added to them. A 95 % region is
        ``e' cov^-1 e <= 3 F(0.95; 3, dof)``.
    noise_cov_mm2 : ndarray, shape (M, 3, 3)
        The part of `cov_mm2` that differs between readings of a still scene, mm^2; NaN where
        unknown.
    doubt : str
        Why most of the image points cannot be those of the rig; empty where nothing says so. Not
        a part of the table.
    """

    placement: tuple[str, ...]
    point: tuple[str, ...]
    xyz_mm: FloatArray
    cov_mm2: FloatArray
    residual_px: FloatArray
    cameras: IntArray
    flags: IntArray
    reading: tuple[str, ...]
    dof: int | None = None
    noise_cov_mm2: FloatArray = field(default_factory=lambda: np.array(np.nan))
    doubt: str = ""

    def __post_init__(self) -> None:
        count = len(self.point)
        if len(self.placement) != count or len(self.reading) != count:
            raise ValueError("placement, reading and point differ in length")
        for name in ("placement", "point", "reading"):
            object.__setattr__(self, name, tuple(getattr(self, name)))
        object.__setattr__(self, "xyz_mm", frozen_array(self.xyz_mm, (count, 3), "xyz_mm"))
        object.__setattr__(self, "cov_mm2", frozen_array(self.cov_mm2, (count, 3, 3), "cov_mm2"))
        noise = np.asarray(self.noise_cov_mm2)
        noise = noise if noise.ndim else np.full((count, 3, 3), noise)
        noise = frozen_array(noise, (count, 3, 3), "noise_cov_mm2")
        object.__setattr__(self, "noise_cov_mm2", noise)
        object.__setattr__(
            self, "residual_px", frozen_array(self.residual_px, (count,), "residual_px")
        )
        object.__setattr__(self, "cameras", frozen_ints(self.cameras, (count,), "cameras"))
        object.__setattr__(self, "flags", frozen_ints(self.flags, (count,), "flags"))

    def __len__(self) -> int:
        return len(self.point)

    def keys(self) -> list[tuple[str, str, str]]:
        """Return (placement, reading, point) of each row."""
        return list(zip(self.placement, self.reading, self.point, strict=True))

    @property
    def measured(self) -> NDArray[np.bool_]:
        """Which rows have a position."""
        known: NDArray[np.bool_] = np.asarray(np.isfinite(self.xyz_mm).all(axis=1))
        return known

    def select(self, rows: ArrayLike) -> Positions:
        """Keep some rows, by mask or index."""
        chosen = np.asarray(rows)
        index = np.arange(len(self))[chosen if chosen.size else slice(0)]  # [] has a float's type

        def texts(values: Sequence[str]) -> tuple[str, ...]:
            return tuple(values[i] for i in index)

        return Positions(
            placement=texts(self.placement),
            point=texts(self.point),
            xyz_mm=self.xyz_mm[index],
            cov_mm2=self.cov_mm2[index],
            residual_px=self.residual_px[index],
            cameras=self.cameras[index],
            flags=self.flags[index],
            reading=texts(self.reading),
            dof=self.dof,
            noise_cov_mm2=self.noise_cov_mm2[index],
            doubt=self.doubt,
        )

    def to_csv(self, path: Path | str) -> None:
        """Write the positions table; see `closerange.position.positions_table`."""
        from closerange.position.positions_table import write_positions  # noqa: PLC0415  # cycle

        write_positions(self, path)
