"""What the verbs print: one screen for people, one dictionary for machines."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from closerange.errors import DataError
from closerange.features.image_points import ImagePoints
from closerange.features.threshold import threshold_documents
from closerange.flags import Flag
from closerange.geometry.arrays import FloatArray, IntArray
from closerange.position.positions import Positions
from closerange.rig.radial_table import lens_centre, radial_tables
from closerange.rig.rig import Rig
from closerange.verification.acceptance import AcceptanceReport
from closerange.verification.control_check import ControlCheck
from closerange.verification.heights import HeightCheck
from closerange.verification.lengths import LengthCheck
from closerange.workflows.run import RunResult
from closerange.workflows.verify import Result

AXES = ("x", "y", "z")

RADIAL_ROWS = 33
"""Rows of a lens' table: a monotone cubic between them is good to 0.003 px of 100 px."""


def lines(*pairs: tuple[str, object]) -> str:
    """Align labels and texts as one block; pairs with an empty text are left out."""
    return "\n".join(f"{label:<13}{text}" for label, text in pairs if str(text))


def box_text(volume_mm: FloatArray) -> str:
    """Write the limits of a volume; axes without limits are left out."""
    limits = [
        f"{axis} {low:g} to {high:g}"
        for axis, low, high in zip("XYZ", *volume_mm.tolist(), strict=True)
        if np.isfinite([low, high]).any()
    ]
    return f"{', '.join(limits)} mm"


def points_text(points: ImagePoints, output: Path) -> str:
    """Say what was detected."""
    placements = len(set(zip(points.placement, points.reading, strict=True)))
    return lines(
        ("Points", f"{int(points.found.sum())} of {len(points)} found in {placements} images"),
        ("Flags", flags_text(points.flags)),
        ("Thresholds", _bistable(points)),
        ("Written", output),
    )


def _bistable(points: ImagePoints) -> str:
    """Say where Trussell's iteration could have ended elsewhere."""
    several = sum(len(report.fixed_points) > 1 for report in points.thresholds.values())
    if not several:
        return ""
    return f"{several} of {len(points.thresholds)} images have several fixed points, see --json"


def points_summary(points: ImagePoints, output: Path) -> dict[str, Any]:
    """Summarise what was detected."""
    return {
        "rows": len(points),
        "found": int(points.found.sum()),
        "unflagged": int((points.flags == 0).sum()),
        "flags": flag_counts(points.flags),
        "thresholds": threshold_documents(points.thresholds),
        "image_size": {name: list(size) for name, size in points.size_px.items()},
        "output": str(output),
    }


def rig_text(rig: Rig, output: Path | None, report: Path | None) -> str:
    """Say what was calibrated and what to believe."""
    outliers = _outliers(rig)
    return lines(
        ("Rig", _rig_line(rig)),
        ("Trust", rig.trust or ""),
        *((("", reason) for reason in rig.trust.reasons) if rig.trust else ()),
        ("Left out", f"{len(outliers)} blunders: " + ", ".join(outliers) if outliers else ""),
        ("Written", output or ""),
        ("Report", report or ""),
    )


def rig_summary(rig: Rig, output: Path | None) -> dict[str, Any]:
    """Summarise a calibration."""
    trust = rig.trust
    return {
        "cameras": [camera.name for camera in rig.cameras],
        "model": rig.model,
        "points_fitted": int(rig.residuals.fitted.sum()),
        "noise_px": rig.noise_px,
        "dof": rig.dof,
        "volume_mm": rig.volume_mm.tolist(),
        "outliers": _outliers(rig),
        "radial_distortion": _radial(rig),
        "trust": None
        if trust is None
        else {
            "verdict": trust.verdict,
            "predicted_mm": trust.predicted_mm.tolist(),
            "calibration_mm": trust.calibration_mm.tolist(),
            "reasons": list(trust.reasons),
        },
        "output": None if output is None else str(output),
    }


def _radial(rig: Rig) -> dict[str, Any]:
    """Tabulate how far observed points lie too far out: to be subtracted (section 6.2)."""
    return {
        name: {
            "centre_px": lens_centre(rig.camera(name)).tolist(),
            "radius_px": table.radius_px.tolist(),
            "delta_px": table.delta_px.tolist(),
        }
        for name, table in radial_tables(rig.cameras, rows=RADIAL_ROWS).items()
    }


def positions_text(positions: Positions, output: Path) -> str:
    """Say what was measured."""
    measured = positions.measured
    std = np.sqrt(np.einsum("mii->mi", positions.cov_mm2[measured]))
    typical = "  ".join(
        f"{micrometres(value)} ({axis.upper()})"
        for axis, value in zip(AXES, np.median(std, axis=0) if measured.any() else [], strict=False)
    )
    return lines(
        ("Positions", f"{int(measured.sum())} of {len(positions)} measured"),
        ("Std", f"{typical} (median)" if typical else ""),
        ("Flags", flags_text(positions.flags)),
        ("Written", output),
    )


