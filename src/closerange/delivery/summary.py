"""One screen of text and one JSON document that say what was done and what to believe."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from closerange.delivery.excerpts import documents_of, numbers
from closerange.delivery.front_page import verdict
from closerange.delivery.sheet import Contents
from closerange.delivery.wording import (
    DASH,
    counted,
    fixed,
    percent,
    short_length,
    three_micrometres,
)
from closerange.features.image_points import ImagePoints
from closerange.flags import Flag
from closerange.geometry.arrays import FloatArray, IntArray
from closerange.position.positions import Positions
from closerange.rig.rig import Rig
from closerange.verification.error_map import ErrorMap
from closerange.verification.result_file import plain

_LABEL_WIDTH = 13


def text_summary(
    *,
    rig: Rig | None = None,
    points: ImagePoints | None = None,
    positions: Positions | None = None,
    checks: Sequence[object] = (),
    notes: Sequence[str] = (),
    more: Sequence[tuple[str, str]] = (),
) -> str:
    """Write a summary of one screen, with aligned labels.

    Parameters
    ----------
    rig, points, positions, checks, notes
        As in `render_report`.
    more : sequence of (str, str), optional
        Further lines: label and text.

    Returns
    -------
    str
        Plain text for a terminal, one fact a line, without a newline at its end. Lines without
        data are left out.
    """
    lines: list[tuple[str, str]] = []
    if rig is not None:
        lines.append(("Rig", _rig_line(rig)))
        if rig.trust is not None:
            error = three_micrometres(rig.trust.predicted_mm)
            size = " x ".join(fixed(float(side), 0) for side in np.ptp(rig.volume_mm, axis=0))
            lines.append(
                ("Trust", f"{rig.trust.verdict}: predicted error {error} inside {size} mm")
            )
            lines += [("", reason) for reason in rig.trust.reasons]
    if points is not None:
        cameras, placements = len(points.cameras), len(set(points.placement))
        where = f"{counted(cameras, 'camera')}, {counted(placements, 'placement')}"
        found = int(points.found.sum())
        flagged = _flag_counts(points.flags)
        lines.append(("Points", f"{found} of {len(points)} found by {where}{flagged}"))
    if positions is not None:
        measured = int(positions.measured.sum())
        flagged = _flag_counts(positions.flags)
        lines.append(("Measured", f"{counted(measured, 'position')} of {len(positions)}{flagged}"))
    lines += [_check_line(check) for check in documents_of(checks)]
    lines += [("Warning" if i == 0 else "", note) for i, note in enumerate(notes)]
    lines += more
    text = "\n".join(f"{label:<{_LABEL_WIDTH}}{_indented(words)}" for label, words in lines)
    # what terminals of every code page show
    return text.replace("µm", "um").replace(DASH, "-")


def json_summary(
    *,
    title: str,
    rig: Rig | None = None,
    points: ImagePoints | None = None,
    positions: Positions | None = None,
    checks: Sequence[object] = (),
    error_map: ErrorMap | None = None,
    provenance: Mapping[str, Any] | None = None,
    notes: Sequence[str] = (),
) -> dict[str, Any]:
    """Sum up for programs: what `text_summary` says, as numbers.

    Parameters
    ----------
    title, rig, points, positions, checks, error_map, provenance, notes
        As in `render_report`.

    Returns
    -------
    dict
        JSON-ready: no NaN (null = not known), no arrays. Parts without data are left out.
    """
    documents = documents_of(checks)
    contents = Contents(
        title=title, rig=rig, points=points, positions=positions, checks=documents, notes=notes
    )
    found = verdict(contents)
    summary: dict[str, Any] = {"title": title, "verdict": found.text.replace("µm", "um")}
    if rig is not None:
        summary["rig"] = _rig_document(rig)
    if points is not None:
        summary["points"] = {
            "cameras": list(points.cameras),
            "placements": len(set(points.placement)),
            "rows": len(points),
            "found": int(points.found.sum()),
            "flags": _counts(points.flags),
        }
    if positions is not None:
        summary["positions"] = {
            "rows": len(positions),
            "measured": int(positions.measured.sum()),
            "residual_px": _rms(positions.residual_px),
            "flags": _counts(positions.flags),
        }
    if error_map is not None:
        summary["predicted_error_mm"] = {
            "rms": [_rms(error_map.std_mm[:, axis]) for axis in range(3)],
            "calibration_rms": [_rms(error_map.calibration_std_mm[:, axis]) for axis in range(3)],
        }
    if documents:
        # rows are what the result file is for
        summary["checks"] = [
            {name: value for name, value in check.items() if name not in ("rows", "provenance")}
            for check in documents
        ]
    summary["warnings"] = list(notes)
    if provenance:
        summary["provenance"] = provenance
    document: dict[str, Any] = plain(summary)
    return document


def _rig_line(rig: Rig) -> str:
    fitted = np.asarray(rig.residuals.fitted)
    names = zip(rig.residuals.placement, rig.residuals.point, strict=True)
    used = {name for name, is_fitted in zip(names, fitted, strict=True) if is_fitted}
    placements = counted(len({placement for placement, _ in used}), "placement")
    what = f"{counted(len(used), 'point')} in {placements}, " if used else ""
    noise = f"image noise {fixed(rig.noise_px, 3)} px"
    return f"{counted(len(rig.cameras), 'camera')}, {what}model {rig.model}, {noise}"


def _rig_document(rig: Rig) -> dict[str, Any]:
    trust = rig.trust
    return {
        "cameras": [camera.name for camera in rig.cameras],
        "model": rig.model,
        "volume_mm": rig.volume_mm,
        "noise_px": rig.noise_px,
        "dof": rig.dof,
        "fitted": int(np.asarray(rig.residuals.fitted).sum()),
        "flags": _counts(rig.residuals.flags),
        "trust": trust,
    }


def _check_line(check: Mapping[str, Any]) -> tuple[str, str]:
    """Write one line for a verification result."""
    if check["kind"] == "single-point":
        accuracy = three_micrometres(numbers(check["accuracy"]["max_mm"]))
        spread = three_micrometres(numbers(check["repeatability"]["pooled"]["std_mm"]))
        count = counted(len(check["rows"]["point"]), "position")
        decision = f": {check['decision']}" if check["decision"] else ""
        text = f"{count}: accuracy {accuracy}, repeatability {spread}"
        return "Verified", text + _held(check["coverage"]) + decision
    if check["kind"] == "control":
        name = "check" if check["groups"].get("check", {"count": 0})["count"] else "all"
        group = check["groups"][name]
        word = "check point" if name == "check" else "control point"
        error = three_micrometres(numbers(group["rms_mm"]))
        text = f"{counted(group['count'], word)}: rms error {error}"
        return "Control", text + _held(check["coverage"][name])
    rms, largest = (short_length(float(numbers(check[name]))) for name in ("rms_mm", "max_mm"))
    used = counted(sum(check["rows"]["used"]), "length")
    return "Lengths", f"{used}: rms error {rms}, largest {largest}"


def _held(coverage: Mapping[str, Any]) -> str:
    share = float(numbers(coverage["share"]))
    level = f"{100 * coverage['level']:.0f} %"
    return f" ({level} region holds {percent(share)})" if np.isfinite(share) else ""


def _counts(flags: IntArray) -> dict[str, int]:
    counts = {str(bit.name): int(((flags & int(bit)) != 0).sum()) for bit in Flag}
    return {name: count for name, count in counts.items() if count}


def _flag_counts(flags: IntArray) -> str:
    counts = _counts(flags)
    if not counts:
        return ", none flagged"
    names = ", ".join(f"{name} {count}" for name, count in counts.items())
    return f", {int((flags != 0).sum())} flagged ({names})"


def _rms(values: FloatArray) -> float:
    known = values[np.isfinite(values)]
    return float(np.sqrt((known**2).mean())) if known.size else float("nan")


def _indented(text: str) -> str:
    """Keep the lines of a longer text under each other."""
    return text.replace("\n", "\n" + " " * _LABEL_WIDTH)
