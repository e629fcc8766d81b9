"""The first page: the verdict in a sentence, and the one picture in which it is seen."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from closerange.delivery.excerpts import (
    DECISIONS,
    TOO_SMALL,
    coverage_word,
    numbers,
    proving_group,
)
from closerange.delivery.layout3d import draw_layout, draw_values, paper_up
from closerange.delivery.overlays import draw_overlay
from closerange.delivery.sheet import Contents, Figure
from closerange.delivery.volume_plots import draw_volume
from closerange.delivery.wording import (
    counted,
    fixed,
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
    measured = [each for each in contents.positions.values() if each.measured.any()]
    if measured:
        std = [np.sqrt(np.trace(each.cov_mm2, axis1=1, axis2=2)) for each in measured]
        xyz = np.concatenate([each.xyz_mm for each in measured])
        label = "predicted error in space (one standard deviation) [µm]"
        return _cloud(xyz, 1000 * np.concatenate(std), label, "Measured positions", contents)
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
            coverage = coverage[proving_group(check)[0]]
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
        name, label = proving_group(check)
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
            f"largest {short_length(largest)}"
        )
        return _reserved(text, check, _trust_tone(contents))
    for check in contents.checks_of("heights"):
        rms, largest = (float(numbers(check[name])) for name in ("rms_mm", "max_mm"))
        text = (
            f"{counted(sum(check['rows']['used']), 'height')}: rms error {short_length(rms)}, "
            f"largest {short_length(largest)}"
        )
        return _reserved(text, check, _trust_tone(contents))
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
        reasons = [", ".join(_against_limit(item) for item in broken)] if broken else []
        reasons += check.get("reservations") or () if decision == "undecided" else ()
        reason = "; ".join(reasons) or "the readings carry a flag that forbids acceptance"
        return Verdict(f"{DECISIONS[decision].capitalize()}: {reason}.", _TONES[decision])
    return _reserved(f"{figures[0].upper()}{figures[1:]}; no limits were agreed", check, "")


def _reserved(text: str, check: Mapping[str, Any], tone: str) -> Verdict:
    """Add to a sentence what was not compared; the rest being good says nothing about it."""
    reservations = check.get("reservations") or ()
    if not reservations:
        return Verdict(f"{text}.", tone)
    return Verdict(f"{text}; but {'; '.join(reservations)}.", "bad" if tone == "bad" else "warn")


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
    if contents.positions:
        measured = sum(int(each.measured.sum()) for each in contents.positions.values())
        flagged = sum(int((each.flags != 0).sum()) for each in contents.positions.values())
        return Verdict(f"{counted(measured, 'position')} measured, {flagged} flagged.")
    if contents.points:
        total = sum(len(each) for each in contents.points.values())
        found = sum(int(each.found.sum()) for each in contents.points.values())
        flagged = sum(int((each.flags != 0).sum()) for each in contents.points.values())
        return Verdict(f"{found} of {total} points found, {flagged} flagged.")
    if contents.rig is not None:
        return Verdict(
            f"{counted(len(contents.rig.cameras), 'camera')} calibrated, not yet judged."
        )
    return Verdict("Nothing was measured.")


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
