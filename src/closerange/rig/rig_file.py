"""The rig file: JSON of our own schema, readable by a person, strict, and exact both ways.

Rows of numbers stand on one line. Geometry (matrices, poses, lenses, volume) must be finite;
estimates of uncertainty may be ``null``, which means NaN: not known; noise and covariance only
of a rig that is marked untrustworthy, since nothing else could mark what it measures. Keys that
the schema does not have are refused, since one that is not understood may change what the others
mean; free notes have their place under ``report`` and ``provenance``.
"""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from closerange.errors import SchemaError
from closerange.files import load_json, parse_json, write_text
from closerange.flags import format_flags
from closerange.geometry.arrays import FloatArray
from closerange.rig.camera import Camera
from closerange.rig.distortion import COEFFICIENTS, BrownIdeal, BrownObserved, Distortion
from closerange.rig.rig import Residuals, Rig, Trust
from closerange.rig.rig_schema import INFINITE, RESIDUAL_COLUMNS, SCHEMA, Reader, rig_from_reader

MAX_RIG_BYTES = 64 * 2**20
"""Largest rig file read: 300 000 residuals of at most 200 bytes."""


def write_rig(rig: Rig, path: Path | str) -> None:
    """Write a rig file, atomically; the same rig gives the same bytes.

    What would be written is read back first, so that no file is made that cannot be opened.

    Parameters
    ----------
    rig : Rig
        The rig.
    path : Path or str
        The file, usually ``*.json``.

    Raises
    ------
    SchemaError
        If the rig holds what the schema cannot (NaN in a camera, an unknown lens) or is too large.
    FileError
        If it cannot be written.
    """
    try:
        text = _readable(rig_to_document(rig)) + "\n"
        size = len(text.encode("utf-8"))
    except SchemaError:
        raise
    except ValueError as error:  # infinity, or half a surrogate pair
        raise SchemaError(
            f"{path}: the rig cannot be written ({error})", remedy="calibrate again"
        ) from error
    if size > MAX_RIG_BYTES:
        raise SchemaError(
            f"{path}: the rig has {size} bytes, the limit is {MAX_RIG_BYTES}",
            remedy="calibrate with fewer points",
        )
    rig_from_document(parse_json(text, source=str(path)), source=str(path))
    write_text(path, text)


def read_rig(path: Path | str) -> Rig:
    """Read a rig file.

    Parameters
    ----------
    path : Path or str
        The file.

    Returns
    -------
    Rig
        Equal, bit for bit, to the one that was written.

    Raises
    ------
    FileError
        If the file is missing, unreadable, larger than 64 MiB or not text (a pickle, an archive).
    SchemaError
        If it is not JSON of the schema ``closerange.rig/2`` or ``closerange.rig/1``, or a rig that
        is not marked untrustworthy lacks noise or covariance; names file, key and remedy.
    """
    return rig_from_document(load_json(path, max_bytes=MAX_RIG_BYTES), source=str(path))


def rig_to_document(rig: Rig) -> dict[str, Any]:
    """Turn a rig into dictionaries, lists, texts and numbers.

    Parameters
    ----------
    rig : Rig
        The rig.

    Returns
    -------
    dict
        JSON-ready; NaN is None.

    Raises
    ------
    SchemaError
        If a lens is of a kind the schema does not have, or report or provenance hold what JSON
        cannot.
    """
    return {
        "schema": SCHEMA,
        "model": rig.model,
        "trust": None if rig.trust is None else _trust_document(rig.trust),
        "noise_px": _number(rig.noise_px),
        "tau_px": _number(rig.tau_px),
        "dof": int(rig.dof),
        "volume_mm": _numbers(rig.volume_mm),
        "cameras": [_camera_document(camera) for camera in rig.cameras],
        "parameters": list(rig.parameters),
        "parameter_cov": _numbers(rig.parameter_cov),
        "report": _plain(rig.report, "report"),
        "provenance": _plain(rig.provenance, "provenance"),
        "residuals": _residuals_document(rig.residuals),
    }


def rig_from_document(document: Any, *, source: str = "rig") -> Rig:
    """Turn parsed JSON into a rig; the inverse of `rig_to_document`.

    Parameters
    ----------
    document : object
        As `closerange.files.load_json` returns it.
    source : str, optional
        File name for messages.

    Returns
    -------
    Rig
        The rig.

    Raises
    ------
    SchemaError
        If it is not of the schema ``closerange.rig/2`` or ``closerange.rig/1``; names file, key
        and remedy.
    """
    return rig_from_reader(Reader(document, source))


