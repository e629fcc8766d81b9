"""Chapters 3, 5 and 6: what the printed evaluations contain."""

from __future__ import annotations

from typing import Any

import numpy as np
from scipy.integrate import quad
from scipy.stats import norm

from closerange.files import CsvTable
from thesis.positions import averages, read_run
from thesis.tables import AXES, Lines, fixed, markdown, read_json, read_table

STATED_LIMIT_MM = 1.5  # "the maximum error is less than 1.5 mm" (section 5.6)


def half_range_factor(count: int) -> float:
    """Return the expected half range of `count` normal values, in standard deviations."""
    value, _ = quad(lambda x: 1 - norm.cdf(x) ** count - norm.sf(x) ** count, -9, 9)
    return float(value) / 2


ENVELOPE_HEADER = (
    "axis",
    "error envelope, mm",
    "half range, mm",
    'printed "repeatability envelope", mm',
    "accuracy claimed, mm",
    "standard deviation that fits, mm",
    "same from the fitted rows of the 27-point run, mm",
)


def envelope_section() -> Lines:
    """Chapter 3: half ranges and the standard deviations that would give them."""
    source = read_json("fig_3_5_3_8_3_11_envelopes.json")
    positions = source["protocol"]["positions"]
    factor = half_range_factor(positions)
    share = 100 * source["axes"]["Z"]["accuracy_claimed_mm"] / source["protocol"]["range_mm"][2]
    return [
        "### Chapter 3: 90 positions with 10 readings each",
        "",
        (
            "**What survives:** the lowest and highest mean error of each axis. **What does not:** "
            "the standard deviations (Figures 3.3, 3.6, 3.9), the means (3.4, 3.7, 3.10) and the "
            "100 readings of Figure 3.2 exist only as plots, and no cycle time is given although "
            "it is named as a figure of merit. The repeatability of 0.01 mm is a sentence without "
            "a table."
        ),
        *markdown(ENVELOPE_HEADER, _envelope_rows(source, factor)),
        (
            'The printed "repeatability envelope" is half the range of the *mean errors*: a figure '
            "of accuracy, not of repeatability. Of "
            f"{positions} normal values half the range is {fixed(factor, 2)} standard deviations "
            "on average, which gives the last column but one. The reference itself, dial gauges of "
            "0.0127 mm, proves nothing below about 0.05 mm (four times its own error)."
        ),
        "",
        (
            'The conclusion states "2.2%" of the field; 0.29 mm of 12.7 mm is '
            f"{fixed(share, 2)} %. The summary states an accuracy of 0.1 mm where chapter 3 has "
            "0.13, 0.18 and 0.29 mm."
        ),
        "",
    ]


def _envelope_rows(source: Any, factor: float) -> list[list[str]]:
    residual = averages(read_run(27), ~read_run(27).check)
    rows = []
    for i, axis in enumerate(AXES):
        entry = source["axes"][axis]
        half = (entry["emax_mm"] - entry["emin_mm"]) / 2
        printed = entry["rep_printed_mm"]
        rows.append(
            [
                axis,
                f"{entry['emin_mm']:g} to {entry['emax_mm']:g}",
                fixed(half, 3),
                "not printed" if printed is None else fixed(printed, 3),
                fixed(entry["accuracy_claimed_mm"], 2),
                fixed(half / factor, 3),
                # mean magnitude of a normal value is 0.798 standard deviations
                fixed(residual[i] / np.sqrt(2 / np.pi), 3),
            ]
        )
    return rows


def heights_section() -> Lines:
    """Tables 5.1, 5.2 and 5.4: heights of five blocks."""
    edges = read_table(
        "table_5_2.csv",
        ("points", "actual_height_mm", "measured_first_mm", "measured_second_mm"),
        ("error_first_mm", "error_second_mm", "note"),
    )
    actual = edges.floats("actual_height_mm")
    first = edges.floats("measured_first_mm")
    second = edges.floats("measured_second_mm", blank=np.nan)
    errors = np.array([*(np.array(first) - actual), *(np.array(second) - actual)])
    errors = errors[np.isfinite(errors)]
    return [
        "### Chapter 5: heights from corresponding points (Tables 5.1 and 5.2)",
        *markdown(
            [
                "edge points",
                "vernier, mm",
                "Table 5.2, mm",
                "Table 5.1 plus 50, mm",
                "error of Table 5.2, mm",
            ],
            _height_rows(edges),
        ),
        _summary("nine edge points", errors),
        "",
        (
            f"{(np.abs(errors) > STATED_LIMIT_MM).sum()} of the nine errors exceeds the stated "
            f'"less than {STATED_LIMIT_MM} mm". Table 5.1 and Table 5.2 disagree for point 1 '
            "(1.5 against 51.55 - 50) and in the last digit for point 8."
        ),
        "",
    ]


