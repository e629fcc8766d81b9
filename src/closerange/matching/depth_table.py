"""How badly every edge point would fit at every height: the erosion's mismatch, made tolerant."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from closerange.geometry.arrays import FloatArray, IntArray
from closerange.matching.candidates import Candidates

MISFIT_LIMIT_PX = 3.0
"""A misfit above it counts no more: what is not there is not there."""

SHALLOW = 0.15
"""Sine between edge and epipolar curve below which the misfit is not divided down further: an edge
along the curve would fit everywhere."""

CELLS = 5
"""Cells across a structuring element. The window of a point is the five by five cells around its
own, so its centre is off by a tenth of its width at most."""

MOST_LEVELS = 512
"""Heights in the table: an epipolar segment of more pixels is sampled more coarsely."""


@dataclass(frozen=True, slots=True, eq=False)
class DepthTable:
    """Misfit in px of N edge points at K heights.

    The thesis counts edge pixels of the structuring element that miss an edge in the other view.
    Here every edge pixel pays for its distance to the nearest candidate of its own, measured
    across the candidate's edge, up to a limit; the sum over a window is the mismatch of the
    structuring element carried to the height of its plane.

    Attributes
    ----------
    misfit : ndarray of float32, shape (N, K)
        In px.
    axis : int
        World axis along which heights are counted.
    origin_mm : float
        Where the first camera stands along it. Columns are even steps of 1 / (height - origin),
        which is how disparity grows: near and far are sampled alike.
    lowest, step : float
        The first column, and from column to column, 1/mm.
    """

    misfit: NDArray[np.float32]
    axis: int
    origin_mm: float
    lowest: float
    step: float

    @classmethod
    def of(
        cls,
        count: int,
        candidates: Candidates,
        price: FloatArray,
        axis: int,
        origin_mm: float,
    ) -> DepthTable:
        """Tabulate the candidates of so many edge points.

        Parameters
        ----------
        count : int
            N.
        candidates : Candidates
            M rows, at least one.
        price : ndarray, shape (M,)
            Misfit in px of a candidate at its own height.
        axis : int
            World axis along which heights are counted.
        origin_mm : float
            Where the first camera stands along it.
        """
        away = candidates.xyz_mm[:, axis] - origin_mm
        height, px_per_mm = 1.0 / away, candidates.px_per_mm * away**2  # both of 1 / away
        lowest, highest = float(height.min()), float(height.max())
        step = 1.0 / float(np.median(px_per_mm))
        step = max(step, (highest - lowest) / (MOST_LEVELS - 1))
        levels = int((highest - lowest) / step) + 2
        misfit = np.full((count, levels), MISFIT_LIMIT_PX, dtype=np.float32)
        rate = px_per_mm * np.maximum(candidates.sine, SHALLOW)
        reach = int(np.ceil(MISFIT_LIMIT_PX / (rate.min() * step)))
        nearest = np.rint((height - lowest) / step).astype(np.int64)
        for offset in range(-reach, reach + 1):
            column = nearest + offset
            value = np.abs(lowest + column * step - height) * rate + price
            rows = np.flatnonzero((value < MISFIT_LIMIT_PX) & (column >= 0) & (column < levels))
            _lower(misfit, candidates.point[rows], column[rows], value[rows])
        return cls(misfit, axis, origin_mm, lowest, step)

    def column(self, height_mm: FloatArray) -> IntArray:
        """Return the nearest column of heights; -1 outside of the table."""
        with np.errstate(divide="ignore"):
            column = np.rint((1.0 / (height_mm - self.origin_mm) - self.lowest) / self.step)
        inside = (column >= 0) & (column < self.misfit.shape[1])
        return np.where(inside, column, -1).astype(np.int64)

    def at(self, point: IntArray, height_mm: FloatArray) -> FloatArray:
        """Return the misfit of points at heights; the limit outside of the table."""
        column = self.column(height_mm)
        return np.where(column >= 0, self.misfit[point, column], MISFIT_LIMIT_PX)

    def support(
        self, xy_px: FloatArray, candidates: Candidates, half_width_px: float
    ) -> FloatArray:
        """Return the mean misfit within a square structuring element, shape (M,).

        Parameters
        ----------
        xy_px : ndarray, shape (N, 2)
            The edge points.
        candidates : Candidates
            M rows; each is asked at its own height.
        half_width_px : float
            Half the side of the element.

        Notes
        -----
        The sums go over cells of a fifth of the element, so that the cost does not grow with the
        number of edge points in a window.
        """
        size = 2 * half_width_px / CELLS
        cell = ((xy_px - xy_px.min(axis=0)) / size).astype(np.int64)
        across, down = (cell.max(axis=0) + 1).tolist()
        number = cell[:, 1] * across + cell[:, 0]
        order = np.argsort(number, kind="stable")
        used, start = np.unique(number[order], return_index=True)
        total = np.zeros((down * across, self.misfit.shape[1] + 1), dtype=np.float32)
        total[used, :-1] = np.add.reduceat(self.misfit[order], start, axis=0)
        total[used, -1] = np.diff(np.r_[start, len(number)])  # how many points
        grid = _windowed(total.reshape(down, across, -1))
        flat = grid.reshape(down * across, -1)
        here = number[candidates.point]
        column = self.column(candidates.xyz_mm[:, self.axis])
        return np.asarray(flat[here, column] / flat[here, -1], dtype=np.float64)


def _lower(table: NDArray[np.float32], row: IntArray, column: IntArray, value: FloatArray) -> None:
    """Put the least of the values that fall into each entry."""
    np.minimum.at(table, (row, column), value.astype(np.float32))


def _windowed(grid: NDArray[np.float32]) -> NDArray[np.float32]:
    """Sum over `CELLS` by `CELLS` cells around each, shape kept."""
    for axis in (0, 1):
        summed = grid.copy()
        for offset in range(1, CELLS // 2 + 1):
            if offset >= grid.shape[axis]:
                break
            near = [slice(None)] * 3
            far = [slice(None)] * 3
            near[axis], far[axis] = slice(None, -offset), slice(offset, None)
            summed[tuple(near)] += grid[tuple(far)]
            summed[tuple(far)] += grid[tuple(near)]
        grid = summed
    return grid
