"""Cameras, points and the measuring volume in parallel projection, with axes in mm."""

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
    PURPLE,
    RULE,
    SOFT,
    Drawing,
    Point,
    heat_colour,
    heat_legend,
    nice_step,
    tick_text,
    ticks,
)
from closerange.geometry.arrays import FloatArray
from closerange.rig.camera import Camera
from closerange.rig.rig import Rig

# seen from the front right and above; the turn keeps X and Y edges apart, the height keeps the
# floor open without hiding what stands on it
_AZIMUTH, _ELEVATION = math.radians(-62), math.radians(24)
_MARGIN = 46.0


@dataclass(frozen=True, slots=True, eq=False)
class Group:
    """Points of one kind.

    Attributes
    ----------
    label : str
        For the legend.
    xyz_mm : ndarray, shape (N, 3)
        Where; NaN is left out.
    colours : sequence of str
        One for all, or one a point.
    """

    label: str
    xyz_mm: FloatArray
    colours: Sequence[str]


class ParallelView:
    """A parallel projection fitted to a box of the world.

    Z points up on paper, or down where the cameras look from below along +Z: what is nearer to
    the cameras is then on top in either case.
    """

    def __init__(
        self, low: FloatArray, high: FloatArray, size: tuple[float, float], *, up: float
    ) -> None:
        across, depth = math.cos(_AZIMUTH), math.sin(_AZIMUTH)
        tilt, rise = math.sin(_ELEVATION), math.cos(_ELEVATION)
        right = np.array([-depth, across * up, 0.0])
        back = np.array([across * rise, depth * rise * up, tilt * up])  # towards the viewer
        self.axes = np.stack([right, -np.cross(back, right), back])
        self.low, self.high, self.up = low, high, up
        corners = self.axes @ _corners(low, high).T
        span = np.ptp(corners[:2], axis=1)
        room = np.array(size) - 2 * _MARGIN
        self.scale = float((room / np.maximum(span, 1e-9)).min())
        middle = (corners[:2].min(axis=1) + corners[:2].max(axis=1)) / 2
        self.shift = np.array(size) / 2 - self.scale * middle

    def __call__(self, xyz_mm: ArrayLike) -> Point:
        """Return drawing units of one point."""
        flat = self.scale * (self.axes[:2] @ np.asarray(xyz_mm, np.float64)) + self.shift
        return float(flat[0]), float(flat[1])

    def order(self, xyz_mm: FloatArray) -> list[int]:
        """Return rows from the farthest to the nearest, for painting."""
        return [int(row) for row in np.argsort(xyz_mm @ self.axes[2], kind="stable")]

    @property
    def floor_mm(self) -> float:
        """Z of the side of the box that lies at the bottom on paper."""
        return float(self.low[2] if self.up > 0 else self.high[2])


def draw_layout(rig: Rig, *, width: float = FULL_WIDTH) -> Markup:
    """Draw where the cameras stand and where they look.

    Parameters
    ----------
    rig : Rig
        Cameras and measuring volume.
    width : float, optional
        Of the figure, drawing units.

    Returns
    -------
    Markup
        Inline SVG.
    """
    centres = np.stack([camera.centre_mm for camera in rig.cameras])
    reach = float(np.median(np.linalg.norm(centres - rig.volume_mm.mean(axis=0), axis=1)))
    frusta = [_frustum(camera, 0.16 * reach) for camera in rig.cameras]
    everything = np.concatenate([rig.volume_mm, *frusta])
    low, high = everything.min(axis=0), everything.max(axis=0)
    # air keeps the cameras' names off the axes, which stand on the box
    air = 0.09 * float((high - low).max())
    low, high = low - air, high + air
    drawing = Drawing(
        width,
        380,
        "Cameras and measuring volume",
        f"{len(rig.cameras)} cameras around the measuring volume, axes in mm",
    )
    view = ParallelView(low, high, (width, drawing.height - 26), up=_up(rig))
    draw_axes(drawing, view)
    draw_box(drawing, view, rig.volume_mm, PURPLE)
    for camera, frustum in zip(rig.cameras, frusta, strict=True):
        _draw_camera(drawing, view, camera, frustum)
        ahead = camera.camera_from_world.rotation[2]
        distance = float((rig.volume_mm.mean(axis=0) - camera.centre_mm) @ ahead)
        end = camera.centre_mm + max(distance, 0.0) * ahead
        drawing.line(
            view(camera.centre_mm), view(end), SOFT, stroke_width=0.7, stroke_dasharray="6 4"
        )
    _key(drawing, [("measuring volume", PURPLE), ("camera and its field", BLUE)])
    return drawing.render()