def _height_rows(edges: CsvTable) -> list[list[str]]:
    depth = read_table("table_5_1.csv", ("point", "z_mm"), ("note",)).floats("z_mm")
    actual = edges.floats("actual_height_mm")
    first = edges.floats("measured_first_mm")
    second = edges.floats("measured_second_mm", blank=np.nan)
    rows = []
    for i, points in enumerate(edges.texts("points")):
        printed = [v for v in (first[i], second[i]) if np.isfinite(v)]
        from_depth = [depth[int(name) - 1] + 50 for name in points.split(";")]
        rows.append(
            [
                points.replace(";", " and "),
                fixed(actual[i], 2),
                ", ".join(fixed(v, 2) for v in printed),
                ", ".join(fixed(v, 2) for v in from_depth),
                ", ".join(fixed(v - actual[i], 2) for v in printed),
            ]
        )
    return rows


CENTROID_HEADER = (
    "label",
    "x'' morphological minus border, px",
    "y'' likewise, px",
    "height printed, mm",
    "Z plus 50, mm",
    "vernier, mm",
    "error, mm",
)


def centroid_section() -> Lines:
    """Tables 5.3 and 5.4: centroids and the heights from them."""
    seen = read_table(
        "table_5_3.csv",
        ("label", "x2_morph", "y2_morph", "x2_border", "y2_border"),
        ("x1", "y1", "note"),
    )
    height = read_table(
        "table_5_4.csv",
        ("label", "z_mm", "height_z_plus_50_mm", "reference_height_mm"),
        ("error_mm", "note"),
    )
    shift = [
        np.array(seen.floats(f"{axis}2_morph"))
        - np.array(seen.floats(f"{axis}2_border", blank=np.nan))
        for axis in ("x", "y")
    ]
    z, reference = np.array(height.floats("z_mm")), np.array(height.floats("reference_height_mm"))
    printed = height.floats("height_z_plus_50_mm")
    rows = [
        [
            label,
            fixed(shift[0][i], 0),
            fixed(shift[1][i], 0),
            fixed(printed[i], 2),
            fixed(z[i] + 50, 2),
            fixed(reference[i], 2),
            fixed(z[i] + 50 - reference[i], 2),
        ]
        for i, label in enumerate(height.texts("label"))
    ]
    return [
        "### Chapter 5: centroids (Tables 5.3 and 5.4)",
        *markdown(CENTROID_HEADER, rows),
        _summary("five centroids", z + 50 - reference),
        "",
        (
            "Of label 4 the border's y'' reads 0 in our text, which contradicts the stated "
            "agreement to one pixel; it is left blank here."
        ),
        "",
    ]


def _summary(what: str, errors: np.ndarray) -> str:
    mean, deviation = float(np.mean(errors)), float(np.std(errors, ddof=1))
    return (
        f"Over the {what} the mean error is {fixed(mean, 2)} mm, the standard deviation "
        f"{fixed(deviation, 2)} mm, the largest magnitude {fixed(float(np.abs(errors).max()), 2)} "
        "mm."
    )


def distortion_section() -> Lines:
    """Section 6.5: reduction of the error criterion by the terms of the lens model."""
    table = read_table(
        "sec_6_5_distortion.csv",
        ("experiment", "n_points", "assumption", "model", "phi", "reduction_pct_printed"),
        ("exponent_known", "reduction_pct_recomputed"),
    )
    phi = table.floats("phi")
    printed = table.floats("reduction_pct_printed", blank=np.nan)
    rows, first = [], 1.0
    for i, assumption in enumerate(table.texts("assumption")):
        first = phi[i] if assumption == "1" else first
        points = table.texts("n_points")[i]
        value = f"{phi[i]:g}" if points == "27" else f"{phi[i]:g} x 10^?"
        reduction = 100 * (1 - phi[i] / first)
        rows.append(
            [
                f"{points} points: {table.texts('model')[i]}",
                value,
                fixed(reduction, 1),
                fixed(printed[i], 0),
            ]
        )
    return [
        "### Section 6.5: the effect of lens terms",
        "",
        (
            "Error criterion (6.13), the sum of squared algebraic residuals, under four "
            "assumptions. Of the 63-point experiment the exponent is lost; the ratios survive. The "
            "unit is not stated. It cannot be the pixel of Figure 2.4: 54 residuals would have an "
            f"RMS of {fixed(float(np.sqrt(phi[0] / 54)), 3)} px, where 0.05 mm in chapter 2 are "
            "0.7 px."
        ),
        *markdown(["assumption", "phi", "reduction, %", "printed, %"], rows),
        (
            'The text states "67%" where its own values give 68.0 %. A smaller criterion with more '
            "parameters is not by itself a better calibration: with 27 points per camera there are "
            "54 equations for 16 unknowns. The decrease must be checked on points that were not "
            "fitted, as below."
        ),
        "",
    ]
