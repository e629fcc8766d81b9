"""Pictures of a match as drawings: for a report as SVG, for a folder as PNG."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from closerange.delivery.canvas import Canvas, dot_layer
from closerange.delivery.element_picture import Crop, ElementPicture
from closerange.delivery.match_pictures import ViewPicture
from closerange.delivery.overlays import MAX_WIDTH_PX
from closerange.delivery.svg import (
    BLUE,
    FULL_WIDTH,
    INK,
    RULE,
    SOFT,
    VERMILION,
    Point,
    Scale,
    depth_colour,
    heat_legend,
    nice_step,
    tick_text,
    ticks,
)
from closerange.delivery.wording import counted, fixed, percent, significant
from closerange.flags import Flag
from closerange.geometry.arrays import BoolArray, FloatArray, IntArray

KEPT = "#4fd8ff"
"""Colour of points without a flag."""

# for flags, in the order of how many points carry them: apart in hue and in lightness
_FLAG_COLOURS = ("#ffb000", "#ff6a4d", "#f29cd5", "#ffffff", "#b7a3ff", "#c9d64a", "#e0c9a6")
_OTHER_FLAGS = "#9a9a9a"

_GAP = 8.0
_DOT_PX = 1.3  # radius on a layer of MAX_WIDTH_PX columns: neighbours on an edge nearly touch
_FEW, _FEW_DOT_PX = 100, 4.5  # so few points do not make lines: they are drawn as dots
_LAYER = 2  # pixels of a layer for each pixel of the stored picture

ELEMENT, MISSING, PLACE = "#ffe14d", "#ff4d4d", "#ffffff"
"""Colours on the pictures of an element: its pixels, those not found, the search."""


@dataclass(frozen=True, slots=True, eq=False)
class Marks:
    """Points on one view and their colours; N points.

    Attributes
    ----------
    xy_px : ndarray, shape (N, 2)
        Where, in full-image px; NaN is left out.
    colours : sequence of str
        ``#rrggbb``; later points cover earlier ones.
    """

    xy_px: FloatArray
    colours: Sequence[str]


@dataclass(frozen=True, slots=True)
class FlagClass:
    """Points that are drawn in one colour; see `flag_classes`."""

    label: str
    colour: str
    count: int
    rows: tuple[int, ...]


def flag_classes(flags: IntArray) -> list[FlagClass]:
    """Group points by their flags, for a picture with a legend.

    Parameters
    ----------
    flags : ndarray of int, shape (N,)
        `Flag` bits.

    Returns
    -------
    list of FlagClass
        First the points without a flag. A point with several flags belongs to the one that the
        fewest points carry: what is rare tells more of it.
    """
    bits = [bit for bit in Flag if bool(((flags & int(bit)) != 0).any())]
    carried = {bit: int(((flags & int(bit)) != 0).sum()) for bit in bits}
    own = np.full(len(flags), -1, dtype=np.int64)
    for place, bit in enumerate(sorted(bits, key=lambda bit: -carried[bit])):
        own[(flags & int(bit)) != 0] = place
    classes = [_flag_class("kept, no flag", KEPT, own == -1)]
    ordered = sorted(bits, key=lambda bit: -carried[bit])
    for place, bit in enumerate(ordered[: len(_FLAG_COLOURS)]):
        classes.append(_flag_class(str(bit.name), _FLAG_COLOURS[place], own == place))
    if len(ordered) > len(_FLAG_COLOURS):
        classes.append(_flag_class("other flags", _OTHER_FLAGS, own >= len(_FLAG_COLOURS)))
    return [entry for entry in classes if entry.count]


def _flag_class(label: str, colour: str, mask: BoolArray) -> FlagClass:
    rows = tuple(np.flatnonzero(mask).tolist())
    return FlagClass(label, colour, len(rows), rows)


def draw_strengths(views: Sequence[ViewPicture]) -> Canvas:
    """Draw the edge strength of all views, with their thresholds (Figs. 5.9 and 5.10)."""
    canvas, places = _grid(views, 24, "Edge strength")
    for view, (corner, size) in zip(views, places, strict=True):
        canvas.picture(corner, size, view.strength, "jpeg")
        _frame(canvas, corner, size)
        text = (
            f"{view.camera}: threshold {significant(view.threshold, 3)} grey levels, "
            f"{percent(view.edge_share)} of the pixels above"
        )
        canvas.text((corner[0], corner[1] - 6), text)
    y = canvas.height - 8
    for x, colour, label in (
        (0.0, "#a5a5a5", "below the threshold"),
        (130.0, "#78143c", "edge pixels; the darker, the stronger"),
    ):
        canvas.add("rect", x=x, y=y - 9, width=12, height=9, fill=colour)
        canvas.text((x + 17, y), label)
    return canvas


def draw_depths(
    views: Sequence[ViewPicture],
    marks_px: Sequence[FloatArray],
    depth_mm: FloatArray,
    axis: str,
) -> Canvas:
    """Draw the kept matches on all views, coloured by depth.

    Parameters
    ----------
    views : sequence of ViewPicture
        C views.
    marks_px : sequence of ndarray, each (N, 2)
        Where each view sees the points.
    depth_mm : ndarray, shape (N,)
        World coordinate along the views.
    axis : str
        Its name.

    Returns
    -------
    Canvas
        As wide as the page, with its colour scale.
    """
    limits = depth_limits(depth_mm)
    colours = depth_colours(depth_mm, limits)
    marks = [Marks(xy, colours) for xy in marks_px]
    canvas = _marked(views, marks, 40, "Matches by depth")
    heat_legend(
        canvas,
        (FULL_WIDTH / 2 - 150, canvas.height - 28),
        300,
        limits,
        f"{axis} [mm] of {counted(len(depth_mm), 'point')} without a flag",
        colour=depth_colour,
    )
    return canvas


def draw_flags(
    views: Sequence[ViewPicture], marks_px: Sequence[FloatArray], flags: IntArray
) -> Canvas:
    """Draw all points on all views, coloured by flag; those without a match only where given."""
    classes = flag_classes(flags)
    order = [row for entry in classes for row in entry.rows]
    colours = [entry.colour for entry in classes for _ in entry.rows]
    lines, per_line = math.ceil(len(classes) / 3), 3
    marks = [Marks(xy[order], colours) for xy in marks_px]
    canvas = _marked(views, marks, 10 + 15 * lines, "Matches by flag")
    for place, entry in enumerate(classes):
        line, column = divmod(place, per_line)
        x = column * FULL_WIDTH / per_line + 6
        y = canvas.height - 15 * (lines - line) + 9
        canvas.add("rect", x=x - 6, y=y - 9, width=12, height=11, fill="#3a3a3a")
        canvas.dot((x, y - 3.5), 3.2, entry.colour)
        canvas.text((x + 10, y), f"{entry.label}: {entry.count}")
    return canvas


def depth_limits(depth_mm: FloatArray) -> Point:
    """Return the ends of a colour scale: all but the outermost hundredth at either end."""
    known = depth_mm[np.isfinite(depth_mm)]
    if not known.size:
        return 0.0, 1.0
    low, high = (float(value) for value in np.quantile(known, [0.01, 0.99]))
    return (low, high) if high > low else (low - 0.5, high + 0.5)


def depth_colours(depth_mm: FloatArray, limits: Point) -> list[str]:
    """Return the colour of each depth."""
    low, high = limits
    return [depth_colour((float(value) - low) / (high - low)) for value in depth_mm]


def _grid(
    views: Sequence[ViewPicture], below: float, title: str
) -> tuple[Canvas, list[tuple[Point, Point]]]:
    """Lay out views side by side in rows of two, with a line of text above each."""
    columns = min(2, len(views))
    width = (FULL_WIDTH - 1 - _GAP * (columns - 1)) / columns
    places: list[tuple[Point, Point]] = []
    y = 0.0
    for start in range(0, len(views), columns):
        row = views[start : start + columns]
        heights = [width * view.size_px[1] / view.size_px[0] for view in row]
        for column, height in enumerate(heights):
            places.append(((0.5 + column * (width + _GAP), y + 17), (width, height)))
        y += 17 + max(heights) + 6
    names = " and ".join(view.camera for view in views)
    canvas = Canvas(FULL_WIDTH, y + below, title, f"{title}, cameras {names}")
    return canvas, places


def _marked(
    views: Sequence[ViewPicture], marks: Sequence[Marks], below: float, title: str
) -> Canvas:
    """Draw views with points on them."""
    canvas, places = _grid(views, below, title)
    for view, mark, (corner, size) in zip(views, marks, places, strict=True):
        canvas.picture(corner, size, view.grey, "jpeg")
        columns = _LAYER * MAX_WIDTH_PX
        scale = columns / view.size_px[0]
        layer = (columns, max(1, round(view.size_px[1] * scale)))
        # pixel (0, 0) is a centre: the picture's corner is at (-0.5, -0.5)
        there = (mark.xy_px + 0.5) * scale - 0.5
        few = len(mark.colours) <= _FEW
        radius = (_FEW_DOT_PX if few else _DOT_PX) * _LAYER
        dots = dot_layer(layer, there, mark.colours, radius=radius)
        canvas.picture(corner, size, dots, "png")
        _frame(canvas, corner, size)
        seen = int(np.isfinite(mark.xy_px).all(axis=1).sum())
        canvas.text((corner[0], corner[1] - 5), f"{view.camera}: {counted(seen, 'point')}")
    return canvas


def _frame(canvas: Canvas, corner: Point, size: Point) -> None:
    canvas.add(
        "rect", x=corner[0], y=corner[1], width=size[0], height=size[1], fill="none",
        stroke=SOFT, stroke_width=0.7,
    )  # fmt: skip


def draw_element(element: ElementPicture) -> Canvas:
    """Draw one point's structuring element, its mapped form, its search and the mismatches."""
    side = (FULL_WIDTH - 1 - 2 * _GAP) / 3
    canvas = Canvas(
        FULL_WIDTH,
        side + 60 + 150,
        "Structuring element and search",
        f"Point {element.point}: element of {element.size_px} px and its search",
    )
    first, second = element.cameras
    titles = (
        f"{first}: element, {element.size_px} \u00d7 {element.size_px} px",
        f"{second}: mapped, at its best place",
        f"{second}: search along the segment",
    )
    panels = [
        _Panel.of(crop, (0.5 + column * (side + _GAP), 18.0), side)
        for column, crop in enumerate(element.crops)
    ]
    for panel, crop, title in zip(panels, element.crops, titles, strict=True):
        canvas.picture(panel.corner, panel.size, crop.picture, "png")
        _frame(canvas, panel.corner, panel.size)
        canvas.text((panel.corner[0], 12), title, font_weight="bold")
    _draw_square(canvas, panels[0], element)
    _draw_pixels(canvas, panels[0], element.element_px, ELEMENT)
    _draw_pixels(canvas, panels[1], element.mapped_px[~element.missing], ELEMENT)
    _draw_pixels(canvas, panels[1], element.mapped_px[element.missing], MISSING)
    _cross(canvas, panels[0], element.seed_px, VERMILION)
    _cross(canvas, panels[1], element.match_px, VERMILION)
    _draw_segment(canvas, panels[2], element)
    _draw_pixels(canvas, panels[2], element.mapped_px, ELEMENT)
    _cross(canvas, panels[2], element.match_px, VERMILION)
    _element_key(canvas, side + 34)
    _draw_profile(canvas, element, side + 72)
    return canvas


