"""The measuring volume with its predicted error as colour: levels, drawn apart or flat."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from markupsafe import Markup

from closerange.delivery.svg import (
    AXIS_COLOURS,
    FULL_WIDTH,
    PAPER,
    SOFT,
    Drawing,
    Point,
    heat_colour,
    heat_legend,
    ink_on,
    nice_step,
    units,
)
from closerange.delivery.wording import fixed, micrometres
from closerange.geometry.arrays import FloatArray
from closerange.verification.error_map import ErrorMap

_MAX_LEVELS = 3  # lowest, middle, highest: what a page shows without hiding one by another
_PRINTED_CELLS = 9  # up to this many in a row a number of four digits fits into a cell


def draw_volume(error_map: ErrorMap) -> Markup:
    """Draw levels of the volume one above the other, coloured by the error in space.

    Parameters
    ----------
    error_map : ErrorMap
        Predicted standard deviations.

    Returns
    -------
    Markup
        Inline SVG, as wide as the page. The levels keep their order in Z but are drawn apart.
    """
    nodes, std = _on_grid(error_map)
    total_um = 1000 * np.sqrt((std**2).sum(axis=3))
    known = total_um[np.isfinite(total_um)]
    ends = (known.min(), known.max()) if known.size else (np.nan, np.nan)
    top = _round_top(total_um)
    picked = _levels(nodes.shape[2])[::-1]
    tallest = 88.0
    drawing = Drawing(
        FULL_WIDTH,
        64 + len(picked) * (tallest + 16),
        "Predicted error in the measuring volume",
        f"From {micrometres(ends[0] / 1000)} to "
        f"{micrometres(ends[1] / 1000)} µm in space, one standard deviation",
    )
    x_edges, y_edges = _edges(nodes[:, 0, 0, 0]), _edges(nodes[0, :, 0, 1])
    for row, level in enumerate(picked):
        flat = _Shelf(x_edges, y_edges, top=58 + row * (tallest + 16), height=tallest)
        for i in range(total_um.shape[0]):
            for j in range(total_um.shape[1]):
                colour = heat_colour(float(total_um[i, j, level]) / top)
                drawing.path(
                    flat.cell(i, j), closed=True, fill=colour, stroke=PAPER, stroke_width=0.5
                )
        drawing.path(flat.outline(), closed=True, stroke=SOFT, stroke_width=0.8)
        z = f"Z = {_coordinate(nodes[0, 0, level, 2])} mm"
        beside = (flat.at(x_edges[0], float(y_edges.mean()))[0] - 12, flat.middle + 4)
        style: dict[str, str | float] = {"font_weight": "bold", "text_anchor": "end"}
        drawing.text(beside, z, fill=AXIS_COLOURS[2], **style)
        if row == len(picked) - 1:
            _shelf_axes(drawing, flat, x_edges, y_edges)
    label = "predicted error in space (one standard deviation) [µm]"
    heat_legend(drawing, (200, 22), 300, (0.0, top), label)
    return drawing.render()


def draw_slices(error_map: ErrorMap, axis: int) -> Markup:
    """Draw the predicted error of one axis as flat maps at up to three heights.

    Parameters
    ----------
    error_map : ErrorMap
        Predicted standard deviations.
    axis : int
        0 for X, 1 for Y, 2 for Z.

    Returns
    -------
    Markup
        Inline SVG, as wide as the page; numbers in the cells are um.
    """
    nodes, std = _on_grid(error_map)
    values = 1000 * std[:, :, :, axis]
    top = _round_top(values)
    picked = _levels(nodes.shape[2])
    name = "XYZ"[axis]
    drawing = Drawing(
        FULL_WIDTH, 236, f"Predicted error of {name}", f"Flat maps at {len(picked)} heights, in µm"
    )
    heat_legend(
        drawing, (40, 16), 240, (0.0, top), f"{name}: one standard deviation of a position [µm]"
    )
    edges = (_edges(nodes[:, 0, 0, 0]), _edges(nodes[0, :, 0, 1]))
    spans = [float(edge[-1] - edge[0]) for edge in edges]
    scale = min(158 / spans[0], 142 / spans[1])
    for column, level in enumerate(picked):
        corner = (40 + column * 206.0, 72.0)
        title = f"Z = {_coordinate(nodes[0, 0, level, 2])} mm"
        drawing.text((corner[0], corner[1] - 5), title, font_weight="bold")
        _flat_map(drawing, values[:, :, level], edges, corner, scale, top)
    return drawing.render()


class _Shelf:
    """A level seen from above at a slant: X to the right, Y to the back."""

    def __init__(
        self, x_edges: FloatArray, y_edges: FloatArray, *, top: float, height: float
    ) -> None:
        span_x, span_y = float(np.ptp(x_edges)), float(np.ptp(y_edges))
        # Y is foreshortened to a half and slanted by a third, as in a cabinet projection
        scale = min(2 * height / span_y, 330.0 / (span_x + 0.35 * span_y))
        self.x_edges, self.y_edges, self.scale = x_edges, y_edges, scale
        self.bottom = top + height / 2 + 0.25 * scale * span_y
        self.left = 130 + (440 - scale * (span_x + 0.35 * span_y)) / 2
        self.middle = top + height / 2

    def at(self, x: float, y: float) -> Point:
        """Return drawing units of a place on the level."""
        across, back = x - self.x_edges[0], y - self.y_edges[0]
        return (
            float(self.left + self.scale * (across + 0.35 * back)),
            float(self.bottom - 0.5 * self.scale * back),
        )

    def cell(self, i: int, j: int) -> list[Point]:
        """Return the corners of a cell."""
        x, y = self.x_edges, self.y_edges
        return [
            self.at(x[i], y[j]),
            self.at(x[i + 1], y[j]),
            self.at(x[i + 1], y[j + 1]),
            self.at(x[i], y[j + 1]),
        ]

    def outline(self) -> list[Point]:
        """Return the corners of the level."""
        x, y = self.x_edges, self.y_edges
        return [
            self.at(x[0], y[0]),
            self.at(x[-1], y[0]),
            self.at(x[-1], y[-1]),
            self.at(x[0], y[-1]),
        ]


def _shelf_axes(drawing: Drawing, flat: _Shelf, x_edges: FloatArray, y_edges: FloatArray) -> None:
    """Write the range of X along the front and of Y along the right side."""
    for x, anchor in ((x_edges[0], "start"), (x_edges[-1], "end")):
        px, py = flat.at(x, y_edges[0])
        drawing.text((px, py + 14), _coordinate(x), text_anchor=anchor, font_size=10)
    px, py = flat.at(float(x_edges.mean()), y_edges[0])
    style: dict[str, str | float] = {"font_weight": "bold", "text_anchor": "middle"}
    drawing.text((px, py + 15), "X [mm]", fill=AXIS_COLOURS[0], **style)
    for y in (y_edges[0], y_edges[-1]):
        px, py = flat.at(x_edges[-1], y)
        drawing.text((px + 8, py + 3), _coordinate(y), font_size=10)
    px, py = flat.at(x_edges[-1], float(y_edges.mean()))
    drawing.text((px + 32, py + 4), "Y [mm]", fill=AXIS_COLOURS[1], **style)


def _flat_map(
    drawing: Drawing,
    values: FloatArray,
    edges: tuple[FloatArray, FloatArray],
    corner: Point,
    scale: float,
    top: float,
) -> None:
    """Draw one level as a map with X to the right and Y upwards."""
    x_edges, y_edges = edges
    bottom = corner[1] + scale * float(y_edges[-1] - y_edges[0])
    small = max(values.shape) <= _PRINTED_CELLS
    for i, j in np.ndindex(*values.shape):
        x = corner[0] + scale * float(x_edges[i] - x_edges[0])
        y = bottom - scale * float(y_edges[j + 1] - y_edges[0])
        width = scale * float(x_edges[i + 1] - x_edges[i])
        height = scale * float(y_edges[j + 1] - y_edges[j])
        value = float(values[i, j])
        drawing.add(
            "rect",
            x=x,
            y=y,
            width=width,
            height=height,
            fill=heat_colour(value / top),
            stroke=PAPER,
            stroke_width=0.4,
        )
        if small and min(width, height) >= 13:
            drawing.text(
                (x + width / 2, y + height / 2 + 3),
                micrometres(value / 1000),
                text_anchor="middle",
                font_size=8.5,
                fill=ink_on(value / top),
            )
    _map_axes(drawing, edges, corner, scale)


def _map_axes(
    drawing: Drawing, edges: tuple[FloatArray, FloatArray], corner: Point, scale: float
) -> None:
    """Write the ranges of X below and of Y at the left of a flat map."""
    x_edges, y_edges = edges
    bottom = corner[1] + scale * float(y_edges[-1] - y_edges[0])
    for x, anchor in ((x_edges[0], "start"), (x_edges[-1], "end")):
        place = corner[0] + scale * float(x - x_edges[0])
        drawing.text((place, bottom + 12), _coordinate(x), text_anchor=anchor, font_size=10)
    middle = corner[0] + scale * float(x_edges[-1] - x_edges[0]) / 2
    drawing.text((middle, bottom + 12), "X [mm]", text_anchor="middle", font_size=10)
    for y in (y_edges[0], y_edges[-1]):
        place = bottom - scale * float(y - y_edges[0])
        low = place + (0 if y == y_edges[0] else 8)
        drawing.text((corner[0] - 4, low), _coordinate(y), text_anchor="end", font_size=10)
    middle = (corner[1] + bottom) / 2
    turn = f"rotate(-90 {units(corner[0] - 6)} {units(middle)})"
    drawing.text(
        (corner[0] - 6, middle), "Y [mm]", text_anchor="middle", font_size=10, transform=turn
    )


def _on_grid(error_map: ErrorMap) -> tuple[FloatArray, FloatArray]:
    """Return nodes and standard deviations as (nx, ny, nz, 3)."""
    shape = tuple(int(count) for count in error_map.shape)
    return error_map.xyz_mm.reshape(*shape, 3), error_map.std_mm.reshape(*shape, 3)


def _levels(count: int) -> list[int]:
    """Pick the lowest, middle and highest of some levels."""
    wanted = min(count, _MAX_LEVELS)
    return sorted({round(i) for i in np.linspace(0, count - 1, wanted)})


def _edges(nodes: FloatArray) -> FloatArray:
    """Return the edges of the cells around nodes; the outer ones end at the outer nodes."""
    if len(nodes) == 1:
        return np.array([nodes[0] - 0.5, nodes[0] + 0.5])
    middle = (nodes[1:] + nodes[:-1]) / 2
    return np.concatenate([nodes[:1], middle, nodes[-1:]])


def _round_top(values: FloatArray) -> float:
    """Return a round number at or above all values, for the dark end of the scale."""
    finite: Sequence[float] = values[np.isfinite(values)].tolist()
    highest = max(finite, default=0.0)
    if highest <= 0:
        return 1.0
    step = nice_step(highest, 4)
    return float(np.ceil(highest / step - 1e-9) * step)


def _coordinate(value: float) -> str:
    """Write a coordinate of a grid: whole mm where that says it all."""
    text = fixed(float(value), 1)
    return text.removesuffix(".0")
