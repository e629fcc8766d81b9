"""The tables beside a ``run.json``: written with their hashes, read back only if unchanged."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path, PureWindowsPath
from typing import Any

from closerange.errors import FileError, SchemaError
from closerange.features.image_points import ImagePoints
from closerange.features.points_table import read_points, write_points
from closerange.features.threshold import threshold_documents, thresholds_from
from closerange.files import MAX_TABLE_BYTES, read_limited, sha256
from closerange.matching.correspondences import Correspondences
from closerange.matching.matches_table import read_matches, write_matches
from closerange.position.positions import Positions
from closerange.position.positions_table import read_positions, write_positions

CALIBRATION = "calibration"
"""Stands in the place of a job's name for the points that the rig was calibrated from."""

POINTS, POSITIONS, MATCHES = "points", "positions", "matches"


def write_tables(
    folder: Path,
    points: Mapping[str, ImagePoints],
    positions: Mapping[str, Positions],
    matches: Mapping[str, Correspondences] | None = None,
) -> list[dict[str, Any]]:
    """Write the tables of a run.

    Parameters
    ----------
    folder : Path
        Where.
    points, positions, matches : mapping of str to ImagePoints, Positions or Correspondences
        By the name of their job.

    Returns
    -------
    list of dict
        One entry a table, for ``run.json``: ``job``, ``kind``, ``file``, ``sha256``, and of
        detected points ``thresholds``, which a points table does not hold.
    """
    entries: list[dict[str, Any]] = []
    matches = matches or {}
    for job in dict.fromkeys((*points, *positions)):
        stem = job.replace(" ", "-")
        if job in matches:
            write_matches(matches[job], folder / f"{stem}-matches.csv")
            entries.append({"job": job, "kind": MATCHES, "file": f"{stem}-matches.csv"})
        if job in points:
            write_points(points[job], folder / f"{stem}-points.csv")
            entry: dict[str, Any] = {"job": job, "kind": POINTS, "file": f"{stem}-points.csv"}
            if points[job].thresholds:
                entry["thresholds"] = threshold_documents(points[job].thresholds)
            entries.append(entry)
        if job in positions:
            write_positions(positions[job], folder / f"{stem}-positions.csv")
            entries.append({"job": job, "kind": POSITIONS, "file": f"{stem}-positions.csv"})
    return [entry | {"sha256": sha256(folder / entry["file"])} for entry in entries]


def read_tables(
    entries: Sequence[Mapping[str, Any]], folder: Path, *, source: str
) -> tuple[dict[str, ImagePoints], dict[str, Positions], dict[str, Correspondences]]:
    """Read the tables that a ``run.json`` names.

    Parameters
    ----------
    entries : sequence of mapping
        As `write_tables` returns them; they are not trusted.
    folder : Path
        Folder of the ``run.json``.
    source : str
        Its name for messages.

    Returns
    -------
    tuple of dict
        Points, positions and matches by the name of their job.

    Raises
    ------
    FileError
        If a table is missing, or is not the one that the run wrote.
    SchemaError
        If an entry names no table of this folder.
    """
    points: dict[str, ImagePoints] = {}
    positions: dict[str, Positions] = {}
    matches: dict[str, Correspondences] = {}
    for entry in entries:
        job, kind = str(entry["job"]), entry["kind"]
        path = _unchanged(str(entry["file"]), str(entry["sha256"]), folder, source=source)
        if kind == POINTS:
            thresholds = thresholds_from(entry.get("thresholds", ()))
            points[job] = replace(read_points(path), thresholds=thresholds)
        elif kind == POSITIONS:
            positions[job] = read_positions(path)
        elif kind == MATCHES:
            matches[job] = read_matches(path)
        else:
            raise SchemaError(
                f"{source}: a table of kind {kind!r}; known kinds are {POINTS}, {POSITIONS}, "
                f"{MATCHES}",
                remedy="render it with the version of the program that wrote it",
            )
    return points, positions, matches


def _unchanged(name: str, digest: str, folder: Path, *, source: str) -> Path:
    """Return the path of a table after checking that it is the one that the run wrote."""
    # a name of Windows is refused everywhere: it would mean another file there
    if name in ("", ".", "..") or {Path(name).name, PureWindowsPath(name).name} != {name}:
        raise SchemaError(
            f"{source}: table {name!r} does not lie beside it",
            remedy="only tables in the same folder are read; run the project again",
        )
    path = folder / name
    remedy = f"restore the table as the run wrote it beside {Path(source).name}, or run again"
    if not path.is_file():
        raise FileError(f"{path}: the table is missing; {source} was made with it", remedy=remedy)
    found = hashlib.sha256(read_limited(path, max_bytes=MAX_TABLE_BYTES)).hexdigest()
    if found != digest:
        raise FileError(
            f"{path}: the table was changed after the run (SHA-256 {found[:12]}..., the run wrote "
            f"{digest[:12]}...)",
            remedy=remedy,
        )
    return path