def _camera_document(camera: Camera) -> dict[str, Any]:
    pose = camera.camera_from_world
    return {
        "name": camera.name,
        "size_px": list(camera.size_px),
        "matrix_px": _numbers(camera.matrix_px),
        "distortion": _lens_document(camera.distortion, camera.name),
        "camera_from_world": {
            "rotation": _numbers(pose.rotation),
            "translation_mm": _numbers(pose.translation_mm),
        },
    }


def _lens_document(lens: Distortion, camera: str) -> dict[str, Any]:
    if not isinstance(lens, BrownIdeal | BrownObserved):
        raise SchemaError(
            f"camera {camera!r}: a lens of type {type(lens).__name__} has no place in a rig file",
            remedy="use BrownIdeal or BrownObserved",
        )
    terms = {name: _number(getattr(lens, name)) for name in COEFFICIENTS}
    if isinstance(lens, BrownIdeal):
        return {"model": "brown-ideal", **terms}
    return {
        "model": "brown-observed",
        **terms,
        "centre_px": _numbers(lens.centre_px),
        "unit_px": _numbers(lens.unit_px),
    }


def _trust_document(trust: Trust) -> dict[str, Any]:
    def bounded(values: FloatArray) -> list[Any]:  # a plane has no bound: that too must be written
        return [INFINITE if math.isinf(value) else _number(value) for value in values]

    return {
        "verdict": trust.verdict,
        "predicted_mm": bounded(trust.predicted_mm),
        "calibration_mm": bounded(trust.calibration_mm),
        "reasons": list(trust.reasons),
    }


def _residuals_document(residuals: Residuals) -> dict[str, Any]:
    columns = (
        residuals.camera,
        residuals.placement,
        residuals.point,
        *(_numbers(column) for column in residuals.xyz_mm.T),
        *(_numbers(column) for column in residuals.xy_px.T),
        *(_numbers(column) for column in residuals.residual_px.T),
        residuals.fitted.tolist(),
        [format_flags(int(bits)) for bits in residuals.flags],
    )
    return {
        "columns": list(RESIDUAL_COLUMNS),
        "rows": [list(row) for row in zip(*columns, strict=True)],
    }


def _number(value: float) -> float | None:
    return None if math.isnan(value) else float(value)


def _numbers(array: FloatArray) -> list[Any]:
    """Turn an array into nested lists with None for NaN."""
    values = array.tolist()
    if not np.isnan(array).any():
        return list(values)
    return [_numbers(row) for row in array] if array.ndim > 1 else [_number(v) for v in values]


def _plain(value: Any, path: str) -> Any:
    """Turn mappings, sequences and NumPy values into what JSON holds; NaN becomes None."""
    if isinstance(value, np.generic | np.ndarray):
        return _plain(value.tolist(), path)
    if isinstance(value, float):
        if math.isinf(value):
            raise SchemaError(f"{path}: infinite", remedy="write a text instead")
        return _number(value)
    if value is None or isinstance(value, str | int):
        return value
    if isinstance(value, Mapping):
        return {str(key): _plain(item, f"{path}.{key}") for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(item, f"{path}[{index}]") for index, item in enumerate(value)]
    raise SchemaError(
        f"{path}: a value of type {type(value).__name__} has no form in JSON",
        remedy="write it as text or number",
    )


def _readable(value: Any, indent: int = 0) -> str:
    """Write JSON with lists of plain values on one line, everything else indented."""
    items = value.values() if isinstance(value, dict) else value
    nested = isinstance(value, dict | list) and any(isinstance(item, dict | list) for item in items)
    if not value or not (nested or isinstance(value, dict)):
        return json.dumps(value, ensure_ascii=False, allow_nan=False)
    texts = [_readable(item, indent + 1) for item in items]
    if isinstance(value, dict):
        keys = (json.dumps(key, ensure_ascii=False) for key in value)
        texts = [f"{key}: {text}" for key, text in zip(keys, texts, strict=True)]
    opening, closing = "{}" if isinstance(value, dict) else "[]"
    space = "\n" + " " * indent
    return opening + space + " " + f",{space} ".join(texts) + space + closing