def draw_points(
    groups: Sequence[Group], *, volume_mm: ArrayLike, up: float, title: str, description: str
) -> Markup:
    """Draw points in and around the measuring volume.

    Parameters
    ----------
    groups : sequence of Group
        Kinds of points, each with its colour.
    volume_mm : array_like, shape (2, 3)
        Measuring volume.
    up : float
        +1 if Z points up on paper, -1 if down; see `paper_up`.
    title, description : str
        For screen readers.

    Returns
    -------
    Markup
        Inline SVG, half as wide as the page, with a legend.
    """
    drawing = Drawing(FULL_WIDTH / 2, 380, title, description)
    _cloud(drawing, groups, np.asarray(volume_mm, np.float64), up)
    _key(drawing, [(group.label, group.colours[0]) for group in groups if len(group.xyz_mm)])
    return drawing.render()


def draw_values(
    xyz_mm: ArrayLike,
    values: ArrayLike,
    *,
    volume_mm: ArrayLike,
    up: float,
    label: str,
    title: str,
    description: str,
) -> Markup:
    """Draw points whose colour is a value.

    Parameters
    ----------
    xyz_mm : array_like, shape (N, 3)
        Where.
    values : array_like, shape (N,)
        What the colour means, from 0; NaN is grey.
    volume_mm, up, title, description
        As in `draw_points`.
    label : str
        Name and unit of the values.

    Returns
    -------
    Markup
        Inline SVG, as wide as the page, with its colour scale.
    """
    xyz = np.reshape(np.asarray(xyz_mm, np.float64), (-1, 3))
    numbers = np.asarray(values, np.float64)
    top = float(np.nanmax(numbers)) if np.isfinite(numbers).any() else 1.0
    top = top if top > 0 else 1.0
    drawing = Drawing(FULL_WIDTH, 360, title, description)
    colours = [heat_colour(float(value) / top) for value in numbers]
    _cloud(drawing, [Group("", xyz, colours)], np.asarray(volume_mm, np.float64), up, radius=4.2)
    heat_legend(drawing, (FULL_WIDTH - 190, 22), 170, (0.0, top), label)
    return drawing.render()


def paper_up(cameras: Sequence[Camera], volume_mm: ArrayLike) -> float:
    """Return +1 if Z should point up on paper, -1 if down: towards the cameras."""
    middle = np.asarray(volume_mm, np.float64).mean(axis=0)
    heights = [camera.centre_mm[2] - middle[2] for camera in cameras]
    return 1.0 if sum(heights) >= 0 else -1.0


def _up(rig: Rig) -> float:
    return paper_up(rig.cameras, rig.volume_mm)


def _cloud(
    drawing: Drawing,
    groups: Sequence[Group],
    volume_mm: FloatArray,
    up: float,
    *,
    radius: float = 2.6,
) -> None:
    """Draw the box and, from back to front, points with thin lines down to the floor."""
    rows = [group.xyz_mm[np.isfinite(group.xyz_mm).all(axis=1)] for group in groups]
    everything = np.concatenate([volume_mm, *rows])
    low, high = everything.min(axis=0), everything.max(axis=0)
    # a flat box would have no edges to carry the axes
    air = np.maximum(0.02 * (high - low), 0.04 * max(float((high - low).max()), 1e-6))
    view = ParallelView(low - air, high + air, (drawing.width, drawing.height - 26), up=up)
    draw_axes(drawing, view)
    draw_box(drawing, view, volume_mm, PURPLE)
    xyz = np.concatenate([np.empty((0, 3)), *(group.xyz_mm for group in groups)])
    colours = [
        group.colours[row if len(group.colours) > 1 else 0]
        for group in groups
        for row in range(len(group.xyz_mm))
    ]
    known = [row for row in view.order(xyz) if np.isfinite(xyz[row]).all()]
    for row in known if len(known) <= 400 else []:
        foot = (*xyz[row, :2], view.floor_mm)
        drawing.line(view(xyz[row]), view(foot), "#bbbbbb", stroke_width=0.4)
    for row in known:
        drawing.dot(view(xyz[row]), radius, colours[row], stroke="#555555", stroke_width=0.4)


def _frustum(camera: Camera, depth_mm: float) -> FloatArray:
    """Return projection centre and the four corners of the field at a depth, (5, 3)."""
    width, height = camera.size_px
    corners = np.array([[0, 0, 1], [width, 0, 1], [width, height, 1], [0, height, 1]], np.float64)
    # ideal rays: a lens model may not reach as far as the corners
    rays = (corners - (0.5, 0.5, 0)) @ np.linalg.inv(camera.matrix_px).T
    world = camera.camera_from_world.inverse()
    points: FloatArray = world.apply(np.concatenate([np.zeros((1, 3)), depth_mm * rays]))
    return points


def _draw_camera(drawing: Drawing, view: ParallelView, camera: Camera, frustum: FloatArray) -> None:
    centre, *corners = (view(point) for point in frustum)
    drawing.path(corners, closed=True, fill=BLUE, fill_opacity="0.15", stroke=BLUE)
    for corner in corners:
        drawing.line(centre, corner, BLUE, stroke_width=0.8)
    drawing.dot(centre, 3, BLUE)
    drawing.text((centre[0], centre[1] - 8), camera.name, text_anchor="middle", font_weight="bold")


