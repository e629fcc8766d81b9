"""Points and lines in space as a PLY file, which most viewers of point clouds read."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike

from closerange.files import write_bytes
from closerange.geometry.arrays import BoolArray, FloatArray

# dark blue, blue green, yellow: ordered by lightness too, for print and for the colour-blind
_COLOURS = np.array([[68.0, 1, 84], [59, 82, 139], [33, 145, 140], [94, 201, 98], [253, 231, 37]])


def write_ply(
    path: Path | str,
    xyz_mm: ArrayLike,
    *,
    std_mm: ArrayLike | None = None,
    lines: ArrayLike | None = None,
    colour_by: ArrayLike | None = None,
    text: bool = False,
) -> None:
    """Write points, and lines between them, as PLY.

    Parameters
    ----------
    path : Path or str
        File, replaced whole or not at all.
    xyz_mm : array_like, shape (N, 3)
        Positions; all known.
    std_mm : array_like, shape (N,), optional
        Standard deviations, written as the property ``std``; NaN where unknown.
    lines : array_like of int, shape (M, 2), optional
        Pairs of points.
    colour_by : array_like, shape (N,), optional
        Number from whose smallest to largest value points are coloured, such as Z.
    text : bool, optional
        ASCII instead of binary, little-endian.

    Raises
    ------
    ValueError
        If a position is not known, a line names a point that is not there or columns differ in
        length.
    FileError
        If the file cannot be written.
    """
    xyz = np.asarray(xyz_mm, np.float64).reshape(-1, 3)
    if not np.isfinite(xyz).all():
        raise ValueError("a position is not known")
    fields = [("x", "<f8"), ("y", "<f8"), ("z", "<f8")]
    columns = list(xyz.T)
    if std_mm is not None:
        fields.append(("std", "<f4"))
        columns.append(np.asarray(std_mm, np.float64))
    if colour_by is not None:
        fields += [("red", "u1"), ("green", "u1"), ("blue", "u1")]
        columns += list(_colours(np.asarray(colour_by, np.float64)).T)
    vertices = np.empty(len(xyz), np.dtype(fields))
    for (name, _), column in zip(fields, columns, strict=True):
        if column.shape != (len(xyz),):
            raise ValueError(f"{name} has shape {column.shape}, expected ({len(xyz)},)")
        vertices[name] = column
    edges = _edges(lines, len(xyz))
    body = [vertices, *([edges] if lines is not None else [])]
    head = _header(vertices, edges if lines is not None else None, text=text)
    content = b"".join(_rows(part) if text else part.tobytes() for part in body)
    write_bytes(path, head.encode("ascii") + content)


def _edges(lines: ArrayLike | None, count: int) -> np.ndarray:
    pairs = np.asarray([] if lines is None else lines, np.int64).reshape(-1, 2)
    if ((pairs < 0) | (pairs >= count)).any():
        raise ValueError(f"a line names a point beyond the {count} there are")
    edges = np.empty(len(pairs), np.dtype([("vertex1", "<i4"), ("vertex2", "<i4")]))
    edges["vertex1"], edges["vertex2"] = pairs.T
    return edges


def _header(vertices: np.ndarray, edges: np.ndarray | None, *, text: bool) -> str:
    names = {"f8": "double", "f4": "float", "u1": "uchar", "i4": "int"}
    lines = ["ply", f"format {'ascii' if text else 'binary_little_endian'} 1.0"]
    lines.append("comment closerange; lengths in mm")
    for element, table in (("vertex", vertices), ("edge", edges)):
        if table is None:
            continue
        lines.append(f"element {element} {len(table)}")
        fields = table.dtype.names or ()
        lines += [f"property {names[table.dtype[name].str[1:]]} {name}" for name in fields]
    return "\n".join([*lines, "end_header", ""])


def _rows(table: np.ndarray) -> bytes:
    text = "\n".join(" ".join(repr(value) for value in row) for row in table.tolist())
    return (text + "\n").encode("ascii") if text else b""


def _colours(value: FloatArray) -> FloatArray:
    """Spread numbers over the scale of colours; grey where there is none."""
    known: BoolArray = np.isfinite(value)
    colours = np.full((len(value), 3), 128.0)
    if known.any():
        low, high = value[known].min(), value[known].max()
        share = (value[known] - low) / (high - low) if high > low else np.full(known.sum(), 0.5)
        stops = np.linspace(0.0, 1.0, len(_COLOURS))
        colours[known] = np.column_stack([np.interp(share, stops, c) for c in _COLOURS.T])
    return np.asarray(np.rint(colours))
