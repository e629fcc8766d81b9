"""The first screen's four answers: what was measured, how accurate, may it be believed, why."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from statistics import NormalDist
from typing import Any, Literal

import numpy as np

from closerange.delivery.excerpts import TOO_SMALL, coverage_word, numbers, proving_group
from closerange.delivery.sheet import Contents, Terms
from closerange.delivery.wording import (
    TIMES,
    counted,
    fixed,
    percent,
    printed,
    short_length,
    three_micrometres,
)
from closerange.geometry.arrays import FloatArray
from closerange.rig.rig import Rig

LUCK = 0.01
"""Probability by chance below which the worst of several errors needs an explanation."""


@dataclass(frozen=True, slots=True)
class Reason:
    """Why the figures may be believed, or not.

    Attributes
    ----------
    text : str
        A clause without a full stop.
    weight : str
        ``for``; ``against``: the figures hold with reservations; ``forbids``: they do not hold;
        ``note``: worth knowing, and no reason for doubt.
    """

    text: str
    weight: Literal["for", "against", "forbids", "note"]


def answers(contents: Contents) -> Terms | None:
    """Answer what a reader of the first page asks.

    Parameters
    ----------
    contents : Contents
        What is known.

    Returns
    -------
    Terms or None
        Questions and answers; None where nothing was calibrated, measured or compared.
    """
    reasons = [*_from_rig(contents), *_from_checks(contents), *_from_rows(contents)]
    entries = [("What was measured", _what(contents)), ("How accurate", _how_accurate(contents))]
    if reasons:
        word = _believable(reasons, proved=bool(contents.checks))
        entries.append(("May it be believed", word))
        for question, weights in (
            ("Why", ("for",)),
            ("Why not", ("forbids", "against")),
            ("Mind that", ("note",)),
        ):
            texts = [reason.text for reason in reasons if reason.weight in weights]
            entries.append((question, "\n".join(f"{text[0].upper()}{text[1:]}." for text in texts)))
    told = tuple((question, answer) for question, answer in entries if answer)
    return Terms(told, style="answers") if told else None


def _believable(reasons: list[Reason], *, proved: bool) -> str:
    weights = {reason.weight for reason in reasons}
    if "forbids" in weights:
        return "No."
    if "against" in weights:
        return "With reservations."
    if not proved:
        return "As a prediction: it was not compared with known positions."
    return "Yes."


def _what(contents: Contents) -> str:
    """Name what was calibrated, measured and compared."""
    texts = []
    for check in contents.checks:
        count = len(check["rows"].get("flags", ()))
        if check["kind"] == "single-point":
            each = numbers(check["rows"]["count"])
            readings = _range(each) if each.size else "no"
            texts.append(f"{counted(count, 'known position')}, {readings} readings at each")
        elif check["kind"] == "control":
            texts.append(counted(count, "control point"))
    lengths = sum(len(check["rows"]["flags"]) for check in contents.checks_of("lengths"))
    texts += [counted(lengths, "known length")] if lengths else []
    heights = {
        (check["rows"]["placement"][row], part)
        for check in contents.checks_of("heights")
        for row, part in enumerate(check["rows"]["part"])
        if check["rows"]["used"][row]
    }
    texts += [counted(len(heights), "known height")] if heights else []
    if not texts and contents.positions:
        count = sum(len(positions) for positions in contents.positions.values())
        texts.append(counted(count, "position"))
    if contents.rig is not None:
        texts.append(_cameras(contents.rig, measured=bool(texts)))
    elif not texts and contents.points:
        count = sum(len(points) for points in contents.points.values())
        texts.append(counted(count, "image point"))
    return _sentence(texts)


def _cameras(rig: Rig, *, measured: bool) -> str:
    size = f" {TIMES} ".join(fixed(float(side), 0) for side in np.ptp(rig.volume_mm, axis=0))
    fitted = counted(int(np.asarray(rig.residuals.fitted).sum()), "image point")
    cameras = counted(len(rig.cameras), "camera")
    verb = "calibrated from" if measured else "were calibrated from"
    return (
        f"{'with ' if measured else ''}{cameras} {verb} {fitted}, in a measuring volume of "
        f"{size} mm"
    )


def _how_accurate(contents: Contents) -> str:
    """Say the errors found; the prediction where there is nothing else."""
    texts = []
    for check in contents.checks_of("single-point"):
        rms, largest = (numbers(check["accuracy"][name]) for name in ("rms_mm", "max_mm"))
        std = numbers(check["repeatability"]["pooled"]["std_mm"])
        texts += [_errors("position, mean of its readings", rms, largest)]
        texts += [f"One reading repeats to {three_micrometres(std)}, one standard deviation."]
    for check in contents.checks_of("control"):
        name, label = proving_group(check)
        group = check["groups"][name]
        texts.append(_errors(label, numbers(group["rms_mm"]), numbers(group["max_mm"])))
    used = [error for error, _ in _lengths(contents)]
    if used:
        largest_length = short_length(float(np.abs(used).max()))
        texts.append(f"Error of a length: at most {largest_length}.")
    for check in contents.checks_of("heights"):
        largest_height = short_length(float(numbers(check["max_mm"])))
        median = short_length(float(numbers(check["points_median_mm"])))
        job = f" ({check['job']})" if check.get("job") else ""
        several = any(count > 1 for count in check["rows"]["count"])
        single = f"; of a single point {median} (median)" if several else ""
        texts.append(f"Error of a height{job}: at most {largest_height}{single}.")
    trust = contents.rig.trust if contents.rig is not None else None
    if trust is not None and not texts:
        texts.append(f"Predicted standard deviation {three_micrometres(trust.predicted_mm)}.")
    return "\n".join(texts)


def _errors(what: str, rms_mm: FloatArray, max_mm: FloatArray) -> str:
    return (
        f"Error of a {what}: {three_micrometres(rms_mm)} rms, at most {three_micrometres(max_mm)}."
    )


def _from_rig(contents: Contents) -> Iterator[Reason]:
    trust = contents.rig.trust if contents.rig is not None else None
    if trust is None:
        return
    weights: dict[str, Literal["for", "against", "forbids"]] = {
        "good": "for",
        "fair": "against",
        "untrustworthy": "forbids",
    }
    weight = weights[trust.verdict]
    yield Reason(f"the calibration is {trust.verdict}", weight)
    for reason in trust.reasons:
        yield Reason(printed(reason).rstrip("."), "note" if weight == "for" else weight)


def _from_checks(contents: Contents) -> Iterator[Reason]:
    for check in (*contents.checks_of("single-point"), *contents.checks_of("control")):
        coverage = check["coverage"]
        if check["kind"] == "control":
            name = proving_group(check)[0]
            coverage = coverage[name]
            if name != "check":
                text = "no control point was kept out of the calibration; fitted ones fit too well"
                yield Reason(text, "against")
        yield from _from_coverage(coverage)
    yield from _from_lengths(contents)
    for check in contents.checks_of("single-point"):
        if check["limits"] is None:
            yield Reason("no limits were agreed: nothing was accepted or rejected", "note")
        count = len(check.get("deviations") or ())
        if count:
            text = f"the test differs from the procedure in {counted(count, 'point')}, listed there"
            yield Reason(text, "note")


def _from_coverage(coverage: Mapping[str, Any]) -> Iterator[Reason]:
    """Compare the errors found with those that were stated."""
    word = coverage_word(coverage)
    level = f"{100 * coverage['level']:.0f} %"
    share, high = (float(numbers(coverage[name])) for name in ("share", "high"))
    found = (
        f"{coverage['inside']} of {coverage['count']} errors ({percent(share)}) lie inside their "
        f"stated {level} region"
    )
    if word == TOO_SMALL:
        yield Reason(f"the stated uncertainties are too small: only {found}", "against")
    elif high < coverage["level"]:
        text = f"{found}: somewhat few, as the luck of a single calibration can explain"
        yield Reason(text, "note")
    elif np.isfinite(share):
        yield Reason(f"{found}: the stated uncertainties hold", "for")


def _from_lengths(contents: Contents) -> Iterator[Reason]:
    ratios = [abs(error / std) for error, std in _lengths(contents) if std > 0]
    if not ratios:
        return
    limit = NormalDist().inv_cdf(1 - LUCK / 2 / len(ratios))
    far = sum(ratio > limit for ratio in ratios)
    largest = f"the largest error is {fixed(max(ratios), 1)} predicted standard deviations"
    if far:
        yield Reason(
            f"{far} of {counted(len(ratios), 'length')} off by more than chance explains: "
            f"{largest}, the worst of so many should stay below {fixed(limit, 1)}",
            "against",
        )
    else:
        yield Reason(f"the lengths agree with their prediction: {largest}", "for")


def _from_rows(contents: Contents) -> Iterator[Reason]:
    """Count what is defective or missing."""
    # of a matched scene points are left out by the thousand, and are meant to be
    flags = [
        positions.flags
        for job, positions in contents.positions.items()
        if len(positions) and job not in contents.matches
    ]
    if flags:
        flagged = int((np.concatenate(flags) != 0).sum())
        total = sum(len(each) for each in flags)
        if flagged:
            text = f"{flagged} of {counted(total, 'measured position')} carry a flag (see Flags)"
            yield Reason(text, "against")
        else:
            yield Reason(f"no flag on any of {counted(total, 'measured position')}", "for")
    for job, matches in contents.matches.items():
        kept, of_job = int(matches.clean.sum()), f" of job {job}" if job else ""
        if kept < len(matches):
            text = f"{kept} of {counted(len(matches), 'matched point')}{of_job} carry no flag; only"
            yield Reason(f"{text} these are used", "note")
    reserved = [text for check in contents.checks for text in check.get("reservations") or ()]
    yield from (Reason(text, "against") for text in dict.fromkeys(reserved))
    others = [check for check in contents.checks if not check.get("reservations")]
    for name, what in (
        ("missing", "without a counterpart"),
        ("left_out", "left out of the comparison"),
    ):
        count = sum(len(check.get(name) or ()) for check in others)
        if count:
            yield Reason(f"{counted(count, 'row')} {what}", "against")
    if contents.notes:
        yield Reason(f"there {_is(len(contents.notes), 'warning')}, listed below", "note")


def _lengths(contents: Contents) -> list[tuple[float, float]]:
    """Return error and predicted standard deviation of the lengths that count, mm."""
    found = []
    for check in contents.checks_of("lengths"):
        rows = check["rows"]
        columns = (numbers(rows[name]) for name in ("error_mm", "predicted_std_mm"))
        for error, std, used in zip(*columns, rows["used"], strict=True):
            if used and np.isfinite(error):
                found.append((float(error), float(std)))
    return found


def _range(values: Any) -> str:
    low, high = int(values.min()), int(values.max())
    return str(high) if low == high else f"{low} to {high}"


def _is(count: int, noun: str) -> str:
    return f"{'is' if count == 1 else 'are'} {counted(count, noun)}"


def _sentence(texts: list[str]) -> str:
    """Join clauses to a sentence."""
    text = "; ".join(texts)
    return f"{text[0].upper()}{text[1:]}." if text else ""