def positions_summary(positions: Positions, output: Path) -> dict[str, Any]:
    """Summarise what was measured."""
    measured = positions.measured
    return {
        "rows": len(positions),
        "measured": int(measured.sum()),
        "unflagged": int((positions.flags == 0).sum()),
        "flags": flag_counts(positions.flags),
        "residual_px_rms": _rms(positions.residual_px[measured]),
        "output": str(output),
    }


def result_text(result: Result, output: Path | None, report: Path | None) -> str:
    """Say what a verification found."""
    return lines(*_result_lines(result), ("Written", output or ""), ("Report", report or ""))


def result_summary(result: Result, output: Path | None) -> dict[str, Any]:
    """Summarise a verification."""
    summary: dict[str, Any] = {"output": None if output is None else str(output)}
    if isinstance(result, AcceptanceReport):
        return summary | {
            "kind": "single-point",
            "positions": len(result.point),
            "accuracy_mm": result.accuracy.max_mm.tolist(),
            "rms_mm": result.accuracy.rms_mm.tolist(),
            "repeatability_mm": result.repeatability.pooled.std_mm.tolist(),
            "accuracy_ratio": result.prediction.accuracy_ratio.tolist(),
            "repeatability_ratio": result.prediction.repeatability_ratio.tolist(),
            "coverage": result.coverage.share,
            "decision": result.decision,
            "reservations": list(result.reservations),
        }
    if isinstance(result, LengthCheck):
        return summary | {
            "kind": "lengths",
            "lengths": int(result.used.sum()),
            "rms_mm": result.rms_mm,
            "max_mm": result.max_mm,
            "reservations": list(result.reservations),
        }
    if isinstance(result, HeightCheck):
        return summary | {
            "kind": "heights",
            "heights": int(result.used.sum()),
            "points": int(result.count.sum()),
            "rms_mm": result.rms_mm,
            "max_mm": result.max_mm,
            "points_median_mm": result.points_median_mm,
            "points_p95_mm": result.points_p95_mm,
            "missing": [list(key) for key in result.missing],
            "reservations": list(result.reservations),
        }
    groups = {
        name: {
            "count": group.count,
            "rms_mm": group.rms_mm.tolist(),
            "max_mm": group.max_mm.tolist(),
        }
        for name, group in result.groups.items()
    }
    return summary | {"kind": "control", "groups": groups}


def run_text(result: RunResult) -> str:
    """Say what a project gave."""
    blocks = [lines(("Rig", _rig_line(result.rig)), ("Trust", result.rig.trust or ""))]
    for job in result.jobs:
        measured = f"{int(job.positions.measured.sum())} of {len(job.positions)} positions measured"
        found = _result_lines(job.result) if job.result is not None else []
        cycle = f"{1000 * job.cycle_time_s:.0f} ms a reading, images on disk to position"
        blocks.append(lines(("Job", f"{job.name}: {measured}"), *found, ("Cycle time", cycle)))
    blocks.append(lines(("Report", result.report)))
    return "\n".join(blocks)


def demo_text(result: RunResult) -> str:
    """Say on one screen what the demonstration reached."""
    rows: list[tuple[str, object]] = [
        ("Rig", f"{_rig_line(result.rig)}, calibrated in {result.calibration_s:.2f} s"),
        ("Trust", _volume_line(result.rig)),
    ]
    lengths = [job.result for job in result.jobs if isinstance(job.result, LengthCheck)]
    for job in result.jobs:
        if isinstance(job.result, AcceptanceReport):
            rows.extend(_result_lines(job.result))
    if lengths:
        errors = np.concatenate([check.error_mm[check.used] for check in lengths])
        rows.append(
            (
                "Lengths",
                f"{len(errors)} bars of known length: worst error {micrometres(_worst(errors))}",
            )
        )
    rows += _scene_lines(result)
    rows += [
        ("Report", result.report),
        ("Next", "closerange calibrate --help     your own cameras: docs/first-rig.md"),
    ]
    return lines(*rows)


def _scene_lines(result: RunResult) -> list[tuple[str, object]]:
    """Say what was matched, and how far the heights are off."""
    rows: list[tuple[str, object]] = []
    for job in result.jobs:
        if job.scene is None or not isinstance(job.result, HeightCheck):
            continue
        matches, check = job.scene.matches, job.result
        kept = f"{int(matches.clean.sum())} of {len(matches)} points matched and kept"
        single = f"{micrometres(check.points_median_mm)} (median point)"
        worst = f"{micrometres(check.max_mm)} (worst of {int(check.used.sum())} parts)"
        rows.append((job.name[:12].capitalize(), f"{kept}; heights off by {single}, {worst}"))
    return rows