@dataclass(frozen=True, slots=True)
class _Panel:
    """A crop on paper."""

    first_px: tuple[int, int]
    corner: Point
    size: Point
    scale: float

    @classmethod
    def of(cls, crop: Crop, corner: Point, side: float) -> _Panel:
        scale = side / max(crop.size_px)
        size = (crop.size_px[0] * scale, crop.size_px[1] * scale)
        return cls(crop.first_px, corner, size, scale)

    def at(self, xy_px: Sequence[float]) -> Point:
        return (
            self.corner[0] + (float(xy_px[0]) - self.first_px[0] + 0.5) * self.scale,
            self.corner[1] + (float(xy_px[1]) - self.first_px[1] + 0.5) * self.scale,
        )


def _draw_square(canvas: Canvas, panel: _Panel, element: ElementPicture) -> None:
    """Draw the border of the element in view 1."""
    half = element.size_px // 2 + 0.5
    x, y = (round(value) for value in element.seed_px)
    (left, top), (right, bottom) = panel.at((x - half, y - half)), panel.at((x + half, y + half))
    canvas.add(
        "rect", x=left, y=top, width=right - left, height=bottom - top, fill="none",
        stroke=ELEMENT, stroke_width=1.2,
    )  # fmt: skip


def _draw_pixels(canvas: Canvas, panel: _Panel, pixels: IntArray, colour: str) -> None:
    centres = [panel.at(pixel) for pixel in pixels.tolist()]
    canvas.squares(centres, 0.72 * panel.scale, fill=colour, fill_opacity=0.85)


