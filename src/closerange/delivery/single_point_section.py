"""The section on a single-point test, with the plots of the thesis' chapter 3."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from closerange.delivery.excerpts import (
    DECISIONS,
    coverage_text,
    four,
    left_out,
    listed,
    numbers,
    shown,
)
from closerange.delivery.plots import Level, Panel, axis_panels, panel_grid
from closerange.delivery.sheet import Block, Figure, Paragraph, Table, Terms
from closerange.delivery.svg import AXIS_COLOURS
from closerange.delivery.wording import counted, fixed, micrometres, mm, significant
from closerange.geometry.arrays import FloatArray


def single_point_blocks(check: Mapping[str, Any]) -> tuple[str, list[Block]]:
    """Write title and content of the section.

    Parameters
    ----------
    check : mapping
        Document of an `AcceptanceReport`.

    Returns
    -------
    tuple of str and list of Block
        Title and blocks.
    """
    rows = check["rows"]
    count = numbers(rows["count"])
    blocks: list[Block] = [
        Paragraph(
            f"A target was measured at {counted(len(rows['point']), 'known position')}, "
            f"{_range(count)} readings at each. Errors are actual position minus mean of the "
            "readings; the standard deviation is that of the readings about their mean. The test "
            "follows A15.05, the single-point test of the Automated Vision Association."
        )
    ]
    blocks += _judgements(check)
    blocks.append(_figures_of_merit(check))
    blocks += _sample_figures(check)
    blocks += _position_dependence(check)
    blocks.append(_expected_and_found(check))
    if check.get("deviations"):
        text = "Deviations from the procedure: " + "; ".join(check["deviations"]) + "."
        blocks.append(Paragraph(text))
    blocks += left_out(check)
    if check.get("not_measured"):
        names = listed(" ".join(filter(None, item)) for item in check["not_measured"])
        blocks.append(Paragraph(f"Actual positions without a usable reading: {names}.", "warn"))
    blocks.append(_position_rows(rows))
    return "Single-point test", blocks


def _judgements(check: Mapping[str, Any]) -> list[Block]:
    rows = []
    for item in check["judgements"]:
        value, limit, guard = (float(numbers(item[name])) for name in ("value", "limit", "guard"))
        if item["unit"] == "mm":
            cells = [micrometres(value), micrometres(limit), micrometres(guard), "µm"]
        else:
            cells = [fixed(value, 3), fixed(limit, 3), fixed(guard, 3), str(item["unit"])]
        rows.append([str(item["name"]), *cells, DECISIONS[item["decision"]]])
    if not rows:
        return [Paragraph("No limits were agreed, hence there is no decision.")]
    bad = frozenset(i for i, row in enumerate(rows) if row[-1] == DECISIONS["reject"])
    head = ("figure", "found", "limit", "guard band", "unit", "decision")
    level = fixed(100 * float((check["limits"] or {}).get("confidence", 0.95)), 0)
    text = (
        "A figure is accepted if it stays below its limit by the guard band, rejected if it "
        f"exceeds it by the guard band, and undecided in between (ISO 14253-1, {level} %). Nothing "
        "is accepted while a reading or an actual position is missing from the comparison."
    )
    table = Table(
        "Figures against their limits", head, rows, texts=frozenset({0, 4, 5}), marked=bad
    )
    return [table, Paragraph(text)]


def _figures_of_merit(check: Mapping[str, Any]) -> Table:
    accuracy, repeatability = check["accuracy"], check["repeatability"]
    figures = [
        ("mean error (bias)", accuracy["bias_mm"]),
        ("lowest error", accuracy["lowest_mm"]),
        ("highest error", accuracy["highest_mm"]),
        ("half width of the error envelope", accuracy["half_range_mm"]),
        ("mean absolute error", accuracy["mean_abs_mm"]),
        ("rms error", accuracy["rms_mm"]),
        ("95 % of absolute errors are below", accuracy["p95_mm"]),
        ("accuracy: largest absolute error", accuracy["max_mm"]),
        ("repeatability: pooled standard deviation", repeatability["pooled"]["std_mm"]),
        ("largest standard deviation of a position", repeatability["worst_std_mm"]),
        ("largest range (max - min) of a position", repeatability["largest_range_mm"]),
    ]
    return Table(
        f"Accuracy and repeatability of {counted(accuracy['count'], 'position')}",
        ("figure", "X [µm]", "Y [µm]", "Z [µm]", "in space [µm]"),
        [(name, *four(values)) for name, values in figures],
    )


def _sample_figures(check: Mapping[str, Any]) -> list[Block]:
    rows, limits = check["rows"], check["limits"] or {}
    std, mean, error = (
        numbers(rows[name]).reshape(-1, 3) for name in ("std_mm", "mean_mm", "error_mm")
    )
    pooled = 1000 * numbers(check["repeatability"]["pooled"]["std_mm"])
    std_limit = 1000 * numbers(limits.get("repeatability_mm") or [None] * 3)
    limit = 1000 * numbers(limits.get("accuracy_mm") or [None] * 3)
    low, high = (1000 * numbers(check["accuracy"][name]) for name in ("lowest_mm", "highest_mm"))
    std_levels = [
        (Level(pooled[i], "pooled"), Level(std_limit[i], "limit", dashed=True)) for i in range(3)
    ]
    error_levels = [
        (
            Level(high[i], "highest"),
            Level(low[i], "lowest"),
            Level(limit[i], "limit", dashed=True),
            Level(-limit[i], "limit", dashed=True),
        )
        for i in range(3)
    ]
    return [
        _by_number(
            1000 * std,
            ("standard deviation of the readings", "µm"),
            "Standard deviation of the readings about their mean, for each position.",
            levels=std_levels,
            mark="stem",
        ),
        _by_number(mean, ("mean of the readings", "mm"), "Mean of the readings.", mark="dot"),
        _by_number(
            1000 * error,
            ("error: actual minus mean", "µm"),
            "Error, for each position: actual minus mean of the readings.",
            levels=error_levels,
            mark="stem",
        ),
    ]


def _by_number(
    values: FloatArray,
    names: tuple[str, str],
    caption: str,
    *,
    levels: Sequence[Sequence[Level]] = ((), (), ()),
    mark: str,
) -> Figure:
    """Draw values of X, Y, Z against the number of the position."""
    panels = axis_panels(
        values,
        unit=names[1],
        quantity=names[0],
        x_label="number of the position",
        levels=levels,
        mark=mark,
        zero=mark == "stem",
    )
    picture = panel_grid(panels, columns=1, height=108, title=names[0], description=caption)
    return Figure(picture, caption)


def _position_dependence(check: Mapping[str, Any]) -> list[Block]:
    rows, slopes = check["rows"], check["slopes"]
    truth, error = (numbers(rows[name]).reshape(-1, 3) for name in ("truth_mm", "error_mm"))
    slope, std, p_value = (numbers(slopes[name]) for name in ("slope", "std", "p_value"))
    middle_error, middle = _mean(1000 * error), _mean(truth)
    panels, cells = [], []
    for i, axis in enumerate("XYZ"):
        # the fit is linear in all coordinates together and passes through the means
        offset = middle_error[i] - 1000 * slope[i] * middle
        for j, along in enumerate("XYZ"):
            trend = (float(offset[j]), float(1000 * slope[i, j]))
            clear = p_value[i, j] < 0.01 / 9  # nine slopes are tested together at 1 %
            panels.append(
                Panel(
                    x=truth[:, j],
                    y=1000 * error[:, i],
                    x_label=f"{along} [mm]",
                    y_label=f"error of {axis} [µm]",
                    title=f"{axis} error over {along}" + (" *" if clear else ""),
                    colour=AXIS_COLOURS[i],
                    trend=trend if np.isfinite(trend).all() else None,
                )
            )
            if np.isfinite(slope[i, j]):
                sloped = f"{fixed(1000 * slope[i, j], 3)} ± {fixed(1000 * std[i, j], 3)}"
                word = "yes" if clear else "no"
                cells.append((f"{axis} over {along}", sloped, significant(p_value[i, j], 2), word))
    picture = panel_grid(
        panels,
        columns=3,
        height=148,
        title="Error of each axis against each coordinate",
        description="Nine plots with straight lines of the common linear fit",
    )
    caption = (
        "Error of each axis (actual minus mean) against each coordinate, with the line of the "
        "linear fit by all three coordinates together. * = a slope that chance hardly explains."
    )
    return [Figure(picture, caption), *_slope_table(cells)]


def _slope_table(cells: Sequence[Sequence[str]]) -> list[Block]:
    head = ("error", "slope [µm per mm]", "probability by chance", "depends")
    title = "How errors depend on the position (slope ± standard error)"
    return [Table(title, head, cells, texts=frozenset({0, 3}))] if cells else []


def _expected_and_found(check: Mapping[str, Any]) -> Terms:
    luck, coverage, prediction = check["luck"], check["coverage"], check["prediction"]
    pooled = numbers(check["repeatability"]["pooled"]["std_mm"])
    worst = numbers(check["repeatability"]["worst_std_mm"])
    with np.errstate(invalid="ignore", divide="ignore"):
        ratio = [fixed(float(value), 2) for value in worst / pooled]
    half_range = fixed(float(numbers(luck["half_range"])), 2)
    worst_std = (
        f"{ratio[0]} (X) {ratio[1]} (Y) {ratio[2]} (Z) times the pooled one. By chance alone the "
        f"worst of so many is {_luck(luck['worst_std'])} times."
    )
    worst_error = (
        f"By chance alone the worst of so many errors is {_luck(luck['worst_error'])} standard "
        f"deviations, and half the width of the envelope {half_range}."
    )
    source = (
        "predicted from image noise"
        if prediction["noise_stated"]
        else "predicted for all errors of a reading together, hence below 1"
    )
    predicted = (
        f"rms error of the means {_ratios(prediction['accuracy_ratio'])}; "
        f"repeatability {_ratios(prediction['repeatability_ratio'])}, {source}."
    )
    entries = (
        ("Worst standard deviation", worst_std),
        ("Worst error", worst_error),
        ("Stated regions", coverage_text(coverage)),
        ("Observed / predicted", predicted),
    )
    return Terms(entries)


def _position_rows(rows: Mapping[str, Any]) -> Table:
    truth, mean = (numbers(rows[name]).reshape(-1, 3) for name in ("truth_mm", "mean_mm"))
    error, std = (1000 * numbers(rows[name]).reshape(-1, 3) for name in ("error_mm", "std_mm"))
    cells = [
        (
            placement,
            point,
            fixed(count, 0),
            *map(mm, truth[i]),
            *map(mm, mean[i]),
            *(fixed(value, 1) for value in error[i]),
            *(fixed(value, 1) for value in std[i]),
            flags.replace("|", ", "),
        )
        for i, (placement, point, count, flags) in enumerate(
            zip(*(rows[name] for name in ("placement", "point", "count", "flags")), strict=True)
        )
    ]
    head = (
        "placement",
        "point",
        "readings",
        *(f"actual {axis} [mm]" for axis in "XYZ"),
        *(f"mean {axis} [mm]" for axis in "XYZ"),
        *(f"error {axis} [µm]" for axis in "XYZ"),
        *(f"std {axis} [µm]" for axis in "XYZ"),
        "flags",
    )
    marked = frozenset(i for i, row in enumerate(cells) if row[-1])
    texts = frozenset({0, 1, len(head) - 1})
    return shown(cells, "All positions", head, texts=texts, marked=marked, wide=True)


def _range(count: FloatArray) -> str:
    low, high = (int(count.min()), int(count.max())) if len(count) else (0, 0)
    return str(high) if low == high else f"{low} to {high}"


def _luck(luck: Mapping[str, Any]) -> str:
    mean, low, high = (fixed(float(numbers(luck[name])), 2) for name in ("mean", "low", "high"))
    return f"{mean} ({low} to {high})"


def _ratios(values: Any) -> str:
    texts = [fixed(float(value), 2) for value in numbers(values)]
    return " ".join(f"{text} ({axis})" for text, axis in zip(texts, "XYZ", strict=False))


def _mean(values: FloatArray) -> FloatArray:
    """Average the rows that are known."""
    known = values[np.isfinite(values).all(axis=1)]
    return known.mean(axis=0) if len(known) else np.full(values.shape[1], np.nan)
