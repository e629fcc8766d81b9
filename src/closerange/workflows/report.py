"""The verb `report`: any stored result becomes one self-contained HTML file."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from closerange.delivery.match_pictures import ScenePictures
from closerange.delivery.overlays import Overlay
from closerange.delivery.report import render_report
from closerange.errors import SchemaError
from closerange.files import MAX_TABLE_BYTES, load_json
from closerange.rig.rig import Rig
from closerange.rig.rig_file import rig_from_document
from closerange.rig.rig_schema import SCHEMAS as RIG_SCHEMAS
from closerange.verification.error_map import ErrorMap, judged_volume, predict_errors
from closerange.verification.result_file import SCHEMA as RESULT_SCHEMA
from closerange.verification.result_file import read_result
from closerange.workflows.run_tables import read_tables
from closerange.workflows.volume import proposal_of

RUN_SCHEMA = "closerange.run/1"

_TITLES = {
    "control": "Comparison with control points",
    "single-point": "Single-point test",
    "lengths": "Length test",
    "heights": "Heights of known parts",
}


def report(source: Path | str) -> str:
    """Render a stored result again.

    Parameters
    ----------
    source : Path or str
        A rig file, a verification result, or the ``run.json`` of a project, with its
        tables beside it.

    Returns
    -------
    str
        HTML that needs no other file and no network.

    Raises
    ------
    FileError
        If the file cannot be read.
    SchemaError
        If it is none of our files.
    """
    document = load_json(source, max_bytes=MAX_TABLE_BYTES)
    schema = document.get("schema") if isinstance(document, dict) else None
    if schema in RIG_SCHEMAS:
        return report_of_rig(rig_from_document(document, source=str(source)))
    if schema == RESULT_SCHEMA:
        return report_of_result(read_result(source))
    if schema == RUN_SCHEMA:
        return report_of_run(document, folder=Path(source).parent, source=str(source))
    raise SchemaError(
        f"{source}: schema is {schema!r}; no stored result",
        remedy="name a rig file, a verification result or a run.json",
    )


def report_of_rig(rig: Rig) -> str:
    """Render a calibration."""
    return render_report(
        title="Calibration",
        rig=rig,
        error_map=error_map_of(rig),
        proposal=proposal_of(rig),
        provenance=rig.provenance,
    )


def report_of_result(document: Mapping[str, Any]) -> str:
    """Render a verification result."""
    return render_report(
        title=_TITLES[document["kind"]],
        checks=[document],
        provenance=document.get("provenance") or {},
    )


def report_of_run(document: Mapping[str, Any], *, folder: Path, source: str) -> str:
    """Render what a project gave, from its ``run.json`` and the tables beside it.

    Parameters
    ----------
    document : mapping
        Contents of the ``run.json``.
    folder : Path
        Where it lies.
    source : str
        Its name for messages.

    Returns
    -------
    str
        HTML.

    Raises
    ------
    FileError
        If a table is missing, or was changed since the run.
    SchemaError
        If it is not a complete run.
    """
    try:
        rig = rig_from_document(document["rig"], source=source)
        points, positions, matches = read_tables(document["tables"], folder, source=source)
        return render_report(
            title=document["title"],
            rig=rig,
            points=points,
            overlays=[Overlay.from_document(entry) for entry in document["overlays"]],
            positions=positions,
            matches=matches,
            scenes={
                str(entry["job"]): ScenePictures.from_document(entry)
                for entry in document.get("scenes", ())
            },
            checks=document["results"],
            error_map=error_map_of(rig),
            proposal=proposal_of(rig),
            provenance=document["provenance"],
            notes=document["warnings"],
        )
    except (KeyError, TypeError, AttributeError) as error:
        raise SchemaError(
            f"{source}: not a complete run ({error})", remedy="run the project again"
        ) from error


def error_map_of(rig: Rig) -> ErrorMap | None:
    """Predict the error in the volume; None for a single camera, which measures no position."""
    if len(rig.cameras) < 2:
        return None
    return predict_errors(rig, judged_volume(rig.volume_mm))
