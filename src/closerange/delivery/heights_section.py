"""The section on heights of known parts: the thesis' Tables 5.2 and 5.4, and what they hide."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from closerange.delivery.excerpts import listed, numbers, shown
from closerange.delivery.plots import Level, Panel, panel_grid
from closerange.delivery.sheet import Block, Figure, Paragraph
from closerange.delivery.svg import VERMILION
from closerange.delivery.wording import counted, fixed, mm, short_length

_PLACES = {"outline": "edge points of the top", "middle": "centroid of the top"}


def height_blocks(check: Mapping[str, Any]) -> tuple[str, list[Block]]:
    """Write title and content of the section.

    Parameters
    ----------
    check : mapping
        Document of a `HeightCheck`.

    Returns
    -------
    tuple of str and list of Block
        Title and blocks.
    """
    rows = check["rows"]
    rms, largest = (short_length(float(numbers(check[name]))) for name in ("rms_mm", "max_mm"))
    used = len({key for key, use in zip(_keys(rows), rows["used"], strict=True) if use})
    text = (
        f"Heights of {counted(used, 'part')} over what they stand on were compared with the known "
        f"ones; errors are measured minus actual: rms {rms}, largest {largest}. A part's height is "
        "the median of its points: those whose X and Y lie on the outline, or in the middle, of "
        f"its top, within {fixed(float(check['tolerance_mm']), 1)} mm or three standard "
        "deviations, and above half of its height."
    )
    blocks: list[Block] = [Paragraph(text)]
    if sum(int(count) for count in rows["count"]) > len(rows["count"]):
        median, p95, worst = (
            short_length(float(numbers(check[f"points_{name}_mm"])))
            for name in ("median", "p95", "max")
        )
        blocks.append(
            Paragraph(
                f"Single points are off by {median} (median), 95 % of them by less than {p95}, the "
                f"worst by {worst}. {check['elsewhere']} usable points belong to no top (other "
                f"edges, the ground); {check['flagged']} points carry a flag or have no position."
            )
        )
    blocks.append(_table(rows))
    blocks.append(_figure(rows))
    if check.get("missing"):
        names = listed(" ".join(filter(None, item)) for item in check["missing"])
        blocks.append(Paragraph(f"Parts without enough points: {names}.", "warn"))
    return "Heights", blocks


def _keys(rows: Mapping[str, Any]) -> list[tuple[str, str]]:
    return list(zip(rows["placement"], rows["part"], strict=True))


def _table(rows: Mapping[str, Any]) -> Block:
    actual, measured = numbers(rows["actual_mm"]), numbers(rows["measured_mm"])
    small = [
        1000 * numbers(rows[f"{name}_mm"]) for name in ("error", "std", "predicted_std", "worst")
    ]
    cells = [
        (
            *(rows[name][i] for name in ("placement", "part", "shape")),
            _PLACES.get(rows["place"][i], str(rows["place"][i])),
            str(rows["count"][i]),
            mm(actual[i]),
            mm(measured[i]),
            *(fixed(float(column[i]), 0) for column in small),
        )
        for i in range(len(actual))
    ]
    head = (
        *("placement", "part", "shape", "measured by", "points", "actual [mm]", "measured [mm]"),
        *("error [µm]", "std of a point [µm]", "predicted [µm]", "worst point [µm]"),
    )
    marked = frozenset(i for i, used in enumerate(rows["used"]) if not used)
    caption = "Actual and measured heights; marked rows have too few points"
    texts = frozenset({0, 1, 2, 3})
    return shown(cells, caption, head, texts=texts, marked=marked, wide=True)


def _figure(rows: Mapping[str, Any]) -> Figure:
    error, std = (1000 * numbers(rows[f"{name}_mm"]) for name in ("error", "std"))
    caption = "Error of each height (measured minus actual) in the order of the table"
    if np.isfinite(std).any():
        caption += "; bars reach one standard deviation of a single point up and down"
    panel = Panel(
        x=np.arange(1.0, len(error) + 1),
        y=error,
        spread=np.nan_to_num(std),
        x_label="row of the table",
        y_label="error [µm]",
        title="Error of each height",
        colour=VERMILION,
        levels=(Level(0.0, ""),),
    )
    picture = panel_grid([panel], columns=1, height=150, title="Heights", description=caption)
    return Figure(picture, f"{caption}.")
