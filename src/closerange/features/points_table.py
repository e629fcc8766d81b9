"""The points table: reader and writer of `ImagePoints` as CSV."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from closerange.errors import InputError, TableError
from closerange.features.image_points import ImagePoints
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
from closerange.geometry.arrays import FloatArray

REQUIRED = ("camera", "point", "x_px", "y_px")
COVARIANCE = ("cov_xx_px2", "cov_xy_px2", "cov_yy_px2")
NOISE = ("noise_xx_px2", "noise_xy_px2", "noise_yy_px2")
ELLIPSE = ("ellipse_a_px", "ellipse_b_px", "ellipse_angle_rad")
OPTIONAL = (
    "placement",
    "reading",
    *COVARIANCE,
    *NOISE,
    "flags",
    *ELLIPSE,
    "disc_diameter_mm",
    "mismatch",
)


def read_points(*paths: Path | str) -> ImagePoints:
    """Read one or more points tables and join them.

    Parameters
    ----------
    *paths : Path or str
        CSV files with the columns of the points table (DESIGN section 5).

    Returns
    -------
    ImagePoints
        All rows in order.

    Raises
    ------
    FileError
        If a file cannot be read.
    TableError
        If a row breaks the contract: it names file, row, column and remedy.
    """
    joined: ImagePoints | None = None
    for path in paths:
        points = points_of_table(read_csv(path, required=REQUIRED, optional=OPTIONAL))
        if joined is None:
            joined = points
            continue
        try:
            joined = joined + points
        except InputError as error:
            raise TableError(f"{path}: {error.message}", remedy=error.remedy) from error
    if joined is None:
        raise InputError("no points table was named", remedy="name at least one CSV file")
    return joined


def write_points(points: ImagePoints, path: Path | str) -> None:
    """Write a points table; columns without any content are left out.

    Parameters
    ----------
    points : ImagePoints
        Rows.
    path : Path or str
        CSV file, replaced whole or not at all.

    Raises
    ------
    FileError
        If it cannot be written.
    """
    columns = points_columns(points)
    write_csv(path, list(columns), zip(*columns.values(), strict=True))


def points_columns(points: ImagePoints) -> dict[str, list[str]]:
    """Return the columns of a points table as texts, in order, without the empty ones."""
    columns: dict[str, list[str]] = {
        "camera": list(points.camera),
        "placement": list(points.placement),
        "reading": list(points.reading),
        "point": list(points.point),
        "x_px": [float_text(x) for x in points.xy_px[:, 0]],
        "y_px": [float_text(y) for y in points.xy_px[:, 1]],
        **_covariance_cells(points.cov_px2, COVARIANCE),
        **_covariance_cells(points.noise_cov_px2, NOISE),
        **{name: [float_text(v) for v in points.ellipse[:, i]] for i, name in enumerate(ELLIPSE)},
        "disc_diameter_mm": [float_text(value) for value in points.disc_diameter_mm],
        "flags": [format_flags(int(flag)) for flag in points.flags],
    }
    always = {"camera", "placement", "point", "x_px", "y_px", "flags"}
    return {name: cells for name, cells in columns.items() if name in always or any(cells)}


def _covariance_cells(cov: FloatArray, names: tuple[str, str, str]) -> dict[str, list[str]]:
    """Write the three terms of symmetric matrices."""
    terms = (cov[:, 0, 0], cov[:, 0, 1], cov[:, 1, 1])
    return {
        name: [float_text(value) for value in term] for name, term in zip(names, terms, strict=True)
    }


def points_of_table(table: CsvTable) -> ImagePoints:
    """Check and convert the cells of a points table; see `read_points`."""
    flags = [flag_cell(t, table.where(i, "flags")) for i, t in enumerate(table.texts("flags"))]
    check_unique(
        table,
        ("point", "camera", "placement", "reading"),
        remedy="give each placement its own name, or remove one row",
    )
    return ImagePoints.of(
        camera=[
            text_cell(t, table.where(i, "camera")) for i, t in enumerate(table.texts("camera"))
        ],
        placement=table.texts("placement"),
        reading=table.texts("reading"),
        point=[text_cell(t, table.where(i, "point")) for i, t in enumerate(table.texts("point"))],
        xy_px=_positions(table, flags),
        cov_px2=_covariances(table, COVARIANCE),
        noise_cov_px2=_covariances(table, NOISE),
        flags=flags,
        ellipse=_ellipses(table),
        disc_diameter_mm=_diameters(table),
    )


def _positions(table: CsvTable, flags: list[Flag]) -> FloatArray:
    xy = np.column_stack([table.floats(name, blank=np.nan) for name in ("x_px", "y_px")])
    for row in np.flatnonzero(~np.isfinite(xy).all(axis=1)):
        if not flags[row]:
            column = "x_px" if np.isnan(xy[row, 0]) else "y_px"
            raise TableError(
                f"{table.where(int(row), column)}: the cell is empty and the row has no flag",
                remedy="write the position, or a flag such as not_found that says why not",
            )
        xy[row] = np.nan
    return xy


def _covariances(table: CsvTable, names: tuple[str, str, str]) -> FloatArray:
    """Read covariances; a row has all three terms or none."""
    terms = np.column_stack([table.floats(name, blank=np.nan) for name in names])
    known = np.isfinite(terms)
    for row in np.flatnonzero(known.any(axis=1)):
        xx, xy, yy = terms[row]
        if not known[row].all() or xx <= 0 or yy <= 0 or xx * yy <= xy**2:
            raise TableError(
                f"{table.where(int(row), names[0])}: ({xx}, {xy}, {yy}) is not a covariance",
                remedy="write all three terms of a positive definite matrix, or leave all blank",
            )
    return terms[:, [0, 1, 1, 2]].reshape(-1, 2, 2)


def _ellipses(table: CsvTable) -> FloatArray:
    """Read ellipses; a row has all three terms or none, with a >= b > 0."""
    terms = np.column_stack([table.floats(name, blank=np.nan) for name in ELLIPSE])
    known = np.isfinite(terms)
    for row in np.flatnonzero(known.any(axis=1)):
        a, b, _ = terms[row]
        if not known[row].all() or not a >= b > 0:
            raise TableError(
                f"{table.where(int(row), ELLIPSE[0])}: semi-axes {a}, {b} px; expected a >= b > 0",
                remedy="write semi-axes with the larger one first, and the angle",
            )
    return terms


def _diameters(table: CsvTable) -> list[float]:
    values = table.floats("disc_diameter_mm", blank=np.nan)
    for row, value in enumerate(values):
        if value <= 0:
            raise TableError(
                f"{table.where(row, 'disc_diameter_mm')}: {value} mm; expected a positive number",
                remedy="write the true diameter, or leave the cell blank",
            )
    return values
