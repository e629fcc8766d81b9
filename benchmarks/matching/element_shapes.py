"""Structuring elements that the default matcher does not use: discs, and bars along the edge."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from closerange.features.edges import EdgePoints
from closerange.matching.depth_table import Line

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]

CELLS = 7
"""Cells across the narrower side of an element; smaller ones than 3 px hold one point or none."""

DIRECTIONS = 8
"""Of bars: one turned by half a step of 22.5 degrees still holds three quarters of itself."""

WITHIN = 5  # parts of a cell to each side, to tell how much of it an element covers


@dataclass(frozen=True, slots=True, eq=False)
class Kernels:
    """An element of any shape, whose sums go over cells.

    Attributes
    ----------
    line : Line
        N edge points.
    cell : ndarray of int, shape (N, 2)
        Row and column of each in the grid of cells.
    kernel : tuple of ndarray
        How much of the cells around a point's own belongs to its element, for each direction.
    direction : ndarray of int, shape (N,)
        Which of them is a point's.
    """

    line: Line
    cell: IntArray
    kernel: tuple[NDArray[np.float32], ...]
    direction: IntArray

    @classmethod
    def disc(cls, edges: EdgePoints, line: Line, radius_px: float) -> Kernels:
        """Make a disc."""
        cell_px = max(2 * radius_px / CELLS, 3.0)
        x, y = _grid(radius_px, cell_px)
        kernel = _shares(np.hypot(x, y) <= radius_px)
        direction = np.zeros(len(edges), np.int64)
        return cls(line, _cells(edges, cell_px), (kernel,), direction)

    @classmethod
    def bar(cls, edges: EdgePoints, line: Line, half_length_px: float) -> Kernels:
        """Make a bar along the edge through each point, a third as wide as it is long."""
        half_width_px = half_length_px / 3
        cell_px = max(2 * half_width_px / CELLS, 3.0)
        x, y = _grid(np.hypot(half_length_px, half_width_px), cell_px)
        kernels = []
        for turn in np.arange(DIRECTIONS) * np.pi / DIRECTIONS:
            along = x * np.cos(turn) + y * np.sin(turn)
            across = y * np.cos(turn) - x * np.sin(turn)
            inside = (np.abs(along) <= half_length_px) & (np.abs(across) <= half_width_px)
            kernels.append(_shares(inside))
        angle = np.arctan2(edges.tangent[:, 1], edges.tangent[:, 0])
        direction = np.rint(angle * DIRECTIONS / np.pi).astype(np.int64) % DIRECTIONS
        return cls(line, _cells(edges, cell_px), tuple(kernels), direction)

    def mean(self, running: FloatArray, level: IntArray, point: IntArray) -> FloatArray:
        """Return the mean misfit around points at levels; see `Element`."""
        misfit = np.diff(running, axis=1)
        rows, columns = (self.cell.max(axis=0) + 1).tolist()
        number = (self.cell[:, 0] * columns + self.cell[:, 1])[self.line.order]
        order = np.argsort(number, kind="stable")
        used, start = np.unique(number[order], return_index=True)
        grid = np.zeros((len(misfit) + 1, rows * columns), np.float32)
        grid[:-1, used] = np.add.reduceat(misfit[:, order], start, axis=1)
        grid[-1, used] = np.diff(np.r_[start, len(number)])  # how many points
        found = np.empty(len(point))
        row, column = self.cell[point].T
        for direction, kernel in enumerate(self.kernel):
            asked = np.flatnonzero(self.direction[point] == direction)
            if not asked.size:
                continue
            summed = np.stack(
                [
                    cv2.filter2D(
                        part.reshape(rows, columns), -1, kernel, borderType=cv2.BORDER_CONSTANT
                    )
                    for part in grid
                ]
            )
            place = row[asked], column[asked]
            found[asked] = summed[level[asked], *place] / summed[-1, *place]
        return found


def _cells(edges: EdgePoints, cell_px: float) -> IntArray:
    column, row = np.floor((edges.xy_px - edges.xy_px.min(axis=0)) / cell_px).astype(np.int64).T
    return np.column_stack([row, column])


def _grid(reach_px: float, cell_px: float) -> tuple[FloatArray, FloatArray]:
    """Return x and y of the parts of all cells within reach of the middle one."""
    parts = (2 * int(np.ceil(reach_px / cell_px)) + 1) * WITHIN
    place = (np.arange(parts) - (parts - 1) / 2) / WITHIN * cell_px
    x, y = np.meshgrid(place, place)
    return x, y


def _shares(inside: NDArray[np.bool_]) -> NDArray[np.float32]:
    size = len(inside) // WITHIN
    parts = inside.reshape(size, WITHIN, size, WITHIN)
    return np.asarray(parts.mean(axis=(1, 3)), np.float32)