def draw_axes(drawing: Drawing, view: ParallelView) -> None:
    """Draw a grid on the floor and ticks in mm along one edge of each axis."""
    low, high, floor = view.low, view.high, view.floor_mm
    # the edges in front carry X and Y; the edge at the left end carries Z
    front = [high[axis] if view.axes[2][axis] > 0 else low[axis] for axis in (0, 1)]
    far = [low[axis] if view.axes[2][axis] > 0 else high[axis] for axis in (0, 1)]
    for axis in (0, 1):
        other = 1 - axis
        for value in _axis_ticks(view, axis):
            ends = [np.empty(3), np.empty(3)]
            for end, place in zip(ends, (front[other], far[other]), strict=True):
                end[axis], end[other], end[2] = value, place, floor
            drawing.line(view(ends[0]), view(ends[1]), RULE, stroke_width=0.7)
        _axis_line(drawing, view, axis, front[other])
    corners = [(x, y, floor) for x, y in ((low[0], low[1]), (high[0], low[1]))]
    corners += [(x, y, floor) for x, y in ((high[0], high[1]), (low[0], high[1]))]
    drawing.path([view(corner) for corner in corners], closed=True, stroke=SOFT, stroke_width=0.7)
    _height_line(drawing, view, min(corners, key=lambda corner: view(corner)[0]))


def _axis_ticks(view: ParallelView, axis: int) -> list[float]:
    return ticks(float(view.low[axis]), float(view.high[axis]), _tick_count(view, axis))


def _tick_count(view: ParallelView, axis: int) -> int:
    """As many ticks as the edge's length on paper has room for."""
    span = float(view.high[axis] - view.low[axis])
    along = np.hypot(*view.axes[:2, axis]) * view.scale * span
    return max(2, min(6, int(along / 42)))


def _axis_line(drawing: Drawing, view: ParallelView, axis: int, place: float) -> None:
    """Write ticks and the name of a horizontal axis along the front edge."""
    step = nice_step(float(view.high[axis] - view.low[axis]), _tick_count(view, axis))
    at = np.empty(3)
    at[1 - axis], at[2] = place, view.floor_mm
    for value in _axis_ticks(view, axis):
        at[axis] = value
        x, y = view(at)
        drawing.text((x, y + 14), tick_text(value, step), text_anchor="middle", font_size=10)
    at[axis] = (view.low[axis] + view.high[axis]) / 2
    x, y = view(at)
    side = -1 if x < drawing.width / 2 else 1
    drawing.text(
        (x + 16 * side, y + 30),
        f"{'XYZ'[axis]} [mm]",
        text_anchor="middle",
        fill=AXIS_COLOURS[axis],
        font_weight="bold",
    )


def _height_line(drawing: Drawing, view: ParallelView, corner: tuple[float, float, float]) -> None:
    """Draw the upright axis with its ticks."""
    x, y, _ = corner
    start, end = view((x, y, view.low[2])), view((x, y, view.high[2]))
    drawing.line(start, end, SOFT, stroke_width=0.7)
    step = nice_step(float(view.high[2] - view.low[2]), _tick_count(view, 2))
    for value in _axis_ticks(view, 2):
        px, py = view((x, y, value))
        drawing.line((px - 3, py), (px, py), SOFT, stroke_width=0.7)
        drawing.text((px - 6, py + 4), tick_text(value, step), text_anchor="end", font_size=10)
    top = min(start[1], end[1])
    drawing.text(
        (start[0], top - 10),
        "Z [mm]",
        text_anchor="middle",
        fill=AXIS_COLOURS[2],
        font_weight="bold",
    )


def draw_box(drawing: Drawing, view: ParallelView, box_mm: FloatArray, colour: str) -> None:
    """Draw the twelve edges of a box."""
    corners = _corners(box_mm[0], box_mm[1])
    for i in range(8):
        for bit in (1, 2, 4):
            if not i & bit:
                ends = (view(corners[i]), view(corners[i | bit]))
                drawing.line(*ends, colour, stroke_width=0.9, stroke_opacity="0.7")


def _corners(low: FloatArray, high: FloatArray) -> FloatArray:
    picks = [[(i >> axis) & 1 for axis in range(3)] for i in range(8)]
    return np.where(np.array(picks, bool), high, low)


def _key(drawing: Drawing, entries: Sequence[tuple[str, str]]) -> None:
    """Write the legend below the picture, from left to right."""
    x = 12.0
    for label, colour in entries:
        drawing.dot((x, drawing.height - 12), 3.5, colour)
        drawing.text((x + 8, drawing.height - 8), label)
        x += 26 + 5.6 * len(label)  # a letter is about half as wide as high