def run_summary(result: RunResult) -> dict[str, Any]:
    """Summarise what a project gave."""
    return {
        "rig": rig_summary(result.rig, result.folder / "rig.json"),
        "jobs": [
            {
                "name": job.name,
                "positions": len(job.positions),
                "measured": int(job.positions.measured.sum()),
                "cycle_time_s": job.cycle_time_s,
                "result": None if job.result is None else result_summary(job.result, None),
            }
            for job in result.jobs
        ],
        "warnings": list(result.warnings),
        "calibration_s": result.calibration_s,
        "report": str(result.report),
    }


def run_failure(result: RunResult) -> DataError | None:
    """Say which job cannot be relied upon, although its tables are written."""
    for job in result.jobs:
        if job.failure:
            return DataError(
                f"job {job.name!r}: {job.failure}",
                remedy="look at its flags; the files are written to be looked at, not relied on",
            )
    return None


def result_failure(result: Result) -> DataError | None:
    """Say why a result that is written proves nothing."""
    if not result.hollow:
        return None
    return DataError(
        result.hollow,
        remedy="look at the flags of the positions, and measure again; the result is written to be "
        "looked at, not relied on",
    )


def micrometres(value_mm: float) -> str:
    """Write a length in um with two or three digits."""
    if not np.isfinite(value_mm):
        return "unknown"
    value = 1000 * value_mm
    return f"{value:.0f} um" if abs(value) >= 10 else f"{value:.1f} um"


def _rig_line(rig: Rig) -> str:
    fitted = int(rig.residuals.fitted.sum())
    return (
        f"{len(rig.cameras)} cameras, {fitted} image points fitted, model {rig.model}, "
        f"{rig.noise_px:.4f} px left"
    )


def _volume_line(rig: Rig) -> str:
    if rig.trust is None:
        return ""
    size = " x ".join(f"{side:.0f}" for side in rig.volume_mm[1] - rig.volume_mm[0])
    return f"{rig.trust} inside {size} mm"


def _result_lines(result: Result) -> list[tuple[str, object]]:
    if isinstance(result, AcceptanceReport):
        accuracy, scatter = result.accuracy, result.repeatability.pooled.std_mm
        share = result.coverage.share
        region = f" (95 % region holds {100 * share:.1f} %)" if np.isfinite(share) else ""
        rows: list[tuple[str, object]] = [
            ("Verified", f"{len(result.point)} positions, {_readings(result)} each{region}"),
            ("Accuracy", f"{_axes(accuracy.max_mm)} worst, {_axes(accuracy.rms_mm)} rms"),
            ("Repeatable", f"{_axes(scatter)} standard deviation"),
        ]
        if result.decision:
            rows.append(("Decision", result.decision))
        return [*rows, *(("Mind that", text) for text in result.reservations)]
    if isinstance(result, LengthCheck):
        rms, worst = micrometres(result.rms_mm), micrometres(result.max_mm)
        found = [("Lengths", f"{int(result.used.sum())}: rms {rms}, worst {worst}")]
        return [*found, *(("Mind that", text) for text in result.reservations)]
    if isinstance(result, HeightCheck):
        rms, worst = micrometres(result.rms_mm), micrometres(result.max_mm)
        single = f"single points {micrometres(result.points_median_mm)} (median)"
        found = [("Heights", f"{int(result.used.sum())}: rms {rms}, worst {worst}; {single}")]
        return [*found, *(("Mind that", text) for text in result.reservations)]
    return _control_lines(result)


def _readings(result: AcceptanceReport) -> str:
    low, high = int(result.count.min()), int(result.count.max())
    count = f"{high}" if low == high else f"{low} to {high}"
    return f"{count} reading{'' if high == 1 else 's'}"


def _control_lines(result: ControlCheck) -> list[tuple[str, object]]:
    rows: list[tuple[str, object]] = []
    for name, group in result.groups.items():
        if group.count:
            figures = f"{_axes(group.rms_mm)} rms, {_axes(group.max_mm)} worst"
            rows.append((name.capitalize(), f"{group.count} points: {figures}"))
    return rows


def _axes(values_mm: FloatArray) -> str:
    return " / ".join(micrometres(value).removesuffix(" um") for value in values_mm[:3]) + " um"


def flag_counts(flags: IntArray) -> dict[str, int]:
    """Count the rows that carry each flag."""
    counts = Counter(str(bit.name) for flag in flags for bit in Flag if bit in Flag(int(flag)))
    return dict(sorted(counts.items()))


def flags_text(flags: IntArray) -> str:
    """Say how many rows carry each flag."""
    return ", ".join(f"{count} {name}" for name, count in flag_counts(flags).items())


def _outliers(rig: Rig) -> list[str]:
    rows = rig.residuals
    return [
        "/".join(filter(None, (rows.camera[i], rows.placement[i], rows.point[i])))
        for i in np.flatnonzero(rows.flags & int(Flag.outlier))
    ]


def _rms(values: FloatArray) -> float:
    return float(np.sqrt(np.mean(values**2))) if len(values) else float("nan")


def _worst(values: Sequence[float] | FloatArray) -> float:
    return float(np.max(np.abs(values)))
