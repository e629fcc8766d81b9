"""The shapes file: taught shapes as JSON that a person can read and check."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any, NoReturn

import numpy as np

from closerange.errors import InputError, SchemaError
from closerange.features.shapes import MAX_SIDE_PX, Shape
from closerange.files import dump_json, load_json
from closerange.geometry.arrays import BoolArray

SCHEMA = "closerange.shapes/1"

MAX_SHAPES = 1000
"""Most shapes in a file."""

_NUMBERS = ("contrast", "sharpness", "margin_px", "ring_px")
_KEYS = ("name", "polarity", *_NUMBERS, "rotation_step_deg", "rows")


def write_shapes(shapes: Sequence[Shape], path: Path | str) -> None:
    """Write taught shapes.

    Parameters
    ----------
    shapes : sequence of Shape
        At least one, at most 1000, names unique.
    path : Path or str
        JSON file, replaced whole or not at all. Rows of the mask are texts of ``#`` and ``.``.

    Raises
    ------
    InputError
        If there is none, there are too many, or a name occurs twice.
    FileError
        If it cannot be written.
    """
    _check_names([shape.name for shape in shapes], "shapes")
    document = {"schema": SCHEMA, "shapes": [_as_json(shape) for shape in shapes]}
    dump_json(document, path)


def read_shapes(path: Path | str) -> tuple[Shape, ...]:
    """Read taught shapes.

    Parameters
    ----------
    path : Path or str
        A file of `write_shapes`, of at most 16 MiB.

    Returns
    -------
    tuple of Shape
        At least one.

    Raises
    ------
    FileError
        If it cannot be read.
    SchemaError
        If it has another form; the message names the shape and the key.
    """
    source = str(path)
    document = load_json(path)
    if not isinstance(document, dict) or document.get("schema") != SCHEMA:
        found = document.get("schema") if isinstance(document, dict) else None
        _fail(source, f"schema is {_shown(found)}, expected {SCHEMA!r}", "name a shapes file")
    unknown = sorted(set(document) - {"schema", "shapes"})
    if unknown:
        _fail(source, f"unknown key {_shown(unknown[0])}", "remove it")
    entries = document.get("shapes")
    if not isinstance(entries, list):
        _fail(source, "'shapes' is no list", "teach the shapes again")
    shapes = tuple(
        _from_json(entry, f"{source}, shapes[{index}]")
        for index, entry in enumerate(entries[: MAX_SHAPES + 1])
    )
    try:
        _check_names([shape.name for shape in shapes], source)
    except InputError as error:
        raise SchemaError(error.message, remedy=error.remedy) from error
    return shapes


def _check_names(names: Sequence[str], source: str) -> None:
    if not 1 <= len(names) <= MAX_SHAPES:
        raise InputError(
            f"{source}: {len(names)} shapes, expected 1 to {MAX_SHAPES}", remedy="teach one first"
        )
    twice = {name for name in names if names.count(name) > 1}
    if twice:
        raise InputError(
            f"{source}: shape {min(twice)!r} occurs twice", remedy="give each its own name"
        )


def _as_json(shape: Shape) -> dict[str, Any]:
    return {
        "name": shape.name,
        "polarity": shape.polarity,
        **{key: float(getattr(shape, key)) for key in _NUMBERS},
        "rotation_step_deg": shape.rotation_step_deg,
        "rows": ["".join("#" if pixel else "." for pixel in row) for row in shape.mask],
    }


def _from_json(entry: Any, where: str) -> Shape:
    if not isinstance(entry, dict):
        _fail(where, f"expected an object, found {_shown(entry)}", "teach the shape again")
    for key in _KEYS:
        if key not in entry:
            _fail(where, f"missing key {key!r}", "teach the shape again or add it")
    for key in entry:
        if key not in _KEYS:
            _fail(where, f"unknown key {_shown(key)}", "correct its spelling or remove it")
    for key in ("name", "polarity"):
        if not isinstance(entry[key], str):
            _fail(f"{where}.{key}", f"{_shown(entry[key])} is no text", "write a text")
    step = entry["rotation_step_deg"]
    try:
        return Shape(
            entry["name"],
            _mask(entry["rows"], f"{where}.rows"),
            entry["polarity"],
            **{key: _number(entry[key], f"{where}.{key}") for key in _NUMBERS},
            rotation_step_deg=step if step is None else _number(step, f"{where}.rotation_step_deg"),
        )
    except SchemaError:
        raise
    except InputError as error:
        _fail(where, error.message, error.remedy)


def _number(value: Any, where: str) -> float:
    # a whole number of 400 digits is no float; numbers beyond 1e9 mean nothing here
    if isinstance(value, bool) or not isinstance(value, int | float) or abs(value) > 1e9:
        _fail(where, f"{_shown(value)} is no usable number", "write a finite number")
    return float(value)


def _mask(rows: Any, where: str) -> BoolArray:
    if not isinstance(rows, list) or not 1 <= len(rows) <= MAX_SIDE_PX:
        _fail(where, f"expected 1 to {MAX_SIDE_PX} texts", "teach the shape again")
    width = len(rows[0]) if isinstance(rows[0], str) else 0
    for number, row in enumerate(rows):
        if not isinstance(row, str) or len(row) != width or not 1 <= width <= MAX_SIDE_PX:
            _fail(f"{where}[{number}]", f"{_shown(row)} is no row of {width} pixels",
                  "write rows of one length")  # fmt: skip
        if set(row) - {"#", "."}:
            _fail(f"{where}[{number}]", f"{_shown(row)} has other signs than # and .",
                  "write # for the shape and . for the rest")  # fmt: skip
    return np.array([[sign == "#" for sign in row] for row in rows])


def _shown(value: Any) -> str:
    text = repr(value) if not isinstance(value, dict | list) else type(value).__name__
    return text if len(text) <= 40 else f"{text[:37]}..."


def _fail(where: str, problem: str, remedy: str) -> NoReturn:
    raise SchemaError(f"{where}: {problem}", remedy=remedy)
