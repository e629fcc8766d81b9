"""Stored results of verification: strict JSON that a report can be rendered from again."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Protocol

import numpy as np

from closerange.errors import SchemaError
from closerange.files import MAX_TABLE_BYTES, dump_json, load_json

SCHEMA = "closerange.result/1"
KINDS = ("control", "single-point", "lengths", "heights")

_ROWS = {  # what every document of a kind has, so that a report never meets a gap
    "control": ("rows", "groups", "coverage", "systematic", "missing", "left_out"),
    "single-point": ("rows", "accuracy", "repeatability", "luck", "slopes", "decision"),
    "lengths": ("rows", "rms_mm", "max_mm", "missing"),
    "heights": ("rows", "rms_mm", "max_mm", "points_median_mm", "tolerance_mm", "missing"),
}


class Result(Protocol):
    """What can be stored: `ControlCheck`, `AcceptanceReport`, `LengthCheck`, `HeightCheck`."""

    def to_document(self) -> dict[str, Any]:
        """Return a JSON-ready document with its ``kind``."""
        ...


def write_result(
    result: Result, path: Path | str, *, provenance: Mapping[str, Any] | None = None
) -> None:
    """Write a verification result.

    Parameters
    ----------
    result : ControlCheck, AcceptanceReport, LengthCheck or HeightCheck
        What was found.
    path : Path or str
        JSON file, replaced whole or not at all.
    provenance : mapping, optional
        JSON-ready: program version, options, hashes of inputs.

    Raises
    ------
    FileError
        If it cannot be written.
    """
    document = {"schema": SCHEMA, **result.to_document(), "provenance": plain(provenance or {})}
    dump_json(document, path)


def read_result(path: Path | str) -> dict[str, Any]:
    """Read a stored verification result.

    Parameters
    ----------
    path : Path or str
        JSON file.

    Returns
    -------
    dict
        The document: ``schema``, ``kind``, ``provenance`` and the fields of the result; null
        stands for "not known".

    Raises
    ------
    FileError
        If the file cannot be read.
    SchemaError
        If it is not a stored result, or of a version that this program does not know.
    """
    # a result has a row for each measured position, hence the limit of a table
    document = load_json(path, max_bytes=MAX_TABLE_BYTES)
    if not isinstance(document, dict) or document.get("schema") != SCHEMA:
        found = document.get("schema") if isinstance(document, dict) else type(document).__name__
        raise SchemaError(
            f"{path}: schema is {found!r}, expected {SCHEMA!r}",
            remedy="name a file written by closerange verify",
        )
    kind = document.get("kind")
    if kind not in KINDS:
        raise SchemaError(
            f"{path}: kind is {kind!r}; known kinds are {', '.join(KINDS)}",
            remedy="write it again with this version of the program",
        )
    absent = [name for name in (*_ROWS[kind], "provenance") if name not in document]
    if absent:
        raise SchemaError(
            f"{path}: {', '.join(absent)} missing in a result of kind {kind!r}",
            remedy="write it again with closerange verify",
        )
    return document


def plain(value: Any) -> Any:
    """Turn dataclasses, arrays and mappings into what JSON can hold.

    Parameters
    ----------
    value : object
        Numbers, texts, None, arrays, dataclasses and containers of them.

    Returns
    -------
    object
        Dictionaries, lists, texts, numbers, booleans and None; NaN and infinity become None.
    """
    if isinstance(value, np.ndarray | np.generic):
        value = value.tolist()
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        return {item.name: plain(getattr(value, item.name)) for item in dataclasses.fields(value)}
    if isinstance(value, Mapping):
        return {str(key): plain(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [plain(item) for item in value]
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value
