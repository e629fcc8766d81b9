"""How badly every edge point would fit at every height: the erosion's mismatch, made tolerant.

The table is made some heights at a time and never kept: of 200 000 edge points it would take
400 MB.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from closerange.features.edge_chains import chain_line
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

AT_ONCE = 500_000
"""Entries of the table that are worked on at once: with their sums 6 MB, which a processor
keeps near."""


class Element(Protocol):
    """A structuring element: which edge points belong to each one's."""

    def mean(self, running: FloatArray, level: IntArray, point: IntArray) -> FloatArray:
        """Return the mean misfit around points at levels, shape (R,).

        Parameters
        ----------
        running : ndarray, shape (L, N + 1)
            Sums of the misfits, at each level, of so many points of the line.
        level : ndarray of int, shape (R,)
            Row of `running`.
        point : ndarray of int, shape (R,)
            The edge points.
        """
        ...


@dataclass(frozen=True, slots=True, eq=False)
class Line:
    """All edge points in one row, chain after chain: sums along it are sums along chains.

    Attributes
    ----------
    order : ndarray of int, shape (N,)
        The points in that order.
    rank : ndarray of int, shape (N,)
        Place of each point in it.
    start, stop : ndarray of int, shape (N,)
        First place of the chain of each point, and the one after its last.
    """

    order: IntArray
    rank: IntArray
    start: IntArray
    stop: IntArray

    @classmethod
    def of(cls, after: IntArray) -> Line:
        """Lay out chains, given the next point of each or -1."""
        order, end = chain_line(after)
        length = np.diff(end, prepend=0)
        rank, start, stop = (np.empty_like(order) for _ in range(3))
        rank[order] = np.arange(len(order))
        start[order], stop[order] = np.repeat(end - length, length), np.repeat(end, length)
        return cls(order, rank, start, stop)


