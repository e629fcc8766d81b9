"""Repeated readings gathered by position: mean, scatter and predicted covariance of each."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from closerange.flags import Flag
from closerange.geometry.arrays import BoolArray, FloatArray, IntArray
from closerange.position.positions import Positions


@dataclass(frozen=True, slots=True, eq=False)
class Groups:
    """Readings by position; P positions of N used rows, described line by line."""

    key: tuple[tuple[str, str], ...]
    group: IntArray  # (N,) position of each row
    count: IntArray  # (P,)
    mean: FloatArray  # (P, 3)
    deviation: FloatArray  # (N, 3) of each row from its mean
    std: FloatArray  # (P, 3), NaN for one reading
    range: FloatArray  # (P, 3), NaN for one reading
    flags: IntArray  # (P,)
    frozen: BoolArray  # (P,)
    total: FloatArray  # (P, 3, 3) predicted covariance of one reading
    noise: FloatArray | None  # (P, 3, 3) the part of it that differs between readings

    @property
    def scatter_count(self) -> IntArray:
        """Readings that tell about repeatability: none of a frozen position."""
        return np.where(self.frozen, 0, self.count)


def group_readings(positions: Positions, used: BoolArray, noise_cov: ArrayLike) -> Groups:
    """Gather the usable readings of each position.

    Parameters
    ----------
    positions : Positions
        M rows.
    used : ndarray of bool, shape (M,)
        Which count.
    noise_cov : array_like, shape (M, 3, 3)
        Part of their covariance that differs between readings; NaN where unknown.

    Returns
    -------
    Groups
        In the order of the table, whichever of their readings are left out.
    """
    rows = positions.select(used)
    keys = list(zip(rows.placement, rows.point, strict=True))
    found = set(keys)
    order = dict.fromkeys(zip(positions.placement, positions.point, strict=True))
    number = {key: i for i, key in enumerate(key for key in order if key in found)}
    group = np.array([number[key] for key in keys])
    count = np.bincount(group)
    mean = _mean_of(rows.xyz_mm, group, count)
    deviation = rows.xyz_mm - mean[group]
    squares = _mean_of(deviation**2, group, count)
    low, high = np.full_like(mean, np.inf), np.full_like(mean, -np.inf)
    np.minimum.at(low, group, rows.xyz_mm)
    np.maximum.at(high, group, rows.xyz_mm)
    several = (count > 1)[:, None]
    bessel = count[:, None] / np.maximum(count - 1, 1)[:, None]
    frozen = (count > 1) & (high == low).all(axis=1)
    flags = np.where(frozen, int(Flag.frozen), 0)
    np.bitwise_or.at(flags, group, rows.flags)
    stated = np.broadcast_to(np.asarray(noise_cov, np.float64), (len(positions), 3, 3))[used]
    return Groups(
        key=tuple(number),
        group=group,
        count=count,
        mean=mean,
        deviation=deviation,
        # equal readings differ from their rounded mean: a frozen position has exactly no scatter
        std=np.where(several, np.where(frozen[:, None], 0.0, np.sqrt(squares * bessel)), np.nan),
        range=np.where(several, high - low, np.nan),
        flags=flags,
        frozen=frozen,
        total=_mean_of(rows.cov_mm2, group, count),
        noise=_mean_of(stated, group, count) if np.isfinite(stated).all() else None,
    )


def _mean_of(values: FloatArray, group: IntArray, count: IntArray) -> FloatArray:
    """Average rows by group."""
    total = np.zeros((len(count), *values.shape[1:]))
    np.add.at(total, group, values)
    mean: FloatArray = total / count.reshape(-1, *(1,) * (values.ndim - 1))
    return mean
