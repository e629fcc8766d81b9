"""The target file: TOML, strict."""

from __future__ import annotations

import tomllib
import warnings
from collections.abc import Callable
from pathlib import Path, PurePosixPath, PureWindowsPath
from typing import Any

from closerange.errors import CloseRangeWarning, SchemaError
from closerange.features.control import read_control
from closerange.features.target import Charuco, Chessboard, DiscGrid, Target
from closerange.files import read_text

MAX_BYTES = 2**20
"""Largest target file read (1 MiB; ten lines are the rule)."""


def read_target(path: Path | str) -> Target:
    """Read a target file.

    Keys by `kind` (those in brackets may be left out)::

        disc-grid    rows, columns, pitch_mm = [x, y], disc_diameter_mm, polarity,
                     [orientation], [mark_discs = [[row, column, diameter_mm], ...]], [std_mm]
        chessboard   rows, columns (inner corners), square_mm, [orientation], [std_mm]
        charuco      rows, columns (squares), square_mm, marker_mm, dictionary, [std_mm]
        points       file (a control table in the target's frame, in the same folder or below)

    `orientation`, left out, is ``"marks"`` where there are `mark_discs` and ``"upright"``
    where there are none; a chessboard has one only where it looks the same after a half turn.
    `pitch_mm` may be left out for a single disc. `std_mm`, left out,
    is 0: the target counts as exact.

    Parameters
    ----------
    path : Path or str
        TOML file.

    Returns
    -------
    Target
        Points in row-major order, or in the order of the table.

    Raises
    ------
    FileError
        If the file, or the table it names, cannot be read.
    SchemaError
        If a key is unknown, missing, of the wrong type or out of its limits; the message
        names file, key, value and limit.
    TableError
        If the table of a "points" target breaks its contract.

    Warns
    -----
    CloseRangeWarning
        If a disc grid looks the same after a half turn and the file does not say how it is held.
    """
    path = Path(path)
    document = _parse(path)
    kind = _text(document, "kind", str(path))
    if kind not in _READERS:
        raise SchemaError(
            f"{path}: kind = {kind!r}; one of {', '.join(_READERS)}", remedy="correct kind"
        )
    required, optional, build = _READERS[kind]
    _check_keys(document, required, optional, str(path))
    try:
        return build(document, path)
    except SchemaError as error:  # the pattern knows the limit, here the file is known
        prefix = "" if error.message.startswith(str(path)) else f"{path}: "
        raise SchemaError(f"{prefix}{error.message}", remedy=error.remedy) from error


def _disc_grid(document: dict[str, Any], path: Path) -> Target:
    where = str(path)
    rows, columns = (_whole(document, key, where) for key in ("rows", "columns"))
    diameter = _number(document, "disc_diameter_mm", where)
    if "pitch_mm" in document:
        pitch = _numbers(document["pitch_mm"], 2, "pitch_mm", where)
    elif rows == columns == 1:
        pitch = (2 * diameter, 2 * diameter)  # never used: a single disc has no neighbour
    else:
        raise _missing("pitch_mm", where)
    orientation = _orientation(document, "upright or marks", where)
    grid = DiscGrid(
        rows=rows,
        columns=columns,
        pitch_mm=(pitch[0], pitch[1]),
        disc_diameter_mm=diameter,
        polarity=_text(document, "polarity", where),
        orientation=orientation,
        mark_discs=_marks(document.get("mark_discs", []), where),
    )
    if not orientation and grid.half_turn_symmetric:
        warnings.warn(
            f"{where}: a grid of {rows} x {columns} discs looks the same after half a turn: it is "
            "taken to be upright in every image, an upside-down one goes unnoticed; write "
            'orientation = "upright" where that holds, or use mark discs',
            CloseRangeWarning,
            stacklevel=4,
        )
    return Target.of(grid, std_mm=_std(document, where))


def _orientation(document: dict[str, Any], wanted: str, where: str) -> str:
    """Return the orientation, blank where the file does not say."""
    if "orientation" not in document:
        return ""
    orientation = _text(document, "orientation", where)
    if not orientation:
        raise _wrong("orientation", "", wanted, where)
    return orientation


def _chessboard(document: dict[str, Any], path: Path) -> Target:
    where = str(path)
    board = Chessboard(
        rows=_whole(document, "rows", where),
        columns=_whole(document, "columns", where),
        square_mm=_number(document, "square_mm", where),
        orientation=_orientation(document, "upright", where),
    )
    return Target.of(board, std_mm=_std(document, where))


def _charuco(document: dict[str, Any], path: Path) -> Target:
    where = str(path)
    board = Charuco(
        rows=_whole(document, "rows", where),
        columns=_whole(document, "columns", where),
        square_mm=_number(document, "square_mm", where),
        marker_mm=_number(document, "marker_mm", where),
        dictionary=_text(document, "dictionary", where),
    )
    return Target.of(board, std_mm=_std(document, where))


