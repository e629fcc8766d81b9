"""The positions table: reader and writer of `Positions` as CSV."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from closerange.errors import TableError
from closerange.files import (
    CsvTable,
    check_unique,
    flag_cell,
    float_text,
    read_csv,
    text_cell,
    write_csv,
)
from closerange.flags import Flag, format_flags
from closerange.geometry.arrays import FloatArray, IntArray
from closerange.position.positions import Positions

REQUIRED = ("placement", "point", "x_mm", "y_mm", "z_mm")
COVARIANCE = ("cov_xx_mm2", "cov_xy_mm2", "cov_xz_mm2", "cov_yy_mm2", "cov_yz_mm2", "cov_zz_mm2")
NOISE = tuple(name.replace("cov", "noise") for name in COVARIANCE)
OPTIONAL = (*COVARIANCE, *NOISE, "residual_px", "cameras", "flags", "reading", "dof")

MAX_CAMERAS = 1_000_000
"""Largest count of cameras read: far beyond any rig, and a whole number in every type."""

MAX_DOF = 2**53
"""Largest number of degrees of freedom read: what a float holds exactly, as in the rig file."""

_UPPER = np.triu_indices(3)


def write_positions(positions: Positions, path: Path | str) -> None:
    """Write a positions table; columns of readings, noise and dof only if there is any.

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
    columns: dict[str, list[str]] = {"placement": list(positions.placement)}
    if any(positions.reading):
        columns["reading"] = list(positions.reading)
    columns["point"] = list(positions.point)
    for axis, name in enumerate(("x_mm", "y_mm", "z_mm")):
        columns[name] = [float_text(value) for value in positions.xyz_mm[:, axis]]
    columns |= _covariance_cells(positions.cov_mm2, COVARIANCE)
    noise = _covariance_cells(positions.noise_cov_mm2, NOISE)
    columns |= noise if any(map(any, noise.values())) else {}
    if positions.dof is not None:
        columns["dof"] = [str(positions.dof)] * len(positions)
    columns["residual_px"] = [float_text(value) for value in positions.residual_px]
    columns["cameras"] = [str(count) for count in positions.cameras]
    columns["flags"] = [format_flags(int(flag)) for flag in positions.flags]
    write_csv(path, list(columns), zip(*columns.values(), strict=True))


def _covariance_cells(cov: FloatArray, names: tuple[str, ...]) -> dict[str, list[str]]:
    """Write the six terms of symmetric matrices."""
    terms = cov[:, _UPPER[0], _UPPER[1]]
    return {name: [float_text(value) for value in terms[:, i]] for i, name in enumerate(names)}


def read_positions(path: Path | str) -> Positions:
    """Read a positions table.

    Parameters
    ----------
    path : Path or str
        CSV file with at least ``placement, point, x_mm, y_mm, z_mm``.

    Returns
    -------
    Positions
        Its rows. Where rows state different `dof`, as in tables joined by hand, the smallest
        counts: regions then err on the large side.

    Raises
    ------
    FileError
        If the file cannot be read.
    TableError
        If a row breaks the contract: it names file, row, column and remedy.
    """
    table = read_csv(path, required=REQUIRED, optional=OPTIONAL)
    flags = [flag_cell(t, table.where(i, "flags")) for i, t in enumerate(table.texts("flags"))]
    check_unique(
        table,
        ("point", "placement", "reading"),
        remedy="number repeated measurements in a column 'reading'",
    )
    xyz = _coordinates(table, flags)
    return Positions(
        placement=tuple(table.texts("placement")),
        point=tuple(
            text_cell(t, table.where(i, "point")) for i, t in enumerate(table.texts("point"))
        ),
        reading=tuple(table.texts("reading")),
        xyz_mm=xyz,
        cov_mm2=_covariances(table, COVARIANCE),
        residual_px=np.array(table.floats("residual_px", blank=np.nan)),
        cameras=_counts(table),
        flags=np.array(flags, dtype=np.int64),
        noise_cov_mm2=_covariances(table, NOISE),
        dof=_dof(table),
    )


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


def _covariances(table: CsvTable, names: tuple[str, ...]) -> FloatArray:
    """Read covariances; a row has all six terms or none."""
    terms = np.column_stack([table.floats(name, blank=np.nan) for name in names])
    cov = np.empty((len(table), 3, 3))
    cov[:, _UPPER[0], _UPPER[1]] = terms
    cov[:, _UPPER[1], _UPPER[0]] = terms
    known = np.isfinite(terms)
    for row in np.flatnonzero(known.any(axis=1)):
        if not known[row].all() or np.linalg.eigvalsh(cov[row])[0] <= 0:
            raise TableError(
                f"{table.where(int(row), names[0])}: not a positive definite covariance",
                remedy="write all six terms of a covariance, or leave all blank",
            )
    return cov


def _counts(table: CsvTable) -> IntArray:
    counts = table.floats("cameras", blank=0.0)
    _check_whole(table, "cameras", counts, (0, MAX_CAMERAS), "number of cameras")
    return np.array(counts, dtype=np.int64)


def _dof(table: CsvTable) -> int | None:
    values = table.floats("dof", blank=np.nan)
    stated = [value for value in values if not np.isnan(value)]
    _check_whole(table, "dof", values, (1, MAX_DOF), "number of degrees of freedom")
    return int(min(stated)) if stated else None


def _check_whole(
    table: CsvTable, column: str, values: list[float], bounds: tuple[int, int], what: str
) -> None:
    """Refuse what is not a whole number within bounds; a blank cell is allowed."""
    for row, value in enumerate(values):
        if not np.isnan(value) and (not bounds[0] <= value <= bounds[1] or value != int(value)):
            raise TableError(
                f"{table.where(row, column)}: {value} is not a {what}",
                remedy=f"write a whole number from {bounds[0]} to {bounds[1]}",
            )
