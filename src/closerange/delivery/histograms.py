"""Histograms: how many values lie where."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from closerange.delivery.canvas import Canvas
from closerange.delivery.svg import (
    BLUE,
    FULL_WIDTH,
    RULE,
    SOFT,
    VERMILION,
    Point,
    Scale,
    nice_step,
    tick_text,
    ticks,
)
from closerange.delivery.wording import significant
from closerange.geometry.arrays import FloatArray

BINS = 40
"""Bars of a histogram at most: three units wide on half a page."""

_LEFT, _RIGHT, _TOP, _BOTTOM = 46.0, 10.0, 34.0, 34.0


@dataclass(frozen=True, slots=True, eq=False)
class Histogram:
    """One histogram.

    Attributes
    ----------
    title : str
        What was counted.
    values : ndarray, shape (N,)
        NaN is left out; the uppermost hundredth is counted in the last bar.
    label : str
        Of the values, with unit.
    """

    title: str
    values: FloatArray
    label: str


def draw_histograms(histograms: Sequence[Histogram], *, height: float = 190.0) -> Canvas:
    """Draw histograms side by side, with the median of each as a line.

    Parameters
    ----------
    histograms : sequence of Histogram
        From left to right.
    height : float, optional
        Of the figure, drawing units.

    Returns
    -------
    Canvas
        As wide as the page.
    """
    titles = "; ".join(histogram.title for histogram in histograms)
    canvas = Canvas(FULL_WIDTH, height, "Histograms", titles)
    width = FULL_WIDTH / max(len(histograms), 1)
    for column, histogram in enumerate(histograms):
        _draw(canvas, histogram, (column * width, 0.0), (width, height))
    return canvas


def _draw(canvas: Canvas, histogram: Histogram, corner: Point, size: Point) -> None:
    left, right = corner[0] + _LEFT, corner[0] + size[0] - _RIGHT
    top, bottom = corner[1] + _TOP, corner[1] + size[1] - _BOTTOM
    canvas.text((left, corner[1] + 12), histogram.title, font_weight="bold")
    known = histogram.values[np.isfinite(histogram.values)]
    if not known.size:
        canvas.text(((left + right) / 2, (top + bottom) / 2), "no value", text_anchor="middle")
        return
    edges = _edges(known)
    counts, _ = np.histogram(np.minimum(known, edges[-1]), edges)
    x = Scale(float(edges[0]), float(edges[-1]), left, right)
    y = Scale(0.0, 1.05 * float(counts.max()), bottom, top)
    _ticks(canvas, x, y)
    for count, start, end in zip(counts.tolist(), edges[:-1], edges[1:], strict=True):
        if count:
            a, b = x(float(start)), x(float(end))
            box = {
                "x": a,
                "y": y(count),
                "width": max(b - a - 0.4, 0.4),
                "height": bottom - y(count),
            }
            canvas.add("rect", fill=BLUE, **box)
    median = float(np.median(known))
    canvas.line((x(median), top), (x(median), bottom), VERMILION, stroke_width=1.2)
    text = f"{len(known)} values, median {significant(median, 2)}"
    canvas.text((left, corner[1] + 26), text, fill=VERMILION, font_size=10)
    canvas.add(
        "rect", x=left, y=top, width=right - left, height=bottom - top, fill="none", stroke=SOFT
    )
    canvas.text(((left + right) / 2, bottom + 27), histogram.label, text_anchor="middle")


def _edges(known: FloatArray) -> FloatArray:
    """Return the ends of round bars from 0, or from the least value, to the last hundredth."""
    high = float(np.quantile(known, 0.99, method="lower"))
    low = min(0.0, float(known.min()))
    step = nice_step(max(high - low, 1e-9), BINS)
    bars = max(int(np.ceil((high - low) / step - 1e-9)), 1)
    return np.asarray(low + step * np.arange(bars + 1))


def _ticks(canvas: Canvas, x: Scale, y: Scale) -> None:
    top, bottom = y.end, y.start
    count = max(2, int((x.end - x.start) / 48))
    step = nice_step(x.high - x.low, count)
    for value in ticks(x.low, x.high, count):
        canvas.line((x(value), top), (x(value), bottom), RULE, stroke_width=0.6)
        canvas.text((x(value), bottom + 13), tick_text(value, step), text_anchor="middle")
    step = max(1.0, nice_step(y.high, 4))
    for value in ticks(0.0, y.high, 4):
        canvas.line((x.start, y(value)), (x.end, y(value)), RULE, stroke_width=0.6)
        canvas.text((x.start - 5, y(value) + 4), tick_text(value, step), text_anchor="end")
