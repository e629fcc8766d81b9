"""The first page's table: every figure with its uncertainty, limit and judgement."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from closerange.delivery.excerpts import (
    DECISIONS,
    TOO_SMALL,
    coverage_word,
    numbers,
    proving_group,
)
from closerange.delivery.sheet import Contents, Table
from closerange.delivery.wording import (
    DASH,
    counted,
    fixed,
    micrometres,
    percent,
    significant,
)
from closerange.rig.rig import Rig


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
    for kind, rows_of in (
        ("single-point", _single_point_rows),
        ("control", _control_rows),
        ("lengths", _length_rows),
        ("heights", _height_rows),
    ):
        checks = contents.checks_of(kind)
        for check in checks:
            rows += _of_job(rows_of(check), check, several=len(checks) > 1)
    if contents.rig is not None:
        rows += _rig_rows(contents.rig)
    if not rows:
        return None
    head: tuple[str, ...] = (
        "figure",
        "X",
        "Y",
        "Z",
        "overall",
        "unit",
        "uncertainty",
        "limit",
        "judgement",
    )
    bad = frozenset(i for i, row in enumerate(rows) if row[-1] in (DECISIONS["reject"], TOO_SMALL))
    if all(row[7] == DASH for row in rows):  # no limits were agreed
        head = (*head[:7], head[8])
        rows = [(*row[:7], row[8]) for row in rows]
    texts = frozenset({0, *range(5, len(head))})
    return Table("Figures; overall: of all axes together, in space", head, rows, texts, marked=bad)


def _of_job(
    rows: list[tuple[str, ...]], check: Mapping[str, Any], *, several: bool
) -> list[tuple[str, ...]]:
    """Add the name of the job to figures, where it tells them from those of another job."""
    job = check.get("job")
    return [(f"{row[0]}, {job}", *row[1:]) for row in rows] if job and several else rows


def _single_point_rows(check: Mapping[str, Any]) -> list[tuple[str, ...]]:
    limits = check["limits"] or {}
    pooled = check["repeatability"]["pooled"]
    reference = float(numbers(check["reference_std_mm"]))
    spread = float(numbers(pooled["relative_uncertainty"]))
    rows = [
        (
            "Accuracy: largest error of a mean",
            *_four(check["accuracy"]["max_mm"]),
            "µm",
            f"±{micrometres(reference)} µm of the reference"
            if reference
            else "reference taken as exact",
            _limit(limits.get("accuracy_mm")),
            _decision(check, "accuracy"),
        ),
        (
            "Repeatability: standard deviation of a reading",
            *_four(pooled["std_mm"]),
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
        rows.append(("Cycle time", "", "", "", fixed(cycle, 3), "s", DASH, limit, decision))
    return rows + _coverage_rows(check["coverage"])


def _control_rows(check: Mapping[str, Any]) -> list[tuple[str, ...]]:
    name, label = proving_group(check)
    group = check["groups"][name]
    count = max(int(group["count"]), 1)
    row = (
        f"Error of {counted(group['count'], label)} (rms)",
        *_four(group["rms_mm"]),
        "µm",
        f"±{percent(1 / np.sqrt(2 * count))}",
        DASH,
        DASH,
    )
    return [row, *_coverage_rows(check["coverage"][name])]


def _length_rows(check: Mapping[str, Any]) -> list[tuple[str, ...]]:
    used = max(sum(check["rows"]["used"]), 1)
    rms, largest = (micrometres(float(numbers(check[name]))) for name in ("rms_mm", "max_mm"))
    return [
        (f"Error of {counted(used, 'length')} (rms)", "", "", "", rms, "µm", DASH, DASH, DASH),
        ("Error of a length (largest)", "", "", "", largest, "µm", DASH, DASH, DASH),
    ]


def _height_rows(check: Mapping[str, Any]) -> list[tuple[str, ...]]:
    rows = check["rows"]
    used = sum(rows["used"])
    points = sum(count for count, use in zip(rows["count"], rows["used"], strict=True) if use)
    rms, largest = (micrometres(float(numbers(check[name]))) for name in ("rms_mm", "max_mm"))
    median = micrometres(float(numbers(check["points_median_mm"])))
    single = f"Error of {counted(points, 'point')} on tops (median)"
    found: list[tuple[str, ...]] = [
        (f"Error of {counted(used, 'height')} (rms)", "", "", "", rms, "µm", DASH, DASH, DASH),
        ("Error of a height (largest)", "", "", "", largest, "µm", DASH, DASH, DASH),
    ]
    return (
        [*found, (single, "", "", median, "", "µm", DASH, DASH, DASH)] if points > used else found
    )


def _coverage_rows(coverage: Mapping[str, Any]) -> list[tuple[str, ...]]:
    share, low, high = (float(numbers(coverage[name])) for name in ("share", "low", "high"))
    if not np.isfinite(share):
        return []
    level = f"{100 * coverage['level']:.0f} %"
    name = f"Errors inside their stated {level} region"
    spread = f"{fixed(100 * low, 1)} to {percent(high)}"
    word = coverage_word(coverage)
    return [(name, "", "", "", fixed(100 * share, 1), "%", spread, DASH, word)]


def _rig_rows(rig: Rig) -> list[tuple[str, ...]]:
    rows: list[tuple[str, ...]] = []
    if rig.trust is not None:
        predicted, part = rig.trust.predicted_mm, rig.trust.calibration_mm
        for name, values, word in (
            ("Predicted error of one position", predicted, rig.trust.verdict),
            ("of it from the calibration, never averaged away", part, DASH),
        ):
            total = float(np.sqrt(np.sum(numbers(values)[:3] ** 2)))
            rows.append((name, *_four([*values[:3], total]), "µm", DASH, DASH, word))
    relative = 1 / np.sqrt(2 * rig.dof) if rig.dof > 0 else np.nan
    spread = f"±{percent(float(relative))}" if rig.dof > 0 else DASH
    noise = significant(rig.noise_px, 2)
    rows.append(("Image noise of one coordinate", "", "", "", noise, "px", spread, DASH, DASH))
    return rows


def _four(values_mm: Any) -> list[str]:
    """Write X, Y, Z and, where it is known, the figure in space; blank where it is not."""
    texts = [micrometres(float(value)) for value in numbers(values_mm)[:4]]
    return texts + [""] * (4 - len(texts))


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
