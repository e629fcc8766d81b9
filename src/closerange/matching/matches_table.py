"""The matches table: reader and writer of `Correspondences` as CSV.

A matches table is a points table in which the rows of one (placement, reading, point) in several
cameras belong together. It repeats the seed's row unmoved and adds a column `mismatch`.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from graphlib import CycleError, TopologicalSorter
from itertools import groupby, pairwise
from pathlib import Path

import numpy as np

from closerange.errors import TableError
from closerange.features.image_points import ImagePoints
from closerange.features.points_table import OPTIONAL, REQUIRED, points_columns, points_of_table
from closerange.files import CsvTable, float_text, read_csv, write_csv
from closerange.geometry.arrays import FloatArray, IntArray
from closerange.matching.correspondences import Correspondences


def write_matches(matches: Correspondences, path: Path | str) -> None:
    """Write a matches table: point by point, one row for each camera that was asked.

    Parameters
    ----------
    matches : Correspondences
        Points; the mismatch of a point stands in each of its rows.
    path : Path or str
        CSV file, replaced whole or not at all.

    Raises
    ------
    FileError
        If it cannot be written.
    """
    rows, _ = np.nonzero(matches.found | (matches.flags != 0))
    columns = points_columns(matches.to_image_points())
    flags = columns.pop("flags")
    columns["mismatch"] = [float_text(value) for value in matches.mismatch[rows]]
    columns["flags"] = flags  # last, as in a points table
    write_csv(path, list(columns), zip(*columns.values(), strict=True))


def read_matches(path: Path | str) -> Correspondences:
    """Read a matches table.

    Parameters
    ----------
    path : Path or str
        CSV file with the columns of the points table and, if known, `mismatch`. The rows of a
        point need not follow each other.

    Returns
    -------
    Correspondences
        Points in the order of their first row. Ellipses and diameters of discs are left out: a
        match is the same surface point, not a second disc centre.

    Raises
    ------
    FileError
        If the file cannot be read.
    TableError
        If a row breaks the contract: it names file, row, column and remedy.
    """
    table = read_csv(path, required=REQUIRED, optional=OPTIONAL)
    points = points_of_table(table)
    keys = list(zip(points.placement, points.reading, points.point, strict=True))
    number = {key: row for row, key in enumerate(dict.fromkeys(keys))}
    rows = np.array([number[key] for key in keys], np.intp)
    cameras = _camera_order(points, rows)
    columns = np.array([cameras.index(name) for name in points.camera], np.intp)
    shape = (len(number), len(cameras))
    xy, cov = np.full((*shape, 2), np.nan), np.full((*shape, 2, 2), np.nan)
    flags = np.zeros(shape, np.int64)
    xy[rows, columns], cov[rows, columns] = points.xy_px, points.cov_px2
    flags[rows, columns] = points.flags
    return Correspondences(
        placement=tuple(key[0] for key in number),
        point=tuple(key[2] for key in number),
        cameras=cameras,
        xy_px=xy,
        cov_px2=cov,
        mismatch=_mismatches(table, rows),
        flags=flags,
        reading=tuple(key[1] for key in number),
    )


def _camera_order(points: ImagePoints, rows: IntArray) -> tuple[str, ...]:
    """Return the cameras in an order that agrees with the rows of every point.

    The first point may lack a camera that was not asked for it; the order of first appearance
    would then write the next ones' rows in another order than they were read.
    """
    order: TopologicalSorter[str] = TopologicalSorter(dict.fromkeys(points.cameras, ()))
    for _, group in groupby(zip(rows.tolist(), points.camera, strict=True), key=_first):
        for (_, before), (_, after) in pairwise(group):
            order.add(after, before)
    try:
        return tuple(order.static_order())
    except CycleError:  # rows in different orders: any will do
        return points.cameras


def _first(pair: tuple[int, str]) -> int:
    return pair[0]


def _mismatches(table: CsvTable, rows: IntArray) -> FloatArray:
    """Read one number a point; its rows may repeat it or be blank, but not contradict."""
    values = np.full(int(rows.max(initial=-1)) + 1, np.nan)
    cells: Iterable[tuple[int, float]] = zip(
        rows.tolist(), table.floats("mismatch", blank=math.nan), strict=True
    )
    for line, (row, value) in enumerate(cells):
        if value < 0:
            raise TableError(
                f"{table.where(line, 'mismatch')}: {value}; expected 0 or more",
                remedy="write how badly the views fit, or leave the cell blank",
            )
        if not math.isnan(value) and not math.isnan(values[row]) and value != values[row]:
            raise TableError(
                f"{table.where(line, 'mismatch')}: {value}, but {values[row]} in another row of "
                "the same point",
                remedy="write one mismatch for each point, the same in all of its rows",
            )
        if not math.isnan(value):
            values[row] = value
    return values