def _draw_segment(canvas: Canvas, panel: _Panel, element: ElementPicture) -> None:
    """Draw the segment with its ends."""
    places = [panel.at(place) for place in element.segment_px.tolist()]
    # as wide as the pixels that are searched: those nearest to the segment
    canvas.path(places, stroke=PLACE, stroke_width=max(1.1, panel.scale), stroke_opacity="0.75")
    for end in (places[0], places[-1]):
        canvas.dot(end, 2.2, PLACE)
    for end, word in ((places[0], "near"), (places[-1], "far")):
        right = end[0] > panel.corner[0] + 0.7 * panel.size[0]
        canvas.text(
            (end[0] - 5 if right else end[0] + 5, end[1] - 5), word, fill=PLACE,
            text_anchor="end" if right else "start", stroke="#000000", stroke_width=2.2,
            paint_order="stroke", font_size=10,
        )  # fmt: skip


def _cross(canvas: Canvas, panel: _Panel, xy_px: Point, colour: str) -> None:
    x, y = panel.at(xy_px)
    for stroke, width in (("#ffffff", 3.2), (colour, 1.6)):
        canvas.line((x - 5, y), (x + 5, y), stroke, stroke_width=width)
        canvas.line((x, y - 5), (x, y + 5), stroke, stroke_width=width)


