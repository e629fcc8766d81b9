"""The positions table: reader and writer of `Positions` as CSV."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from closerange.errors import TableError
from closerange.files import CsvTable, float_text, read_csv, text_cell, write_csv
from closerange.flags import Flag, format_flags, parse_flags
from closerange.geometry.arrays import FloatArray, IntArray
from closerange.position.positions import Positions

REQUIRED = ("placement", "point", "x_mm", "y_mm", "z_mm")
COVARIANCE = ("cov_xx_mm2", "cov_xy_mm2", "cov_xz_mm2", "cov_yy_mm2", "cov_yz_mm2", "cov_zz_mm2")
OPTIONAL = (*COVARIANCE, "residual_px", "cameras", "flags", "reading")

MAX_CAMERAS = 1_000_000
"""Largest count of cameras read: far beyond any rig, and a whole number in every type."""

_UPPER = np.triu_indices(3)


def write_positions(positions: Positions, path: Path | str) -> None:
    """Write a positions table; the column `reading` only if there are readings.

    Parameters
    ----------
    positions : Positions
        Rows.
    path : Path or str
        CSV file, replaced whole or not at all.

    Raises
    ------
    FileError
        If it cannot be written.
    """
    cov = positions.cov_mm2[:, _UPPER[0], _UPPER[1]]
    columns: dict[str, list[str]] = {"placement": list(positions.placement)}
    if any(positions.reading):
        columns["reading"] = list(positions.reading)
    columns["point"] = list(positions.point)
    for axis, name in enumerate(("x_mm", "y_mm", "z_mm")):
        columns[name] = [float_text(value) for value in positions.xyz_mm[:, axis]]
    for term, name in enumerate(COVARIANCE):
        columns[name] = [float_text(value) for value in cov[:, term]]
    columns["residual_px"] = [float_text(value) for value in positions.residual_px]
    columns["cameras"] = [str(count) for count in positions.cameras]
    columns["flags"] = [format_flags(int(flag)) for flag in positions.flags]
    write_csv(path, list(columns), zip(*columns.values(), strict=True))


def read_positions(path: Path | str) -> Positions:
    """Read a positions table.

    Parameters
    ----------
    path : Path or str
        CSV file with at least ``placement, point, x_mm, y_mm, z_mm``.

    Returns
    -------
    Positions
        Its rows; `dof` is unknown.

    Raises
    ------
    FileError
        If the file cannot be read.
    TableError
        If a row breaks the contract: it names file, row, column and remedy.
    """
    table = read_csv(path, required=REQUIRED, optional=OPTIONAL)
    flags = [_flag(text, table.where(i, "flags")) for i, text in enumerate(table.texts("flags"))]
    _check_unique(table)
    xyz = _coordinates(table, flags)
    return Positions(
        placement=tuple(table.texts("placement")),
        point=tuple(
            text_cell(t, table.where(i, "point")) for i, t in enumerate(table.texts("point"))
        ),
        reading=tuple(table.texts("reading")),
        xyz_mm=xyz,
        cov_mm2=_covariances(table),
        residual_px=np.array(table.floats("residual_px", blank=np.nan)),
        cameras=_counts(table),
        flags=np.array(flags, dtype=np.int64),
    )


def _flag(text: str, where: str) -> Flag:
    try:
        return parse_flags(text)
    except ValueError as error:
        raise TableError(f"{where}: {error}", remedy="use names of the registry") from error


def _check_unique(table: CsvTable) -> None:
    seen: dict[tuple[str, ...], int] = {}
    names = ("placement", "reading", "point")
    for row, key in enumerate(zip(*(table.texts(name) for name in names), strict=True)):
        if key in seen:
            raise TableError(
                f"{table.where(row, 'point')}: point {key[2]!r}, placement {key[0]!r} is also in "
                f"row {table.line[seen[key]]}",
                remedy="number repeated measurements in a column 'reading'",
            )
        seen[key] = row


def _coordinates(table: CsvTable, flags: list[Flag]) -> FloatArray:
    xyz = np.column_stack([table.floats(name, blank=np.nan) for name in ("x_mm", "y_mm", "z_mm")])
    for row in np.flatnonzero(~np.isfinite(xyz).all(axis=1)):
        if not flags[row]:
            raise TableError(
                f"{table.where(int(row), 'x_mm')}: a coordinate is empty and the row has no flag",
                remedy="write the position, or a flag that says why there is none",
            )
        xyz[row] = np.nan
    return xyz


def _covariances(table: CsvTable) -> FloatArray:
    """Read covariances; a row has all six terms or none."""
    terms = np.column_stack([table.floats(name, blank=np.nan) for name in COVARIANCE])
    cov = np.empty((len(table), 3, 3))
    cov[:, _UPPER[0], _UPPER[1]] = terms
    cov[:, _UPPER[1], _UPPER[0]] = terms
    known = np.isfinite(terms)
    for row in np.flatnonzero(known.any(axis=1)):
        if not known[row].all() or np.linalg.eigvalsh(cov[row])[0] <= 0:
            raise TableError(
                f"{table.where(int(row), COVARIANCE[0])}: not a positive definite covariance",
                remedy="write all six terms of a covariance, or leave all blank",
            )
    return cov


def _counts(table: CsvTable) -> IntArray:
    counts = table.floats("cameras", blank=0.0)
    for row, count in enumerate(counts):
        if not 0 <= count <= MAX_CAMERAS or count != int(count):
            raise TableError(
                f"{table.where(row, 'cameras')}: {count} is not a number of cameras",
                remedy=f"write a whole number from 0 to {MAX_CAMERAS}",
            )
    return np.array(counts, dtype=np.int64)
