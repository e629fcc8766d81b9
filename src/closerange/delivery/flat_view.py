"""A flat view of the world with axes in mm, as a window into which a drawing puts shapes."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from closerange.delivery.svg import (
    AXIS_COLOURS,
    FULL_WIDTH,
    RULE,
    SOFT,
    Drawing,
    Point,
    nice_step,
    tick_text,
    ticks,
)
from closerange.geometry.arrays import FloatArray

HEIGHT = 280.0
"""Of a window with its titles and ticks, in drawing units; it is half as wide as the page."""

_LEFT, _RIGHT, _TOP, _BOTTOM = 44.0, 10.0, 40.0, 34.0


@dataclass(frozen=True, slots=True, eq=False)
class Window:
    """A flat view of the world: one axis to the right, the depth upwards or downwards.

    `low` and `high` are its limits along the two axes in mm, `corner` the upper left corner of
    its frame and `size` the frame's width and height in drawing units.
    """

    axes: tuple[int, int]
    low: FloatArray
    high: FloatArray
    corner: Point
    size: Point
    up: float

    @classmethod
    def around(
        cls, xyz_mm: FloatArray, axes: tuple[int, int], *, corner: Point, up: float, air: float
    ) -> Window:
        """Fit points with air around; equal scales show more along one axis."""
        size = (FULL_WIDTH / 2 - _LEFT - _RIGHT, HEIGHT - _TOP - _BOTTOM)
        flat = xyz_mm[:, axes]
        low, high = flat.min(axis=0), flat.max(axis=0)
        room = air * float((high - low).max()) or 1.0
        span = high - low + 2 * room
        spare = np.array(size) * float((span / size).max()) - span
        low, high = low - room - spare / 2, high + room + spare / 2
        return cls(axes, low, high, (corner[0] + _LEFT, corner[1] + _TOP), size, up)

    def at(self, across: float, depth: float) -> Point:
        """Return drawing units of a place."""
        scale = self.size[0] / float(self.high[0] - self.low[0])
        down = self.high[1] - depth if self.up > 0 else depth - self.low[1]
        return (
            float(self.corner[0] + scale * (across - self.low[0])),
            float(self.corner[1] + scale * down),
        )

    def of(self, xyz_mm: FloatArray) -> Point:
        """Return drawing units of a world point."""
        return self.at(float(xyz_mm[self.axes[0]]), float(xyz_mm[self.axes[1]]))

    @property
    def bottom(self) -> float:
        """Lower end of the frame in drawing units."""
        return self.corner[1] + self.size[1]


def inside_frame(window: Window, outline: Sequence[Point]) -> list[Point]:
    """Move points that lie half a node outside onto the frame."""
    left, top = window.corner
    right, bottom = left + window.size[0], window.bottom
    return [(min(max(x, left), right), min(max(y, top), bottom)) for x, y in outline]


def draw_frame(drawing: Drawing, window: Window, title: str, detail: str) -> None:
    """Draw titles, grid lines and ticks in mm, and the frame."""
    left, top = window.corner
    drawing.text((left, top - 24), title, font_weight="bold")
    drawing.text((left, top - 9), detail, fill=SOFT)
    for place in (0, 1):
        low, high = float(window.low[place]), float(window.high[place])
        count = max(2, min(6, int(window.size[place] / 44)))
        step = nice_step(high - low, count)
        for value in ticks(low, high, count):
            text = tick_text(value, step)
            if place == 0:
                x, _ = window.at(value, float(window.low[1]))
                drawing.line((x, top), (x, window.bottom), RULE, stroke_width=0.6)
                drawing.text((x, window.bottom + 13), text, text_anchor="middle", font_size=10)
            else:
                _, y = window.at(float(window.low[0]), value)
                drawing.line((left, y), (left + window.size[0], y), RULE, stroke_width=0.6)
                drawing.text((left - 4, y + 3.5), text, text_anchor="end", font_size=10)
    drawing.add(
        "rect",
        x=left,
        y=top,
        width=window.size[0],
        height=window.size[1],
        fill="none",
        stroke=SOFT,
        stroke_width=0.7,
    )
    across, deep = window.axes
    middle = left + window.size[0] / 2
    bold: dict[str, str | float] = {"font_weight": "bold"}
    drawing.text(
        (middle, window.bottom + 27),
        f"{'XYZ'[across]} [mm]",
        text_anchor="middle",
        fill=AXIS_COLOURS[across],
        **bold,
    )
    drawing.text((left - 40, top - 9), f"{'XYZ'[deep]} [mm]", fill=AXIS_COLOURS[deep], **bold)
