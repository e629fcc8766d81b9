"""Matched edges in space: lines between neighbours, drawn with their depth as colour."""

from __future__ import annotations

import re
from collections.abc import Sequence

import numpy as np

from closerange.delivery.canvas import Canvas
from closerange.delivery.layout3d import ParallelView, draw_axes, draw_box
from closerange.delivery.svg import (
    FULL_WIDTH,
    PURPLE,
    Point,
    depth_colour,
    heat_legend,
)
from closerange.geometry.arrays import FloatArray, IntArray

STEEPEST = 5.0
"""Length of a line, per the median length, above which it is left out: an edge so steep that points
a pixel apart lie five times as far apart in space is seen at 80 degrees, where it hardly is one
edge any more."""

_NAME = re.compile(r"e(\d+)\.(\d+)")

MOST_POINTS = 4000
"""Points of a picture: of more, every second or third is drawn; paper shows no more of them."""

SHADES = 24
"""Colours of a picture; all lines of one colour are one element."""

_ON_PAPER = 0.78  # of the brightness of colours that are made for dark pictures


def neighbours(point: Sequence[str], xyz_mm: FloatArray) -> IntArray:
    """Return pairs of points that follow each other on an edge.

    Parameters
    ----------
    point : sequence of str
        N names; ``e{chain}.{place}`` for edge points, others have no neighbours.
    xyz_mm : ndarray, shape (N, 3)
        Positions.

    Returns
    -------
    ndarray of int, shape (M, 2)
        Rows; without pairs that are much farther apart than usual, as where one edge passes
        behind another.
    """
    row_of: dict[tuple[int, int], int] = {}
    for row, name in enumerate(point):
        found = _NAME.fullmatch(name)
        if found:
            row_of[int(found[1]), int(found[2])] = row
    pairs = np.array(
        [
            (row, row_of[chain, place + 1])
            for (chain, place), row in row_of.items()
            if (chain, place + 1) in row_of
        ],
        dtype=np.int64,
    ).reshape(-1, 2)
    if not len(pairs):
        return pairs
    length = np.linalg.norm(xyz_mm[pairs[:, 1]] - xyz_mm[pairs[:, 0]], axis=1)
    return np.asarray(pairs[length <= STEEPEST * np.median(length)])


def draw_wire(
    xyz_mm: FloatArray,
    pairs: IntArray,
    depth_mm: FloatArray,
    *,
    volume_mm: FloatArray,
    up: float,
    limits: Point,
    label: str,
) -> Canvas:
    """Draw points in space and the lines between them, coloured by depth.

    Parameters
    ----------
    xyz_mm : ndarray, shape (N, 3)
        Points; all known.
    pairs : ndarray of int, shape (M, 2)
        Rows that are joined; see `neighbours`.
    depth_mm : ndarray, shape (N,)
        What the colour means.
    volume_mm : ndarray, shape (2, 3)
        The measuring volume, for orientation.
    up : float
        +1 if Z points up on paper, -1 if down; see `closerange.delivery.layout3d.paper_up`.
    limits : tuple of float
        Ends of the colour scale.
    label : str
        Of the colour scale, with unit.

    Returns
    -------
    Canvas
        As wide as the page.
    """
    canvas = Canvas(
        FULL_WIDTH, 420, "Matched edges in space", f"{len(xyz_mm)} points, coloured by depth"
    )
    everything = np.concatenate([volume_mm, xyz_mm])
    low, high = everything.min(axis=0), everything.max(axis=0)
    air = np.maximum(0.02 * (high - low), 0.04 * max(float((high - low).max()), 1e-6))
    view = ParallelView(low - air, high + air, (FULL_WIDTH, canvas.height - 20), up=up)
    draw_axes(canvas, view)
    draw_box(canvas, view, volume_mm, PURPLE)
    shade = _shades(depth_mm, limits)
    flat = [view(point) for point in xyz_mm]
    kept = np.arange(len(xyz_mm))[:: 1 + len(xyz_mm) // MOST_POINTS]
    for number in range(SHADES):
        colour = paper_colour((number + 0.5) / SHADES)
        lines = pairs[shade[pairs[:, 0]] == number] if len(pairs) else pairs
        canvas.segments([(flat[a], flat[b]) for a, b in lines.tolist()], colour, 1.1)
        canvas.dots([flat[row] for row in kept[shade[kept] == number].tolist()], 0.9, colour)
    heat_legend(canvas, (FULL_WIDTH - 190, 22), 170, limits, label, colour=paper_colour)
    return canvas


def paper_colour(fraction: float) -> str:
    """Return the colour of a depth on a white ground; see `depth_colour`."""
    bright = depth_colour(fraction)
    parts = (int(bright[place : place + 2], 16) for place in (1, 3, 5))
    return "#" + "".join(f"{round(_ON_PAPER * part):02x}" for part in parts)


def _shades(depth_mm: FloatArray, limits: Point) -> IntArray:
    low, high = limits
    share = (depth_mm - low) / (high - low)
    return np.asarray(np.clip(np.floor(share * SHADES), 0, SHADES - 1), np.int64)
