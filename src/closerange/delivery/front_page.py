"""The first page: the verdict in a sentence, one picture, one table of figures."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from closerange.delivery.excerpts import DECISIONS, TOO_SMALL, coverage_word, numbers
from closerange.delivery.layout3d import draw_layout, draw_values, paper_up
from closerange.delivery.overlays import draw_overlay
from closerange.delivery.sheet import Contents, Figure, Table
from closerange.delivery.volume_plots import draw_volume
from closerange.delivery.wording import (
    DASH,
    counted,
    fixed,
    micrometres,
    percent,
    printed,
    short_length,
    three_micrometres,
)
from closerange.geometry.arrays import FloatArray
from closerange.rig.rig import Rig

_TONES = {"accept": "good", "reject": "bad", "undecided": "warn"}
_TRUST_TONES = {"good": "good", "fair": "warn", "untrustworthy": "bad"}


@dataclass(frozen=True, slots=True)
class Verdict:
    """The sentence on top of the first page.

    Attributes
    ----------
    text : str
        One sentence.
    tone : str
        ``good``, ``warn``, ``bad`` or empty.
    """

    text: str
    tone: str = ""


def verdict(contents: Contents) -> Verdict:
    """Say in one sentence what to believe.

    Parameters
    ----------
    contents : Contents
        A `headline` replaces the sentence, not its tone.

    Returns
    -------
    Verdict
        From the strongest evidence there is: an acceptance test, control points, lengths, the
        calibration's own prediction, counts.
    """
    found = _from_checks(contents) or _from_rig(contents.rig) or _from_counts(contents)
    found = _with_coverage(found, contents)
    if contents.rig is not None and not contents.rig.trusted and found.tone != "bad":
        warning = "the calibration was accepted although untrustworthy"
        found = Verdict(f"Not to be relied upon, {warning}: {found.text}", "bad")
    text = contents.headline if contents.headline is not None else found.text
    return Verdict(printed(text), found.tone)


def figures_table(contents: Contents) -> Table | None:
    """Put the figures together, with uncertainty, limit and decision.

    Parameters
    ----------
    contents : Contents
        What is known.

    Returns
    -------
    Table or None
        None if nothing has a figure.
    """
    rows: list[tuple[str, ...]] = []
    for check in contents.checks_of("single-point"):
        rows += _of_job(_single_point_rows(check), check)
    for check in contents.checks_of("control"):
        rows += _of_job(_control_rows(check), check)
    for check in contents.checks_of("lengths"):
        rows += _of_job(_length_rows(check), check)
    if contents.rig is not None:
        rows += _rig_rows(contents.rig)
    if not rows:
        return None
    head = ("figure", "X", "Y", "Z", "unit", "uncertainty", "limit", "decision")
    bad = frozenset(i for i, row in enumerate(rows) if row[-1] in (DECISIONS["reject"], TOO_SMALL))
    return Table("Figures", head, rows, texts=frozenset({0, 4, 5, 6, 7}), marked=bad)


def front_picture(contents: Contents) -> Figure | None:
    """Choose the one picture in which the verdict is seen.

    Parameters
    ----------
    contents : Contents
        What is known.

    Returns
    -------
    Figure or None
        The predicted error in the volume; otherwise measured errors, predicted errors of
        positions, the rig, or a frame, whichever there is first.
    """
    if contents.error_map is not None:
        return Figure(
            draw_volume(contents.error_map),
            "The measuring volume with its predicted error as colour: three heights, drawn apart.",
        )
    for check in (*contents.checks_of("single-point"), *contents.checks_of("control")):
        return _error_picture(check, contents)
    positions = contents.positions
    if positions is not None and positions.measured.any():
        std = 1000 * np.sqrt(np.trace(positions.cov_mm2, axis1=1, axis2=2))
        label = "predicted error in space (one standard deviation) [µm]"
        return _cloud(positions.xyz_mm, std, label, "Measured positions", contents)
    if contents.rig is not None:
        return Figure(
            draw_layout(contents.rig), "The cameras and the measuring volume; axes in mm."
        )
    if contents.overlays:
        first = contents.overlays[0]
        name = first.file_name or f"the image of camera {first.camera}"
        return Figure(
            draw_overlay(replace(first, residual_px=first.residual_px * np.nan)),
            f"What was detected in {name}.",
        )
    return None


def _with_coverage(found: Verdict, contents: Contents) -> Verdict:
    """Say in the same sentence if the stated uncertainties do not hold."""
    for check in (*contents.checks_of("single-point"), *contents.checks_of("control")):
        coverage = check["coverage"]
        if check["kind"] == "control":
            coverage = coverage[_proving_group(check)[0]]
        if coverage_word(coverage) == TOO_SMALL:
            level, share = f"{100 * coverage['level']:.0f} %", float(numbers(coverage["share"]))
            text = (
                f"{found.text.removesuffix('.')}; but the stated uncertainties are too small: "
                f"{percent(share)} of the errors lie in their {level} region."
            )
            return Verdict(text, "bad" if found.tone == "bad" else "warn")
    return found


def _from_checks(contents: Contents) -> Verdict | None:
    for check in contents.checks_of("single-point"):
        return _single_point_verdict(check)
    for check in contents.checks_of("control"):
        name, label = _proving_group(check)
        group = check["groups"][name]
        error = three_micrometres(numbers(group["rms_mm"]))
        return Verdict(
            f"{counted(group['count'], label)}: rms error {error}.", _trust_tone(contents)
        )
    for check in contents.checks_of("lengths"):
        used = sum(check["rows"]["used"])
        rms, largest = (float(numbers(check[name])) for name in ("rms_mm", "max_mm"))
        text = (
            f"{counted(used, 'length')}: rms error {short_length(rms)}, "
            f"largest {short_length(largest)}."
        )
        return Verdict(text, _trust_tone(contents))
    return None


def _trust_tone(contents: Contents) -> str:
    """Figures without limits are neither good nor bad; the calibration behind them may be."""
    trust = contents.rig.trust if contents.rig is not None else None
    return _TRUST_TONES[trust.verdict] if trust is not None else ""


def _single_point_verdict(check: Mapping[str, Any]) -> Verdict:
    accuracy = three_micrometres(numbers(check["accuracy"]["max_mm"]))
    repeatability = three_micrometres(numbers(check["repeatability"]["pooled"]["std_mm"]))
    count = counted(len(check["rows"]["point"]), "position")
    figures = f"accuracy {accuracy}, repeatability {repeatability}, over {count}"
    decision = check["decision"]
    if decision == "accept":
        return Verdict(f"Accepted: {figures}; every figure is within its limit.", "good")
    if decision in ("reject", "undecided"):
        broken = [item for item in check["judgements"] if item["decision"] == decision]
        names = ", ".join(_against_limit(item) for item in broken)
        reason = names or "the readings carry a flag that forbids acceptance"
        return Verdict(f"{DECISIONS[decision].capitalize()}: {reason}.", _TONES[decision])
    return Verdict(f"{figures[0].upper()}{figures[1:]}; no limits were agreed.", "")


def _against_limit(item: Mapping[str, Any]) -> str:
    """Write one figure and its limit."""
    value, limit, guard = (float(numbers(item[name])) for name in ("value", "limit", "guard"))
    if item["unit"] == "mm":
        texts = [short_length(number) for number in (value, limit, guard)]
    else:
        texts = [f"{fixed(number, 3)} {item['unit']}" for number in (value, limit, guard)]
    near = f" with a guard band of {texts[2]}" if item["decision"] == "undecided" else ""
    return f"{item['name']} is {texts[0]}, the limit is {texts[1]}{near}"


def _from_rig(rig: Rig | None) -> Verdict | None:
    if rig is None or rig.trust is None:
        return None
    error = three_micrometres(rig.trust.predicted_mm)
    word = rig.trust.verdict.capitalize()
    return Verdict(
        f"{word} calibration: predicted error {error} inside the measuring volume.",
        _TRUST_TONES[rig.trust.verdict],
    )


def _from_counts(contents: Contents) -> Verdict:
    if contents.positions is not None:
        measured = int(contents.positions.measured.sum())
        flagged = int((contents.positions.flags != 0).sum())
        return Verdict(f"{counted(measured, 'position')} measured, {flagged} flagged.")
    if contents.points is not None:
        found = int(contents.points.found.sum())
        flagged = int((contents.points.flags != 0).sum())
        return Verdict(f"{found} of {len(contents.points)} points found, {flagged} flagged.")
    if contents.rig is not None:
        return Verdict(
            f"{counted(len(contents.rig.cameras), 'camera')} calibrated, not yet judged."
        )
    return Verdict("Nothing was measured.")


def _of_job(rows: list[tuple[str, ...]], check: Mapping[str, Any]) -> list[tuple[str, ...]]:
    """Add the name of the job to figures, where a result has one."""
    job = check.get("job")
    return [(f"{row[0]}, {job}", *row[1:]) for row in rows] if job else rows


def _single_point_rows(check: Mapping[str, Any]) -> list[tuple[str, ...]]:
    limits = check["limits"] or {}
    pooled = check["repeatability"]["pooled"]
    reference = float(numbers(check["reference_std_mm"]))
    spread = float(numbers(pooled["relative_uncertainty"]))
    rows = [
        (
            "Accuracy: largest error of a mean",
            *_three(check["accuracy"]["max_mm"]),
            "µm",
            f"±{micrometres(reference)} µm (reference)" if reference else "reference not stated",
            _limit(limits.get("accuracy_mm")),
            _decision(check, "accuracy"),
        ),
        (
            "Repeatability: standard deviation of a reading",
            *_three(pooled["std_mm"]),
            "µm",
            f"±{percent(spread)}" if np.isfinite(spread) else DASH,
            _limit(limits.get("repeatability_mm")),
            _decision(check, "repeatability"),
        ),
    ]
    cycle, longest = (
        float(numbers(value)) for value in (check["cycle_time_s"], limits.get("cycle_time_s"))
    )
    if np.isfinite(cycle) or np.isfinite(longest):
        limit = f"{fixed(longest, 3)} s" if np.isfinite(longest) else DASH
        decision = _decision(check, "cycle time")
        rows.append(("Cycle time", fixed(cycle, 3), "", "", "s", DASH, limit, decision))
    return rows + _coverage_rows(check["coverage"])


def _control_rows(check: Mapping[str, Any]) -> list[tuple[str, ...]]:
    name, label = _proving_group(check)
    group = check["groups"][name]
    count = max(int(group["count"]), 1)
    row = (
        f"Error of {counted(group['count'], label)} (rms)",
        *_three(group["rms_mm"]),
        "µm",
        f"±{percent(1 / np.sqrt(2 * count))}",
        DASH,
        DASH,
    )
    return [row, *_coverage_rows(check["coverage"][name])]


def _proving_group(check: Mapping[str, Any]) -> tuple[str, str]:
    """Prefer points that were not used for the calibration: only they prove anything."""
    group = check["groups"].get("check")
    if group is not None and group["count"]:
        return "check", "check point"
    return "all", "control point"


def _length_rows(check: Mapping[str, Any]) -> list[tuple[str, ...]]:
    used = max(sum(check["rows"]["used"]), 1)
    rms, largest = (micrometres(float(numbers(check[name]))) for name in ("rms_mm", "max_mm"))
    return [
        (f"Error of {counted(used, 'length')} (rms)", rms, "", "", "µm", DASH, DASH, DASH),
        ("Error of a length (largest)", largest, "", "", "µm", DASH, DASH, DASH),
    ]


def _coverage_rows(coverage: Mapping[str, Any]) -> list[tuple[str, ...]]:
    share, low, high = (float(numbers(coverage[name])) for name in ("share", "low", "high"))
    if not np.isfinite(share):
        return []
    level = f"{100 * coverage['level']:.0f} %"
    name = f"Errors inside their stated {level} region"
    spread = f"{fixed(100 * low, 1)} to {percent(high)}"
    word = coverage_word(coverage)
    return [(name, fixed(100 * share, 1), "", "", "%", spread, f"stated {level}", word)]


def _rig_rows(rig: Rig) -> list[tuple[str, ...]]:
    rows: list[tuple[str, ...]] = []
    if rig.trust is not None:
        predicted, part = rig.trust.predicted_mm, rig.trust.calibration_mm
        own = f"of which calibration {' / '.join(micrometres(float(v)) for v in part)} µm"
        word = f"calibration {rig.trust.verdict}"
        name = "Predicted error of one position (one standard deviation)"
        rows.append((name, *_three(predicted), "µm", own, DASH, word))
    relative = 1 / np.sqrt(2 * rig.dof) if rig.dof > 0 else np.nan
    spread = f"±{percent(float(relative))}" if rig.dof > 0 else DASH
    noise = fixed(rig.noise_px, 3)
    rows.append(("Image noise of one coordinate", noise, "", "", "px", spread, DASH, DASH))
    return rows


def _three(values_mm: Any) -> tuple[str, str, str]:
    x, y, z = (micrometres(float(value)) for value in numbers(values_mm)[:3])
    return x, y, z


def _limit(values_mm: Any) -> str:
    """Write the limits of X, Y and Z, once if they are equal."""
    if values_mm is None or not np.isfinite(numbers(values_mm)).any():
        return DASH
    texts: Sequence[str] = [micrometres(float(value)) for value in numbers(values_mm)]
    return f"{texts[0] if len(set(texts)) == 1 else ' / '.join(texts)} µm"


def _decision(check: Mapping[str, Any], name: str) -> str:
    """Combine the decisions on the axes of one figure."""
    found = {item["decision"] for item in check["judgements"] if item["name"].startswith(name)}
    for decision in ("reject", "undecided", "accept"):
        if decision in found:
            return DECISIONS[decision]
    return DASH


def _error_picture(check: Mapping[str, Any], contents: Contents) -> Figure:
    rows = check["rows"]
    place = numbers(rows["truth_mm" if "truth_mm" in rows else "original_mm"]).reshape(-1, 3)
    error = 1000 * np.linalg.norm(numbers(rows["error_mm"]).reshape(-1, 3), axis=1)
    return _cloud(place, error, "error in space [µm]", "Errors where they were found", contents)


def _cloud(
    xyz_mm: FloatArray, values_um: FloatArray, label: str, title: str, contents: Contents
) -> Figure:
    rig = contents.rig
    known = xyz_mm[np.isfinite(xyz_mm).all(axis=1)]
    own = np.stack([known.min(axis=0), known.max(axis=0)]) if len(known) else np.zeros((2, 3))
    volume = rig.volume_mm if rig is not None else own
    picture = draw_values(
        xyz_mm,
        values_um,
        volume_mm=volume,
        up=paper_up(rig.cameras, volume) if rig is not None else 1.0,
        label=label,
        title=title,
        description=f"{len(known)} points; the colour is the {label}",
    )
    box = "the measuring volume" if rig is not None else "the box around all points"
    return Figure(picture, f"{title}; colour: {label}; box: {box}; axes in mm.")