def _points(document: dict[str, Any], path: Path) -> Target:
    name = _text(document, "file", str(path))
    control = read_control(_inside(path, name))
    if any(control.placement) or control.check.any():
        raise SchemaError(
            f"{path}: file = {name!r}; a point of a target has no placement and no role",
            remedy="leave these columns blank: placements and check points belong to the control",
        )
    return Target.of_points(control.point, control.xyz_mm, std_mm=control.std_mm)


_Reader = tuple[tuple[str, ...], tuple[str, ...], Callable[[dict[str, Any], Path], Target]]

_READERS: dict[str, _Reader] = {
    "disc-grid": (
        ("rows", "columns", "disc_diameter_mm", "polarity"),
        ("pitch_mm", "orientation", "mark_discs", "std_mm"),
        _disc_grid,
    ),
    "chessboard": (("rows", "columns", "square_mm"), ("orientation", "std_mm"), _chessboard),
    "charuco": (
        ("rows", "columns", "square_mm", "marker_mm", "dictionary"),
        ("std_mm",),
        _charuco,
    ),
    "points": (("file",), (), _points),
}


def _parse(path: Path) -> dict[str, Any]:
    text = read_text(path, MAX_BYTES)
    try:
        return tomllib.loads(text)
    except (ValueError, RecursionError) as error:  # TOMLDecodeError is a ValueError
        raise SchemaError(
            f"{path}: not TOML: {error}", remedy="correct the line; texts need quotes"
        ) from error


def _check_keys(
    document: dict[str, Any], required: tuple[str, ...], optional: tuple[str, ...], where: str
) -> None:
    for key in required:
        if key not in document:
            raise _missing(key, where)
    known = ("kind", *required, *optional)
    for key, value in document.items():
        if key not in known:
            raise SchemaError(
                f"{where}: unknown key {key!r} = {value!r}; known are {', '.join(known)}",
                remedy=f"remove or correct {key}",
            )


def _missing(key: str, where: str) -> SchemaError:
    return SchemaError(f"{where}: key {key!r} is missing", remedy=f"add a line {key} = ...")


def _wrong(key: str, value: Any, wanted: str, where: str) -> SchemaError:
    return SchemaError(f"{where}: {key} = {value!r}; expected {wanted}", remedy=f"correct {key}")


def _text(document: dict[str, Any], key: str, where: str) -> str:
    if key not in document:
        raise _missing(key, where)
    value = document[key]
    if not isinstance(value, str):
        raise _wrong(key, value, "a text in quotes", where)
    return value


def _whole(document: dict[str, Any], key: str, where: str) -> int:
    return _as_whole(document[key], key, where)


def _as_whole(value: Any, key: str, where: str) -> int:
    if not isinstance(value, int) or isinstance(value, bool):
        raise _wrong(key, value, "a whole number", where)
    return value


def _number(document: dict[str, Any], key: str, where: str) -> float:
    return _numbers([document[key]], 1, key, where)[0]


def _numbers(value: Any, count: int, key: str, where: str) -> tuple[float, ...]:
    """Check a list of numbers; a bool is no number, and an integer may stand for a float."""
    fits = (
        isinstance(value, list)
        and len(value) == count
        and all(isinstance(item, int | float) and not isinstance(item, bool) for item in value)
    )
    if not fits:
        shown = value[0] if count == 1 else value
        raise _wrong(key, shown, "a number" if count == 1 else f"a list of {count} numbers", where)
    try:
        return tuple(float(item) for item in value)
    except OverflowError as error:
        raise _wrong(key, "a number of more than 308 digits", "a length", where) from error


def _marks(value: Any, where: str) -> tuple[tuple[int, int, float], ...]:
    wanted = "a list of [row, column, diameter_mm]"
    if not isinstance(value, list) or not all(isinstance(mark, list) for mark in value):
        raise _wrong("mark_discs", value, wanted, where)
    if any(len(mark) != 3 for mark in value):
        raise _wrong("mark_discs", value, wanted, where)
    return tuple(
        (
            _as_whole(row, "mark_discs", where),
            _as_whole(column, "mark_discs", where),
            _numbers([diameter], 1, "mark_discs", where)[0],
        )
        for row, column, diameter in value
    )


def _std(document: dict[str, Any], where: str) -> float:
    return _number(document, "std_mm", where) if "std_mm" in document else 0.0


def _inside(path: Path, name: str) -> Path:
    """Find a file named in a target file: in its folder or below, links included."""
    windows = PureWindowsPath(name)
    unsafe = (
        not name
        or "\0" in name
        or PurePosixPath(name).is_absolute()
        or windows.drive
        or windows.root
        or ".." in windows.parts  # splits at both kinds of slash
    )
    folder = path.parent.resolve()
    if not unsafe:
        found = (folder / name).resolve()
        if found.is_relative_to(folder):
            return found
    raise SchemaError(
        f"{path}: file = {name!r}; it must lie in the target file's folder or below",
        remedy="put the table beside the target file and write its bare name",
    )
