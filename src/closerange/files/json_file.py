"""The JSON dialect: strict, bounded, finite numbers, no duplicate keys."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any

from closerange.errors import SchemaError
from closerange.files.atomic import write_text
from closerange.files.limited import MAX_TEXT_BYTES, read_text

MAX_DEPTH = 32
"""Deepest nesting read; our own files use less than ten levels."""


def parse_json(text: str, *, source: str) -> Any:
    """Parse JSON strictly.

    Parameters
    ----------
    text : str
        The document.
    source : str
        File name for error messages.

    Returns
    -------
    object
        Dictionaries, lists, texts, finite numbers, booleans and None.

    Raises
    ------
    SchemaError
        On bad syntax, nesting above 32 levels, a duplicate key or a number that is not finite.
    """

    def unique(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
        document: dict[str, Any] = {}
        for key, value in pairs:
            if key in document:
                raise SchemaError(
                    f"{source}: key {key!r} appears twice", remedy="remove one of them"
                )
            document[key] = value
        return document

    def finite(digits: str) -> float:
        value = float(digits)
        if not math.isfinite(value):
            raise SchemaError(
                f"{source}: {digits} is not a finite number", remedy="correct the number"
            )
        return value

    if _depth(text) > MAX_DEPTH:
        raise SchemaError(
            f"{source}: nested deeper than {MAX_DEPTH} levels",
            remedy="this is not one of our files",
        )
    try:
        return json.loads(text, object_pairs_hook=unique, parse_float=finite, parse_constant=finite)
    except json.JSONDecodeError as error:
        raise SchemaError(
            f"{source}: line {error.lineno}, column {error.colno}: {error.msg}",
            remedy="correct the JSON" if error.pos else "this is no JSON file: name the right one",
        ) from error
    except (ValueError, RecursionError) as error:
        if isinstance(error, SchemaError):
            raise
        raise SchemaError(
            f"{source}: {error}", remedy="correct the JSON"
        ) from error  # an integer of 5000 digits


def load_json(path: Path | str, *, max_bytes: int = MAX_TEXT_BYTES) -> Any:
    """Read a JSON file strictly; see `parse_json`.

    Parameters
    ----------
    path : Path or str
        The file.
    max_bytes : int, optional
        Size limit in bytes.

    Returns
    -------
    object
        The parsed document.

    Raises
    ------
    FileError
        If the file cannot be read.
    SchemaError
        As `parse_json`.
    """
    return parse_json(read_text(path, max_bytes), source=str(path))


def dump_json(document: Any, path: Path | str) -> None:
    """Write a JSON file, atomically, readable by a person and the same for the same content.

    Parameters
    ----------
    document : object
        What `json.dumps` takes; numbers must be finite. Floats round-trip exactly.
    path : Path or str
        The file.

    Raises
    ------
    FileError
        If it cannot be written.
    """
    write_text(path, json.dumps(document, indent=1, ensure_ascii=False, allow_nan=False) + "\n")


def _depth(text: str) -> int:
    """Return the deepest nesting of brackets outside of strings, without recursion."""
    depth = deepest = 0
    in_string = escaped = False
    for character in text:
        if in_string:
            in_string = escaped or character != '"'
            escaped = character == "\\" and not escaped
        elif character == '"':
            in_string = True
        elif character in "[{":
            depth += 1
            deepest = max(deepest, depth)
        elif character in "]}":
            depth -= 1
    return deepest
