"""Sections on verification: control points and lengths; one for each result."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any

import numpy as np

from closerange.delivery.excerpts import four, left_out, listed, numbers, shown
from closerange.delivery.heights_section import height_blocks
from closerange.delivery.plots import Level, Panel, panel_grid
from closerange.delivery.sheet import Block, Figure, Paragraph, Section, Table
from closerange.delivery.single_point_section import single_point_blocks
from closerange.delivery.svg import AXIS_COLOURS, VERMILION
from closerange.delivery.wording import (
    DASH,
    counted,
    fixed,
    micrometres,
    mm,
    percent,
)

_GROUPS = {
    "all": "all",
    "fitted": "fitted: used for the calibration",
    "check": "check: not used for the calibration",
    "inside": "inside the calibrated block",
    "outside": "outside the calibrated block",
}


def check_sections(checks: Iterable[Mapping[str, Any]]) -> list[Section]:
    """Write one section for each verification result.

    Parameters
    ----------
    checks : iterable of mapping
        Documents with a ``kind``; unknown kinds are left out.

    Returns
    -------
    list of Section
        In the order given.
    """
    writers = {
        "single-point": single_point_blocks,
        "control": _control,
        "lengths": _lengths,
        "heights": height_blocks,
    }
    sections = []
    for number, check in enumerate(checks, start=1):
        writer = writers.get(str(check.get("kind")))
        if writer is not None:
            title, blocks = writer(check)
            job = f": {check['job']}" if check.get("job") not in (None, check["kind"]) else ""
            sections.append(Section(f"check-{number}", title + job, tuple(blocks)))
    return sections


def _control(check: Mapping[str, Any]) -> tuple[str, list[Block]]:
    rows = check["rows"]
    groups = {name: group for name, group in check["groups"].items() if group["count"]}
    count = counted(len(rows["point"]), "measured position")
    text = (
        f"{count} were compared with the known positions of control points. Errors are calculated "
        "minus original. Points that took part in the calibration fit too well by their nature; "
        "only check points prove the accuracy."
    )
    head = ("group", "points", *(f"{axis} [µm]" for axis in "XYZ"), "in space [µm]")
    blocks: list[Block] = [Paragraph(text)]
    for name, caption in (
        ("mean_abs_mm", "Mean absolute error"),
        ("rms_mm", "Rms error"),
        ("max_mm", "Largest absolute error"),
    ):
        cells = [
            (_GROUPS.get(key, key), str(group["count"]), *four(group[name]))
            for key, group in groups.items()
        ]
        blocks.append(Table(caption, head, cells))
    blocks.append(_regions(check["coverage"], groups))
    blocks += _control_figures(rows)
    blocks += _systematic(check["systematic"])
    blocks += left_out(check)
    if check.get("not_measured"):
        names = listed(" ".join(filter(None, item)) for item in check["not_measured"])
        blocks.append(Paragraph(f"Control points without a measured position: {names}."))
    blocks.append(_control_rows(rows))
    return "Control points", blocks


def _regions(coverage: Mapping[str, Any], groups: Iterable[str]) -> Table:
    """Say for each group how many errors lie inside their stated regions."""
    rows = []
    for key in groups:
        found = coverage[key]
        share, low, high, ratio = (
            float(numbers(found[name])) for name in ("share", "low", "high", "mean_ratio")
        )
        rows.append(
            (
                _GROUPS.get(key, key),
                f"{found['inside']} of {found['count']}",
                percent(share),
                f"{percent(low)} to {percent(high)}" if np.isfinite(share) else DASH,
                fixed(ratio, 2),
            )
        )
    level = f"{100 * coverage['all']['level']:.0f} %"
    head = (
        *("group", "errors inside", "share [%]", "true share between [%]"),
        "mean squared error / predicted",
    )
    caption = f"Errors inside their stated {level} region ({level} and a ratio of 1 are right)"
    return Table(caption, head, rows)


def _control_figures(rows: Mapping[str, Any]) -> list[Block]:
    original = numbers(rows["original_mm"]).reshape(-1, 3)
    error = 1000 * numbers(rows["error_mm"]).reshape(-1, 3)
    panels = [
        Panel(
            x=original[:, j],
            y=error[:, i],
            x_label=f"{along} [mm]",
            y_label=f"error of {axis} [µm]",
            title=f"{axis} error over {along}",
            colour=AXIS_COLOURS[i],
            levels=(Level(0.0, ""),),
        )
        for i, axis in enumerate("XYZ")
        for j, along in enumerate("XYZ")
    ]
    caption = "Error of each axis (calculated minus original) against each coordinate."
    title = "Control points: error against position"
    picture = panel_grid(panels, columns=3, height=148, title=title, description=caption)
    return [Figure(picture, caption)]


def _systematic(found: Mapping[str, Any]) -> list[Block]:
    if not found["point"]:
        return []
    mean, std = (1000 * numbers(found[name]) for name in ("mean_mm", "std_mm"))
    cells = [
        (
            point,
            str(count),
            *(f"{fixed(m, 1)} ± {fixed(s, 1)}" for m, s in zip(mean[i], std[i], strict=True)),
        )
        for i, (point, count) in enumerate(zip(found["point"], found["count"], strict=True))
    ]
    share = [percent(float(value)) for value in numbers(found["repeated_share"])]
    chance = percent(float(numbers(found["chance_share"])))
    text = (
        f"Errors that repeat for the same point in every placement make up {share[0]} (X) "
        f"{share[1]} (Y) {share[2]} (Z) of the squared errors; random errors would show {chance}. "
        "A much larger share means that the target is not as stated, or the lens model is too poor."
    )
    head = ("point", "placements", *(f"mean error {axis} [µm]" for axis in "XYZ"))
    return [Paragraph(text), shown(cells, "Mean error of each point (± scatter)", head)]


def _control_rows(rows: Mapping[str, Any]) -> Table:
    original, calculated = (
        numbers(rows[name]).reshape(-1, 3) for name in ("original_mm", "calculated_mm")
    )
    error = 1000 * numbers(rows["error_mm"]).reshape(-1, 3)
    cells = [
        (
            placement,
            point,
            role,
            "inside" if inside else "outside",
            *map(mm, original[i]),
            *map(mm, calculated[i]),
            *(fixed(value, 1) for value in error[i]),
            flags.replace("|", ", "),
        )
        for i, (placement, point, role, inside, flags) in enumerate(
            zip(
                *(rows[name] for name in ("placement", "point", "role", "inside", "flags")),
                strict=True,
            )
        )
    ]
    head = (
        *("placement", "point", "role", "block"),
        *(f"original {axis} [mm]" for axis in "XYZ"),
        *(f"calculated {axis} [mm]" for axis in "XYZ"),
        *(f"error {axis} [µm]" for axis in "XYZ"),
        "flags",
    )
    marked = frozenset(i for i, used in enumerate(rows["used"]) if not used)
    texts = frozenset({0, 1, 2, 3, len(head) - 1})
    caption = "Original, calculated, error; marked rows are not averaged"
    return shown(cells, caption, head, texts=texts, marked=marked, wide=True)


def _lengths(check: Mapping[str, Any]) -> tuple[str, list[Block]]:
    rows = check["rows"]
    true, error = numbers(rows["true_mm"]), 1000 * numbers(rows["error_mm"])
    bias, rms, largest = (
        micrometres(float(numbers(check[name]))) for name in ("bias_mm", "rms_mm", "max_mm")
    )
    ratio = fixed(float(numbers(check.get("ratio"))), 2)
    text = (
        f"Distances between measured points were compared with {counted(len(true), 'known length')}"
        f". Errors are measured minus known: mean {bias} µm, rms {rms} µm, largest {largest} µm. "
        f"Rms of error / predicted standard deviation: {ratio} (1 if the prediction holds; the "
        "correlation between the two ends is ignored, which overstates it for short lengths)."
    )
    panel = Panel(
        x=np.arange(1.0, len(true) + 1),
        y=error,
        spread=2000 * numbers(rows["predicted_std_mm"]),
        x_label="number of the length",
        y_label="error [µm]",
        title="Error of each length and two predicted standard deviations",
        colour=VERMILION,
        levels=(Level(0.0, ""),),
    )
    caption = (
        "Error of each length (measured minus known) in the order of the table; bars reach two "
        "predicted standard deviations up and down."
    )
    picture = panel_grid([panel], columns=1, height=150, title="Lengths", description=caption)
    blocks: list[Block] = [Paragraph(text), Figure(picture, caption), _length_rows(rows)]
    return "Lengths", blocks + left_out(check)


def _length_rows(rows: Mapping[str, Any]) -> Table:
    true, measured = (numbers(rows[name]) for name in ("true_mm", "measured_mm"))
    error, predicted = (1000 * numbers(rows[name]) for name in ("error_mm", "predicted_std_mm"))
    names = ("placement", "reading", "point_a", "point_b")
    cells = [
        (
            *keys,
            mm(true[i]),
            mm(measured[i]),
            fixed(error[i], 1),
            fixed(predicted[i], 1),
            rows["flags"][i].replace("|", ", "),
        )
        for i, keys in enumerate(zip(*(rows[name] for name in names), strict=True))
    ]
    head = (
        *("placement", "reading", "from", "to", "known [mm]", "measured [mm]"),
        *("error [µm]", "predicted std [µm]", "flags"),
    )
    marked = frozenset(i for i, used in enumerate(rows["used"]) if not used)
    texts = frozenset({0, 1, 2, 3, len(head) - 1})
    title = "All lengths; marked rows are not averaged"
    return shown(cells, title, head, texts=texts, marked=marked, wide=True)
