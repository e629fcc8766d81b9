"""Plots with axes: small panels side by side, and residual vectors on an image plane."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from markupsafe import Markup
from numpy.typing import ArrayLike

from closerange.delivery.svg import (
    AXIS_COLOURS,
    BLUE,
    FULL_WIDTH,
    INK,
    RULE,
    SOFT,
    VERMILION,
    Drawing,
    Point,
    Scale,
    nice_step,
    tick_text,
    ticks,
    units,
    widened,
)
from closerange.delivery.wording import significant
from closerange.geometry.arrays import BoolArray, FloatArray, frozen_array

_LEFT, _RIGHT, _TOP, _BOTTOM = 46.0, 10.0, 20.0, 34.0


@dataclass(frozen=True, slots=True)
class Level:
    """A horizontal line across a panel.

    Attributes
    ----------
    value : float
        In the unit of the panel; NaN draws nothing.
    label : str
        What it is.
    dashed : bool
        Limits are dashed, results are not.
    """

    value: float
    label: str
    dashed: bool = False


@dataclass(frozen=True, slots=True, eq=False)
class Panel:
    """One small plot.

    Attributes
    ----------
    x, y : ndarray, shape (N,)
        Values; a NaN in either is left out.
    x_label, y_label : str
        With unit.
    title : str
        What it shows.
    colour : str
        Of the marks.
    levels : tuple of Level
        Lines across.
    trend : tuple of float or None
        Offset and slope of a straight line through the marks.
    mark : str
        ``dot``, ``stem`` (a line from zero) or ``chain`` (dots joined).
    zero : bool
        Whether the y axis must include zero.
    spread : ndarray, shape (N,), or None
        Half lengths of bars about the marks; NaN draws none.
    """

    x: FloatArray
    y: FloatArray
    x_label: str
    y_label: str
    title: str
    colour: str = BLUE
    levels: tuple[Level, ...] = ()
    trend: tuple[float, float] | None = None
    mark: str = "dot"
    zero: bool = False
    spread: FloatArray | None = None

    def __post_init__(self) -> None:
        object.__setattr__(self, "x", frozen_array(self.x, (None,), "x"))
        object.__setattr__(self, "y", frozen_array(self.y, (len(self.x),), "y"))


def panel_grid(
    panels: Sequence[Panel], *, columns: int, height: float, title: str, description: str
) -> Markup:
    """Draw panels in rows across the page.

    Parameters
    ----------
    panels : sequence of Panel
        Row by row.
    columns : int
        Panels in a row.
    height : float
        Of one panel, drawing units.
    title, description : str
        For the whole figure.

    Returns
    -------
    Markup
        Inline SVG.
    """
    rows = math.ceil(len(panels) / columns)
    width = FULL_WIDTH / columns
    drawing = Drawing(FULL_WIDTH, rows * height, title, description)
    for index, panel in enumerate(panels):
        row, column = divmod(index, columns)
        _draw_panel(drawing, panel, (column * width, row * height), (width, height))
    return drawing.render()


def axis_panels(
    values: ArrayLike,
    *,
    unit: str,
    quantity: str,
    x_label: str,
    levels: Sequence[Sequence[Level]] = ((), (), ()),
    mark: str = "dot",
    zero: bool = False,
    x: ArrayLike | None = None,
) -> list[Panel]:
    """Make one panel for each axis X, Y, Z: value against number.

    Parameters
    ----------
    values : array_like, shape (N, 3)
        In the unit named.
    unit, quantity : str
        Of the y axis.
    x_label : str
        What is counted along x.
    levels : sequence of sequence of Level
        Lines across, for each axis.
    mark, zero
        As in `Panel`.
    x : array_like, shape (N,), optional
        Abscissa; 1, 2, 3, ... without it.

    Returns
    -------
    list of Panel
        Three.
    """
    values = np.reshape(np.asarray(values, np.float64), (-1, 3))
    abscissa = np.arange(1.0, len(values) + 1) if x is None else np.asarray(x, np.float64)
    return [
        Panel(
            x=abscissa,
            y=values[:, axis],
            x_label=x_label if axis == 2 else "",
            y_label=f"{name} [{unit}]",
            title=f"{name}: {quantity}",
            colour=AXIS_COLOURS[axis],
            levels=tuple(levels[axis]),
            mark=mark,
            zero=zero,
        )
        for axis, name in enumerate("XYZ")
    ]


def magnification(
    length_px: ArrayLike, size_px: tuple[int, int], *, count: int | None = None
) -> float:
    """Choose a round factor that makes vectors visible without covering each other.

    Parameters
    ----------
    length_px : array_like, shape (N,)
        Lengths of the vectors; NaN is left out.
    size_px : tuple of int
        Image that they are drawn on.
    count : int, optional
        Vectors in one image, if `length_px` holds those of several.

    Returns
    -------
    float
        A round number: the 90th percentile becomes at most half the distance between evenly
        spread points, and at most a tenth of the width.
    """
    lengths = np.asarray(length_px, np.float64)
    lengths = lengths[np.isfinite(lengths) & (lengths > 0)]
    if not lengths.size:
        return 1.0
    apart = math.sqrt(size_px[0] * size_px[1] / max(count or lengths.size, 1))
    reach = min(0.5 * apart, 0.1 * size_px[0])
    # a few blunders must not shrink all the others to dots, hence a percentile
    return _round_below(reach / float(np.quantile(lengths, 0.9)), steps=(1, 1.5, 2, 3, 4, 5, 7))


def vector_plot(
    xy_px: ArrayLike,
    vector_px: ArrayLike,
    *,
    size_px: tuple[int, int],
    odd: BoolArray,
    factor: float,
    title: str,
    description: str,
) -> Markup:
    """Draw magnified residual vectors on an empty image plane, half a page wide.

    Parameters
    ----------
    xy_px, vector_px : array_like, shape (N, 2)
        Feet and vectors (observed minus calculated).
    size_px : tuple of int
        Image size.
    odd : ndarray of bool, shape (N,)
        Points that were not fitted: drawn dashed and in another colour.
    factor : float
        Magnification of the vectors.
    title, description : str
        For screen readers.

    Returns
    -------
    Markup
        Inline SVG with its own legend.
    """
    scale = (FULL_WIDTH / 2 - _LEFT - _RIGHT) / size_px[0]
    inner = (size_px[0] * scale, size_px[1] * scale)
    drawing = Drawing(FULL_WIDTH / 2, _TOP + inner[1] + _BOTTOM + 28, title, description)
    x_scale = Scale(-0.5, size_px[0] - 0.5, _LEFT, _LEFT + inner[0])
    y_scale = Scale(-0.5, size_px[1] - 0.5, _TOP, _TOP + inner[1])
    _axes(drawing, x_scale, y_scale, ("x [px]", "y [px]"))
    drawing.text((_LEFT, _TOP - 7), title, font_weight="bold")
    feet = np.reshape(np.asarray(xy_px, np.float64), (-1, 2))
    vectors = np.reshape(np.asarray(vector_px, np.float64), (-1, 2))
    for (x, y), (u, v), is_odd in zip(feet, vectors, odd, strict=True):
        if not math.isfinite(x + y + u + v):
            continue
        foot = (x_scale(x), y_scale(y))
        vector = (factor * scale * u, factor * scale * v)
        tip = _clipped(foot, vector, (_LEFT, _TOP, _LEFT + inner[0], _TOP + inner[1]))
        colour = VERMILION if is_odd else BLUE
        style: dict[str, str | float] = {"stroke_width": 1.1}
        drawing.dot(foot, 1.4, colour)
        drawing.arrow(
            foot, tip, colour, **(style | ({"stroke_dasharray": "3 2"} if is_odd else {}))
        )
    _vector_key(drawing, _TOP + inner[1] + _BOTTOM + 16, factor * scale, bool(np.any(odd)))
    return drawing.render()


def _vector_key(drawing: Drawing, y: float, units_per_px: float, odd: bool) -> None:
    """Say how long a pixel is, and what the colours mean."""
    step = _round_below(60 / units_per_px)
    end = _LEFT + step * units_per_px
    drawing.arrow((_LEFT, y - 4), (end, y - 4), INK, stroke_width=1.1)
    drawing.text((end + 6, y), f"= {significant(step, 1)} px")
    drawing.dot((_LEFT + 124, y - 4), 2, BLUE)
    drawing.text((_LEFT + 130, y), "fitted", fill=BLUE)
    if odd:
        drawing.dot((_LEFT + 172, y - 4), 2, VERMILION)
        drawing.text((_LEFT + 178, y), "not fitted (dashed)", fill=VERMILION)


def _round_below(limit: float, *, steps: Sequence[float] = (1, 2, 5)) -> float:
    """Return the largest round number (steps times a power of ten) not above a limit."""
    power = 10.0 ** math.floor(math.log10(limit))
    return max(m * power for m in steps if m * power <= limit * (1 + 1e-9))


def _clipped(foot: Point, vector: Point, frame: tuple[float, float, float, float]) -> Point:
    """Return the tip of a vector, shortened where it would leave the frame."""
    shrink = 1.0
    for start, step, low, high in zip(foot, vector, frame[:2], frame[2:], strict=True):
        room = (high if step > 0 else low) - start
        if abs(step) > max(abs(room), 1e-9):
            shrink = min(shrink, abs(room / step))
    return (foot[0] + shrink * vector[0], foot[1] + shrink * vector[1])


def _draw_panel(drawing: Drawing, panel: Panel, corner: Point, size: Point) -> None:
    """Draw one panel into its place."""
    known = np.isfinite(panel.x) & np.isfinite(panel.y)
    x, y = panel.x[known], panel.y[known]
    half = np.nan_to_num(panel.spread[known]) if panel.spread is not None else 0 * y
    span_y = [*(y - half), *(y + half), *(level.value for level in panel.levels)]
    left, top = corner[0] + _LEFT, corner[1] + _TOP
    right, bottom = corner[0] + size[0] - _RIGHT, corner[1] + size[1] - _BOTTOM
    x_scale = Scale(*widened(list(x), margin=0.03), left, right)
    y_scale = Scale(*widened(span_y, zero=panel.zero), bottom, top)
    counted = bool((x == np.round(x)).all())
    _axes(drawing, x_scale, y_scale, (panel.x_label, panel.y_label), counted=counted)
    drawing.text((left, top - 7), panel.title, font_weight="bold")
    _draw_levels(drawing, panel, x_scale, y_scale)
    if panel.trend is not None and len(x):
        offset, slope = panel.trend
        ends = [(x_scale(v), y_scale(offset + slope * v)) for v in (x.min(), x.max())]
        drawing.line(ends[0], ends[1], INK, stroke_width=1.2)
    places = [(x_scale(a), y_scale(b)) for a, b in zip(x, y, strict=True)]
    if panel.mark == "chain":
        drawing.path(places, stroke=panel.colour, stroke_width=0.8)
    if panel.mark == "stem":
        foot = units(y_scale(0.0))
        steps = " ".join(f"M{units(px)} {foot}V{units(py)}" for px, py in places)
        drawing.add("path", d=steps or "M0 0", stroke=panel.colour, stroke_width=0.8, fill="none")
    for (px, _), low, high in zip(places, y - half, y + half, strict=True):
        if high > low:
            drawing.line((px, y_scale(low)), (px, y_scale(high)), panel.colour, stroke_width=1.1)
    for place in places:
        drawing.dot(place, 1.7, panel.colour)
    _name_levels(drawing, panel, x_scale, y_scale)
    if not places:
        drawing.text(((left + right) / 2, (top + bottom) / 2), "no value", text_anchor="middle")


def _draw_levels(drawing: Drawing, panel: Panel, x_scale: Scale, y_scale: Scale) -> None:
    """Draw lines across."""
    for level in panel.levels:
        if math.isfinite(level.value):
            y = y_scale(level.value)
            dash: dict[str, str | float] = {"stroke_dasharray": "5 3"} if level.dashed else {}
            drawing.line((x_scale.start, y), (x_scale.end, y), INK, stroke_width=0.9, **dash)


def _name_levels(drawing: Drawing, panel: Panel, x_scale: Scale, y_scale: Scale) -> None:
    """Write the names of the lines over the marks, where there is room inside the frame."""
    written: list[float] = []
    for level in panel.levels:
        if not (math.isfinite(level.value) and level.label):
            continue
        y = y_scale(level.value)
        outward = y - 3 if level.value >= 0 else y + 10
        inward = y + 10 if level.value >= 0 else y - 3
        base = outward if y_scale.end + 9 < outward < y_scale.start - 1 else inward
        if all(abs(base - other) >= 10 for other in written):
            written.append(base)
            drawing.text(
                (x_scale.end - 3, base),
                level.label,
                text_anchor="end",
                font_size=10,
                # a white outline keeps the words readable among the marks
                stroke="#ffffff",
                stroke_width=3,
                paint_order="stroke",
            )


def _axes(
    drawing: Drawing,
    x_scale: Scale,
    y_scale: Scale,
    labels: tuple[str, str],
    *,
    counted: bool = False,
) -> None:
    """Draw frame, grid, ticks and labels; what is counted has no ticks between whole numbers."""
    left, right = x_scale.start, x_scale.end
    top, bottom = sorted((y_scale.start, y_scale.end))
    x_count = max(2, int((right - left) / 42))
    if counted:
        x_count = max(1, min(x_count, math.ceil(x_scale.high - x_scale.low)))
    x_ticks, x_step = _ticks(x_scale, x_count)
    y_ticks, y_step = _ticks(y_scale, max(4, int((bottom - top) / 20)))
    for value in x_ticks:
        drawing.line((x_scale(value), top), (x_scale(value), bottom), RULE, stroke_width=0.6)
        drawing.text((x_scale(value), bottom + 13), tick_text(value, x_step), text_anchor="middle")
    for value in y_ticks:
        drawing.line((left, y_scale(value)), (right, y_scale(value)), RULE, stroke_width=0.6)
        drawing.text((left - 5, y_scale(value) + 4), tick_text(value, y_step), text_anchor="end")
    drawing.add(
        "rect", x=left, y=top, width=right - left, height=bottom - top, fill="none", stroke=SOFT
    )
    if labels[0]:
        drawing.text(((left + right) / 2, bottom + 27), labels[0], text_anchor="middle")
    middle = (top + bottom) / 2
    x = left - _LEFT + 10
    drawing.text(
        (x, middle),
        labels[1],
        text_anchor="middle",
        transform=f"rotate(-90 {units(x)} {units(middle)})",
    )


def _ticks(scale: Scale, count: int) -> tuple[list[float], float]:
    return ticks(scale.low, scale.high, count), nice_step(scale.high - scale.low, count)
