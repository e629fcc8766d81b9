"""The points table: reader and writer of `ImagePoints` as CSV."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from closerange.errors import InputError, TableError
from closerange.features.image_points import ImagePoints
from closerange.files import CsvTable, float_text, read_csv, text_cell, write_csv
from closerange.flags import Flag, format_flags, parse_flags
from closerange.geometry.arrays import FloatArray

REQUIRED = ("camera", "point", "x_px", "y_px")
COVARIANCE = ("cov_xx_px2", "cov_xy_px2", "cov_yy_px2")
ELLIPSE = ("ellipse_a_px", "ellipse_b_px", "ellipse_angle_rad")
OPTIONAL = ("placement", "reading", *COVARIANCE, "flags", *ELLIPSE, "disc_diameter_mm", "mismatch")


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
        points = _read_one(path)
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
    cov = points.cov_px2
    columns: dict[str, list[str]] = {
        "camera": list(points.camera),
        "placement": list(points.placement),
        "reading": list(points.reading),
        "point": list(points.point),
        "x_px": [float_text(x) for x in points.xy_px[:, 0]],
        "y_px": [float_text(y) for y in points.xy_px[:, 1]],
        "cov_xx_px2": [float_text(value) for value in cov[:, 0, 0]],
        "cov_xy_px2": [float_text(value) for value in cov[:, 0, 1]],
        "cov_yy_px2": [float_text(value) for value in cov[:, 1, 1]],
        **{name: [float_text(v) for v in points.ellipse[:, i]] for i, name in enumerate(ELLIPSE)},
        "disc_diameter_mm": [float_text(value) for value in points.disc_diameter_mm],
        "flags": [format_flags(int(flag)) for flag in points.flags],
    }
    always = {"camera", "placement", "point", "x_px", "y_px", "flags"}
    kept = {name: cells for name, cells in columns.items() if name in always or any(cells)}
    write_csv(path, list(kept), zip(*kept.values(), strict=True))


def _read_one(path: Path | str) -> ImagePoints:
    table = read_csv(path, required=REQUIRED, optional=OPTIONAL)
    flags = [
        _flag(text, table.where(row, "flags")) for row, text in enumerate(table.texts("flags"))
    ]
    _check_unique(table)
    return ImagePoints.of(
        camera=[
            text_cell(t, table.where(i, "camera")) for i, t in enumerate(table.texts("camera"))
        ],
        placement=table.texts("placement"),
        reading=table.texts("reading"),
        point=[text_cell(t, table.where(i, "point")) for i, t in enumerate(table.texts("point"))],
        xy_px=_positions(table, flags),
        cov_px2=_covariances(table),
        flags=flags,
        ellipse=_ellipses(table),
        disc_diameter_mm=_diameters(table),
    )


def _flag(text: str, where: str) -> Flag:
    try:
        return parse_flags(text)
    except ValueError as error:
        raise TableError(
            f"{where}: {error}", remedy="use names of the registry, joined by |"
        ) from error


def _check_unique(table: CsvTable) -> None:
    seen: dict[tuple[str, ...], int] = {}
    names = ("camera", "placement", "reading", "point")
    for row, key in enumerate(zip(*(table.texts(name) for name in names), strict=True)):
        if key in seen:
            raise TableError(
                f"{table.where(row, 'point')}: point {key[3]!r} of camera {key[0]!r}, placement "
                f"{key[1]!r} is also in row {table.line[seen[key]]}",
                remedy="give each placement its own name, or remove one row",
            )
        seen[key] = row


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


def _covariances(table: CsvTable) -> FloatArray:
    """Read covariances; a row has all three terms or none."""
    terms = np.column_stack([table.floats(name, blank=np.nan) for name in COVARIANCE])
    known = np.isfinite(terms)
    for row in np.flatnonzero(known.any(axis=1)):
        xx, xy, yy = terms[row]
        if not known[row].all() or xx <= 0 or yy <= 0 or xx * yy <= xy**2:
            raise TableError(
                f"{table.where(int(row), COVARIANCE[0])}: ({xx}, {xy}, {yy}) is not a covariance",
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