@dataclass(frozen=True, slots=True, eq=False)
class DepthTable:
    """Misfit in px of N edge points at K heights.

    The thesis counts edge pixels of the structuring element that miss an edge in the other view.
    Here every edge pixel pays for its distance to the nearest candidate of its own, measured
    across the candidate's edge, up to a limit; the sum over a window is the mismatch of the
    structuring element carried to the height of its plane.

    Attributes
    ----------
    line : Line
        The edge points.
    levels : int
        K.
    axis : int
        World axis along which heights are counted.
    origin_mm : float
        Where the first camera stands along it. Levels are even steps of 1 / (height - origin),
        which is how disparity grows: near and far are sampled alike.
    lowest, step : float
        The first level, and from level to level, 1/mm.
    place : ndarray of int, shape (M,)
        Where the point of each candidate is in the line; of all five arrays only rows that reach
        into the table, by level.
    height, rate, price : ndarray, shape (M,)
        Level's unit, misfit per unit, misfit at the candidate's own height.
    first, last : ndarray of int, shape (M,)
        Levels at which the misfit is below the limit.
    """

    line: Line
    levels: int
    axis: int
    origin_mm: float
    lowest: float
    step: float
    place: IntArray
    height: FloatArray
    rate: FloatArray
    price: NDArray[np.float32]
    first: NDArray[np.int16]
    last: NDArray[np.int16]

    @classmethod
    def of(
        cls,
        line: Line,
        candidates: Candidates,
        price: FloatArray,
        axis: int,
        origin_mm: float,
    ) -> DepthTable:
        """Tabulate the candidates of edge points.

        Parameters
        ----------
        line : Line
            N points.
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
        rate = px_per_mm * np.maximum(candidates.sine, SHALLOW)
        reach = np.maximum(MISFIT_LIMIT_PX - price, 0.0) / rate
        first = np.maximum(np.ceil((height - reach - lowest) / step), 0).astype(np.int64)
        last = np.minimum(np.floor((height + reach - lowest) / step), levels - 1).astype(np.int64)
        order = np.argsort(first.astype(np.uint16), kind="stable")
        order = order[(first <= last)[order]]
        return cls(
            line=line,
            levels=levels,
            axis=axis,
            origin_mm=origin_mm,
            lowest=lowest,
            step=step,
            place=line.rank[candidates.point[order]],
            height=height[order],
            rate=rate[order],
            price=price[order].astype(np.float32),
            first=first[order].astype(np.int16),
            last=last[order].astype(np.int16),
        )

    def column(self, height_mm: FloatArray) -> IntArray:
        """Return the nearest level of heights; -1 outside of the table."""
        with np.errstate(divide="ignore"):
            column = np.rint((1.0 / (height_mm - self.origin_mm) - self.lowest) / self.step)
        inside = (column >= 0) & (column < self.levels)
        return np.where(inside, column, -1).astype(np.int64)

    def at(self, point: IntArray, height_mm: FloatArray) -> FloatArray:
        """Return the misfit of points at heights; the limit outside of the table."""
        shape = np.shape(point)
        place = self.line.rank[np.ravel(point)]
        misfit = np.full(place.shape, MISFIT_LIMIT_PX)
        for part, rows, level in self._visited(self.column(np.ravel(height_mm))):
            misfit[rows] = part[level, place[rows]]
        return misfit.reshape(shape)

    def means(self, candidates: Candidates, elements: Sequence[Element]) -> list[FloatArray]:
        """Return the mean misfit within structuring elements, shape (M,) each.

        Parameters
        ----------
        candidates : Candidates
            M rows; each is asked at its own height.
        elements : sequence of Element
            E.g. `Square` and `Strip`.
        """
        column = self.column(candidates.xyz_mm[:, self.axis])
        found = [np.full(len(candidates), MISFIT_LIMIT_PX) for _ in elements]
        running = np.zeros((0, 0))
        for part, rows, level in self._visited(column):
            if len(running) < len(part):
                running = np.zeros((len(part), part.shape[1] + 1))
            sums = running[: len(part)]
            np.cumsum(part, axis=1, dtype=np.float64, out=sums[:, 1:])
            point = candidates.point[rows]
            for mean, element in zip(found, elements, strict=True):
                mean[rows] = element.mean(sums, level, point)
        return found

    def _visited(
        self, column: IntArray
    ) -> Iterator[tuple[NDArray[np.float32], IntArray, IntArray]]:
        """Yield pieces of the table, which of the given columns lie in each, and where."""
        # a sort of small unsigned numbers takes no time; -1 comes last
        order = np.argsort(column.astype(np.uint16), kind="stable")
        sorted_column = column.astype(np.int16)[order]
        known = len(column) - int((column < 0).sum())
        width = max(AT_ONCE // max(len(self.line.rank), 1), 1)
        memory = np.empty((min(width, self.levels), len(self.line.rank)), dtype=np.float32)
        for start in range(0, self.levels, width):
            low, high = np.searchsorted(sorted_column[:known], [start, start + width])
            if low < high:
                part = self.rows(start, min(start + width, self.levels), memory)
                yield part, order[low:high], sorted_column[low:high].astype(np.int64) - start

    def rows(
        self, start: int, stop: int, memory: NDArray[np.float32] | None = None
    ) -> NDArray[np.float32]:
        """Return the misfits at some levels, shape (stop - start, N), points as in the line."""
        count = len(self.line.rank)
        misfit = np.empty((stop - start, count), np.float32) if memory is None else memory
        misfit = misfit[: stop - start]
        misfit.fill(MISFIT_LIMIT_PX)
        begun = int(np.searchsorted(self.first, stop))
        some = np.flatnonzero(self.last[:begun] >= start)
        level = np.maximum(self.first[some], start).astype(np.int64)
        number = np.minimum(self.last[some], stop - 1) - level + 1
        which = np.repeat(some, number)
        level = np.arange(len(which)) + np.repeat(level - (np.cumsum(number) - number), number)
        value = np.abs(self.lowest + level * self.step - self.height[which])
        value = value * self.rate[which] + self.price[which]
        # one index, not two: NumPy is five times faster then
        entry = (level - start) * count + self.place[which]
        np.minimum.at(misfit.reshape(-1), entry, value.astype(np.float32))
        return misfit


@dataclass(frozen=True, slots=True, eq=False)
class Strip:
    """The element that follows the point's own chain, so many points to each side.

    Neither time nor memory grows with its length. A closed chain counts as cut at its first point.
    """

    low: IntArray
    high: IntArray

    @classmethod
    def of(cls, line: Line, reach: int) -> Strip:
        """Make the element from how many points there are to each side."""
        return cls(
            np.maximum(line.rank - reach, line.start), np.minimum(line.rank + reach + 1, line.stop)
        )

    def mean(self, running: FloatArray, level: IntArray, point: IntArray) -> FloatArray:
        """Return the mean misfit around points at levels."""
        low, high = self.low[point], self.high[point]
        return np.asarray((running[level, high] - running[level, low]) / (high - low))


@dataclass(frozen=True, slots=True, eq=False)
class Square:
    """A square element, of `CELLS` by `CELLS` cells around the point's own.

    Sums go over runs of the line within a cell, row after row of cells, so that the cells of an
    element are a few pieces of a row of runs: the cost does not grow with the number of edge
    points in the element.

    Attributes
    ----------
    begin, end : ndarray of int, shape (R,)
        Places on the line where each run begins and ends, in the order of their cells.
    cell : ndarray of int, shape (N,)
        Number of the cell of each point, of those that hold any.
    low, high : ndarray of int, shape (CELLS, U)
        For each of these cells, and each row of the element, the first run and the one after the
        last.
    count : ndarray, shape (U,)
        Edge points in the element.
    """

    begin: IntArray
    end: IntArray
    cell: IntArray
    low: IntArray
    high: IntArray
    count: FloatArray

    @classmethod
    def of(cls, line: Line, xy_px: FloatArray, half_width_px: float) -> Square:
        """Make the element from points of shape (N, 2) and half its side."""
        size = 2 * half_width_px / CELLS
        reach = CELLS // 2
        column, row = ((xy_px - xy_px.min(axis=0)) / size).astype(np.int64).T
        across = int(column.max()) + 1 + 2 * reach  # so many that rows do not touch
        cell = row * across + column
        along = cell[line.order]
        begin = np.flatnonzero(np.r_[True, along[1:] != along[:-1]])
        end = np.r_[begin[1:], len(along)]
        order = np.argsort(along[begin], kind="stable")
        begin, end, cells = begin[order], end[order], along[begin[order]]
        used, mine = np.unique(cell, return_inverse=True)
        rows = np.arange(-reach, reach + 1)[:, None] * across + used
        low = np.searchsorted(cells, rows - reach, side="left")
        high = np.searchsorted(cells, rows + reach, side="right")
        points = np.r_[0, np.cumsum(end - begin)]
        return cls(begin, end, mine, low, high, (points[high] - points[low]).sum(axis=0))

    def mean(self, running: FloatArray, level: IntArray, point: IntArray) -> FloatArray:
        """Return the mean misfit around points at levels."""
        runs = np.zeros((len(running), len(self.begin) + 1))
        np.cumsum(running[:, self.end] - running[:, self.begin], axis=1, out=runs[:, 1:])
        own = self.cell[point]
        flat, first = runs.ravel(), level * runs.shape[1]
        total = np.zeros(len(point))
        for low, high in zip(self.low, self.high, strict=True):
            total += flat[first + high[own]] - flat[first + low[own]]
        return np.asarray(total / self.count[own])