def _element_key(canvas: Canvas, y: float) -> None:
    entries = (
        ("edge pixel of the image", "#4696eb"),
        ("pixel of the element", ELEMENT),
        ("missing in the second view", MISSING),
        ("point and match of the program", VERMILION),
    )
    x = 0.5
    for label, colour in entries:
        canvas.add("rect", x=x, y=y - 9, width=10, height=10, fill=colour, stroke=SOFT)
        canvas.text((x + 14, y), label)
        x += 30 + 5.4 * len(label)


def _draw_profile(canvas: Canvas, element: ElementPicture, top: float) -> None:
    """Plot the mismatch over depth: its minimum is the answer."""
    left, right, bottom = 46.0, FULL_WIDTH - 10, canvas.height - 32
    depth, mismatch = element.depth_mm, element.mismatch
    x = Scale(float(depth.min()), float(depth.max()), left, right)
    y = Scale(0.0, float(max(len(element.mapped_px), 1)), bottom, top)
    for scale, count in ((x, 10), (y, 4)):
        step = nice_step(scale.high - scale.low, count)
        for value in ticks(scale.low, scale.high, count):
            at = scale(value)
            if scale is x:
                canvas.line((at, top), (at, bottom), RULE, stroke_width=0.6)
                canvas.text((at, bottom + 13), tick_text(value, step), text_anchor="middle")
            else:
                canvas.line((left, at), (right, at), RULE, stroke_width=0.6)
                canvas.text((left - 5, at + 4), tick_text(value, step), text_anchor="end")
    places = [(x(float(a)), y(float(b))) for a, b in zip(depth, mismatch, strict=True)]
    canvas.path(places, stroke=BLUE, stroke_width=1.1)
    best = int(np.argmin(mismatch))
    canvas.dot(places[best], 3, VERMILION)
    _frame(canvas, (left, top), (right - left, bottom - top))
    axis, offset = element.plane
    canvas.text(((left + right) / 2, bottom + 27), f"{axis} [mm]", text_anchor="middle")
    total, least = len(element.mapped_px), int(mismatch[best])
    here, plane = fixed(float(depth[best]), 1), fixed(offset, 1)
    text = f"Pixels of the element missing in the second view, of {total}: at least {least}, "
    text += f"at {axis} = {here} mm; mapped through {axis} = {plane} mm"
    canvas.text((0, top - 8), text, fill=INK)
