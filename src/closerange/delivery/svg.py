"""Scalable figures written by hand: a drawing, scales, ticks and colours.

Figures are inline SVG without scripts, style sheets or references, so that they work on paper,
without network and in any mail program. Text is 11 units high in drawings 640 units wide, which is
9 point on a page of A4.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field

from markupsafe import Markup, escape

FULL_WIDTH = 640.0
"""Width in drawing units of a figure as wide as the page."""

INK = "#222222"
SOFT = "#6b6b6b"
RULE = "#d9d9d9"
PAPER = "#ffffff"

# Okabe and Ito's palette: distinguishable with any colour vision; text always stands beside it
AXIS_COLOURS = ("#c44e00", "#00805e", "#0067a3")
BLUE, VERMILION, GREEN, PURPLE = "#0067a3", "#c44e00", "#00805e", "#a3467a"

# light to dark with steadily falling luminance: it survives a black-and-white printer
_HEAT = ((255, 244, 207), (252, 202, 120), (232, 130, 72), (176, 52, 74), (84, 18, 72))

# steadily lighter, and lighter at its dark end than half of white is on a picture
_DEPTH = ((92, 110, 255), (0, 164, 232), (0, 196, 140), (158, 218, 40), (255, 236, 120))

Point = tuple[float, float]


def units(value: float) -> str:
    """Write a coordinate in drawing units: two decimals are 3 um on paper."""
    text = f"{value:.2f}".rstrip("0").rstrip(".")
    return "0" if text in ("-0", "") else text


def heat_colour(fraction: float) -> str:
    """Return the colour of a value on the sequential scale.

    Parameters
    ----------
    fraction : float
        0 (light, small) to 1 (dark, large); values outside are clipped, NaN is grey.

    Returns
    -------
    str
        ``#rrggbb``.
    """
    return _on_scale(_HEAT, fraction)


def depth_colour(fraction: float) -> str:
    """Return the colour of a depth: from blue over green to light yellow.

    Parameters
    ----------
    fraction : float
        0 (dark blue) to 1 (light yellow); values outside are clipped, NaN is grey.

    Returns
    -------
    str
        ``#rrggbb``; all of them are lighter than a dimmed image, on which they are drawn.
    """
    return _on_scale(_DEPTH, fraction)


def _on_scale(scale: Sequence[tuple[int, int, int]], fraction: float) -> str:
    if math.isnan(fraction):
        return "#e6e6e6"
    position = min(max(fraction, 0.0), 1.0) * (len(scale) - 1)
    index = min(int(position), len(scale) - 2)
    rest = position - index
    pairs = zip(scale[index], scale[index + 1], strict=True)
    return "#" + "".join(f"{round(a + rest * (b - a)):02x}" for a, b in pairs)


def ink_on(fraction: float) -> str:
    """Return the text colour that is readable on `heat_colour` of the same value."""
    # black and white have equal contrast, 4.6, on a luminance of 0.18: at 0.66 of the scale
    return PAPER if fraction > 0.66 else "#000000"


@dataclass(slots=True)
class Drawing:
    """An SVG figure that is built up shape by shape.

    Attributes
    ----------
    width, height : float
        Size in drawing units.
    title : str
        What it shows, for screen readers and as the tool tip.
    description : str
        What one is meant to see in it.
    """

    width: float
    height: float
    title: str
    description: str
    _parts: list[Markup] = field(default_factory=list)

    def add(self, tag: str, content: str = "", /, **attributes: str | float) -> None:
        """Append an element; underscores in attribute names become hyphens.

        Parameters
        ----------
        tag : str
            Element name.
        content : str, optional
            Text content; it is escaped.
        **attributes : str or float
            Numbers are drawing units.
        """
        self._parts.append(_element(tag, escape(content), attributes))

    def line(self, start: Point, end: Point, colour: str = INK, **style: str | float) -> None:
        """Draw a straight line."""
        self.add("line", x1=start[0], y1=start[1], x2=end[0], y2=end[1], stroke=colour, **style)

    def text(self, at: Point, content: str, **style: str | float) -> None:
        """Write text; `at` is the anchor on the base line."""
        self.add("text", content, x=at[0], y=at[1], **style)

    def dot(self, at: Point, radius: float, colour: str, **style: str | float) -> None:
        """Draw a filled circle."""
        self.add("circle", cx=at[0], cy=at[1], r=radius, fill=colour, **style)

    def path(self, points: Iterable[Point], *, closed: bool = False, **style: str | float) -> None:
        """Draw a chain of straight lines, closed into an area if asked for."""
        steps = " ".join(f"{units(x)},{units(y)}" for x, y in points)
        style.setdefault("fill", "none")
        self.add("polygon" if closed else "polyline", points=steps, **style)

    def arrow(self, start: Point, end: Point, colour: str, **style: str | float) -> None:
        """Draw a line with an arrow head that never outgrows the line."""
        length = math.dist(start, end)
        if length < 0.05:
            return
        along = ((end[0] - start[0]) / length, (end[1] - start[1]) / length)
        head = min(5.0, 0.45 * length)
        base = (end[0] - head * along[0], end[1] - head * along[1])
        self.line(start, base, colour, **style)
        half = 0.4 * head + (float(style.get("stroke_width", 1)) - 1) / 3
        left = (base[0] - half * along[1], base[1] + half * along[0])
        right = (base[0] + half * along[1], base[1] - half * along[0])
        self.path([end, left, right], closed=True, fill=colour)

    def render(self) -> Markup:
        """Return the figure as an inline ``<svg>`` element."""
        head = _element("title", escape(self.title), {}) + _element(
            "desc", escape(self.description), {}
        )
        attributes: dict[str, str | float] = {
            "viewBox": f"0 0 {units(self.width)} {units(self.height)}",
            "width": self.width,
            "height": self.height,
            "role": "img",
            "aria-label": self.title,
            "font-size": 11,
            "fill": INK,
        }
        return _element("svg", head + Markup("\n").join(self._parts), attributes)


def _element(tag: str, content: Markup, attributes: dict[str, str | float]) -> Markup:
    """Write one element; texts are escaped, numbers shortened."""
    written = Markup("").join(
        Markup(' {}="{}"').format(
            name.rstrip("_").replace("_", "-"), value if isinstance(value, str) else units(value)
        )
        for name, value in attributes.items()
    )
    if not content:
        return Markup("<{}{}/>").format(tag, written)
    return Markup("<{}{}>{}</{}>").format(tag, written, content, tag)


@dataclass(frozen=True, slots=True)
class Scale:
    """A linear map from values to drawing units; a range without extent goes to its middle."""

    low: float
    high: float
    start: float
    end: float

    def __call__(self, value: float) -> float:
        """Return the drawing coordinate of a value."""
        span = self.high - self.low
        share = (value - self.low) / span if span else 0.5
        return self.start + share * (self.end - self.start)


def nice_step(span: float, count: int) -> float:
    """Return the smallest step of 1, 2 or 5 times a power of ten that gives `count` or fewer.

    Parameters
    ----------
    span : float
        Range to be divided, above zero.
    count : int
        Largest number of intervals.

    Returns
    -------
    float
        The step.
    """
    if not (math.isfinite(span) and span > 0):
        return 1.0
    raw = span / count
    power = 10.0 ** math.floor(math.log10(raw))
    # 1e-9: 0.2 / 0.1 must not become the next step for want of a last bit
    return next(m * power for m in (1.0, 2.0, 5.0, 10.0) if m * power >= raw * (1 - 1e-9))


def ticks(low: float, high: float, count: int = 5) -> list[float]:
    """Return round values within a range, at most `count` + 1."""
    step = nice_step(high - low, count)
    first = math.ceil(low / step - 1e-9)
    last = math.floor(high / step + 1e-9)
    return [index * step for index in range(first, last + 1)]


def tick_text(value: float, step: float) -> str:
    """Write a tick with the decimals that its step needs."""
    places = max(0, -math.floor(math.log10(step) + 1e-9))
    text = f"{value:.{places}f}"
    return text.removeprefix("-") if float(text) == 0 else text


def widened(values: Sequence[float], *, zero: bool = False, margin: float = 0.06) -> Point:
    """Return a range that holds all finite values with some air around.

    Parameters
    ----------
    values : sequence of float
        NaN is left out.
    zero : bool, optional
        Include zero, and let the range start there if no value is negative.
    margin : float, optional
        Air on either side, relative to the span.

    Returns
    -------
    tuple of float
        Low and high, never equal.
    """
    finite = [float(value) for value in values if math.isfinite(value)]
    if zero:
        finite.append(0.0)
    if not finite:
        return 0.0, 1.0
    low, high = min(finite), max(finite)
    air = (high - low) * margin or max(abs(high) * margin, 0.5)
    return (0.0 if zero and low == 0 else low - air), (0.0 if zero and high == 0 else high + air)


def heat_legend(
    drawing: Drawing,
    at: Point,
    width: float,
    limits: Point,
    label: str,
    *,
    colour: Callable[[float], str] = heat_colour,
) -> None:
    """Draw the colour scale with its ticks and its unit.

    Parameters
    ----------
    drawing : Drawing
        Where.
    at : tuple of float
        Upper left corner of the bar.
    width : float
        Its width.
    limits : tuple of float
        Values at its ends.
    label : str
        What the colour means, with unit.
    colour : callable, optional
        Colour of a fraction of the scale.
    """
    x, y = at
    steps = 40
    for index in range(steps):
        drawing.add(
            "rect",
            x=x + width * index / steps,
            y=y,
            width=width / steps + 0.3,  # overlap: no hairlines between the pieces
            height=10,
            fill=colour((index + 0.5) / steps),
        )
    drawing.add("rect", x=x, y=y, width=width, height=10, fill="none", stroke=SOFT)
    scale = Scale(*limits, x, x + width)
    step = nice_step(limits[1] - limits[0], 4)
    for value in ticks(*limits, 4):
        drawing.line((scale(value), y + 10), (scale(value), y + 14), SOFT)
        drawing.text((scale(value), y + 25), tick_text(value, step), text_anchor="middle")
    drawing.text((x, y - 5), label)
