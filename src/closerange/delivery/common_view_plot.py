"""What the cameras see in common, as in Figs. 5.1 and 5.2 of the thesis, and a volume in it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from markupsafe import Markup
from numpy.typing import ArrayLike

from closerange.delivery.svg import (
    AXIS_COLOURS,
    BLUE,
    FULL_WIDTH,
    GREEN,
    PURPLE,
    RULE,
    SOFT,
    Drawing,
    Point,
    nice_step,
    tick_text,
    ticks,
)
from closerange.delivery.wording import fixed, short_length
from closerange.geometry.arrays import BoolArray, FloatArray
from closerange.matching.common_view import (
    CommonView,
    common_view,
    mean_direction,
    parallel_axes,
    shared_field,
)
from closerange.matching.view_grid import sees_points
from closerange.rig.camera import Camera

_SECTION_NODES = 121
"""Nodes along each side of a section: one every two drawing units, so that edges look straight."""

_BEYOND = 0.35
"""The lower row shows this much of the volume's sides beyond the volume, and the fields end this
much of its depth behind it."""

_HEIGHT = 280.0
_LEFT, _RIGHT, _TOP, _BOTTOM = 44.0, 10.0, 40.0, 34.0


@dataclass(frozen=True, slots=True, eq=False)
class _Window:
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
    ) -> _Window:
        """Fit points with air around; equal scales show more along one axis."""
        size = (FULL_WIDTH / 2 - _LEFT - _RIGHT, _HEIGHT - _TOP - _BOTTOM)
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


@dataclass(frozen=True, slots=True, eq=False)
class _Field:
    """Cameras, and how many of them must see a place."""

    cameras: tuple[Camera, ...]
    least: int


def draw_common_view(cameras: Sequence[Camera], view: CommonView, volume_mm: ArrayLike) -> Markup:
    """Draw cameras with their common field, the same with parallel axes, and a volume within.

    Parameters
    ----------
    cameras : sequence of Camera
        Those of `view`.
    view : CommonView
        Their common view.
    volume_mm : array_like, shape (2, 3)
        Measuring volume, proposed or in use.

    Returns
    -------
    Markup
        Inline SVG, as wide as the page. Above: the cameras as they stand (Fig. 5.2) and turned
        until their axes are parallel (Fig. 5.1). Below: sections of the common field through the
        middle of the volume, along either axis across the depth.
    """
    volume = np.asarray(volume_mm, np.float64)
    middle = volume.mean(axis=0)
    sides = " x ".join(_short(side) for side in volume[1] - volume[0])
    drawing = Drawing(
        FULL_WIDTH,
        2 * _HEIGHT + 26,
        "Common field of view",
        f"{len(cameras)} cameras and a volume of {sides} mm in what {view.least} of them see",
    )
    up = 1.0 if float(mean_direction(cameras)[view.depth_axis]) < 0 else -1.0
    across = [axis for axis in range(3) if axis != view.depth_axis]
    centres = np.stack([camera.centre_mm for camera in cameras])
    widest = max(across, key=lambda axis: float(np.ptp(centres[:, axis])))
    fields = (_Field(tuple(cameras), view.least), _Field(parallel_axes(cameras), view.least))
    far = _far(cameras, volume)
    frusta = [[_frustum(camera, field, far) for camera in field.cameras] for field in fields]
    everything = np.concatenate([volume, *(frustum for group in frusta for frustum in group)])
    for column, (field, words) in enumerate(
        zip(fields, ("as they stand", "with parallel axes"), strict=True)
    ):
        window = _Window.around(
            everything,
            (widest, view.depth_axis),
            corner=(column * FULL_WIDTH / 2, 0),
            up=up,
            air=0.09,  # room for the cameras' names
        )
        shares = shared_field(field.cameras, middle, least=view.least)
        detail = f"shared part of the images: {_percents(shares)}"
        _frame(drawing, window, f"Cameras {words}", detail)
        _common(drawing, window, field, middle, far=far)
        _box(drawing, window, volume)
        for camera, frustum in zip(field.cameras, frusta[column], strict=True):
            _camera(drawing, window, camera, frustum)
    for column, axis in enumerate(across):
        corner = (column * FULL_WIDTH / 2, _HEIGHT)
        _section(drawing, fields[0], view, volume, axis, corner=corner, up=up)
    _key(drawing, view)
    return drawing.render()


def _section(
    drawing: Drawing,
    field: _Field,
    view: CommonView,
    volume: FloatArray,
    axis: int,
    *,
    corner: Point,
    up: float,
) -> None:
    """Draw the common field around the volume, cut through the volume's middle."""
    beyond = _BEYOND * (volume[1] - volume[0])
    window = _Window.around(
        np.stack([volume[0] - beyond, volume[1] + beyond]),
        (axis, view.depth_axis),
        corner=corner,
        up=up,
        air=0.0,
    )
    middle = volume.mean(axis=0)
    names, cut = "XYZ", 3 - axis - view.depth_axis
    size = f"{_short(volume[1, axis] - volume[0, axis])} mm in {names[axis]}"
    depth = f"{_short(volume[1, view.depth_axis] - volume[0, view.depth_axis])} mm"
    _frame(
        drawing,
        window,
        f"Section at {names[cut]} = {_short(middle[cut])} mm",
        f"volume: {size}, {depth} in {names[view.depth_axis]}",
    )
    _common(drawing, window, field, middle)
    _box(drawing, window, volume)
    beside = window.of(volume[1])[0] + 6
    for level, std in _depth_errors(field, view, volume):
        _, y = window.at(float(middle[axis]), level)
        text = f"{names[view.depth_axis]} ± {short_length(std)}"
        drawing.text((beside, y + 4), text, fill=PURPLE)


def _depth_errors(field: _Field, view: CommonView, volume: FloatArray) -> list[tuple[float, float]]:
    """Return the typical depth error at the ends and in the middle of the volume."""
    cell = (volume[1] - volume[0]) / 2
    around = np.stack([volume[0] - cell / 2, volume[1] + cell / 2])  # nodes on the walls
    close = common_view(
        field.cameras, least=view.least, noise_px=view.noise_px, nodes=3, within_mm=around
    )
    return list(zip(close.depths_mm.tolist(), close.depth_std_mm.tolist(), strict=True))


def _far(cameras: Sequence[Camera], volume: FloatArray) -> float:
    """Return where fields are cut off, along the viewing direction: a little behind the volume."""
    picks = [[(i >> axis) & 1 for axis in range(3)] for i in range(8)]
    corners = np.where(np.array(picks, np.bool_), volume[1], volume[0]) @ mean_direction(cameras)
    return float(corners.max() + _BEYOND * np.ptp(corners))


def _frustum(camera: Camera, field: _Field, far: float) -> FloatArray:
    """Return the projection centre and the corners of the field where it is cut off, (5, 3)."""
    normal = mean_direction(field.cameras)
    width, height = camera.size_px
    pixels = np.array([[0, 0, 1], [width, 0, 1], [width, height, 1], [0, height, 1]], np.float64)
    # ideal rays: a lens model may not reach as far as the corners
    rays = (pixels - (0.5, 0.5, 0)) @ np.linalg.inv(camera.matrix_px).T
    rays = rays @ camera.camera_from_world.rotation
    reach = float(far - normal @ camera.centre_mm)
    # a ray across the viewing direction would never end: at most as long as the way is deep
    steepness = np.maximum(rays @ normal, 0.5 * np.linalg.norm(rays, axis=1))
    ends = camera.centre_mm + rays * (max(reach, 1e-9) / steepness)[:, None]
    return np.concatenate([camera.centre_mm[None], ends])


def _camera(drawing: Drawing, window: _Window, camera: Camera, frustum: FloatArray) -> None:
    """Draw a camera's name and its field as the outline of its pyramid."""
    points = [window.of(point) for point in frustum]
    outline = _hull(points)
    drawing.path(
        outline, closed=True, fill=BLUE, fill_opacity="0.07", stroke=BLUE, stroke_width=0.8
    )
    x, y = points[0]
    drawing.dot((x, y), 3, BLUE)
    # the name stands where the field is not: behind the camera
    behind = -7.0 if np.mean([point[1] for point in points[1:]]) > y else 15.0
    anchor = "start" if x < window.corner[0] + 30 else "middle"
    anchor = "end" if x > window.corner[0] + window.size[0] - 30 else anchor
    drawing.text((x, y + behind), camera.name, text_anchor=anchor, font_weight="bold")


def _hull(points: Sequence[Point]) -> list[Point]:
    """Return the convex outline of a few points, by Andrew's monotone chain."""
    ordered = sorted(set(points))
    chains: list[list[Point]] = []
    for run in (ordered, ordered[::-1]):
        chain: list[Point] = []
        for point in run:
            while len(chain) > 1 and _turn(chain[-2], chain[-1], point) <= 0:
                chain.pop()
            chain.append(point)
        chains.append(chain[:-1])
    return chains[0] + chains[1]


def _turn(a: Point, b: Point, c: Point) -> float:
    return (b[0] - a[0]) * (c[1] - a[1]) - (b[1] - a[1]) * (c[0] - a[0])


def _common(
    drawing: Drawing, window: _Window, field: _Field, middle: FloatArray, *, far: float = np.inf
) -> None:
    """Fill what enough cameras see of the plane of the drawing through the volume's middle.

    Nothing is drawn beyond `far` along the viewing direction, where the fields are cut off too.
    """
    across = np.linspace(window.low[0], window.high[0], _SECTION_NODES)
    depth = np.linspace(window.low[1], window.high[1], _SECTION_NODES)
    step, half = float(across[1] - across[0]), float(depth[1] - depth[0]) / 2

    def sees(x: FloatArray, z: FloatArray) -> BoolArray:
        xyz = np.tile(middle, (x.size, 1))
        xyz[:, window.axes[0]], xyz[:, window.axes[1]] = x.ravel(), z.ravel()
        count = np.sum([sees_points(camera, xyz) for camera in field.cameras], axis=0)
        within = xyz @ mean_direction(field.cameras) <= far
        return np.asarray(((count >= field.least) & within).reshape(x.shape))

    seen = sees(*np.meshgrid(across, depth))
    for piece in _pieces(seen):
        rows, first, last = np.array(piece).T
        z = depth[rows]
        left, right = across[first], across[last]
        for halving in range(1, 8):  # 1/128 of a node's distance is a sixtieth of a drawing unit
            push = step / 2**halving
            left = np.where(sees(left - push, z), left - push, left)
            right = np.where(sees(right + push, z), right + push, right)
        z = np.concatenate([[z[0] - half], z, [z[-1] + half]])  # pieces touch
        left, right = (np.concatenate([side[:1], side, side[-1:]]) for side in (left, right))
        outline = [window.at(*place) for place in zip(left, z, strict=True)]
        outline += [window.at(*place) for place in zip(right[::-1], z[::-1], strict=True)]
        drawing.path(_inside_frame(window, outline), closed=True, fill=GREEN, fill_opacity="0.28")


def _inside_frame(window: _Window, outline: Sequence[Point]) -> list[Point]:
    """Move points that lie half a node outside onto the frame."""
    left, top = window.corner
    right, bottom = left + window.size[0], window.bottom
    return [(min(max(x, left), right), min(max(y, top), bottom)) for x, y in outline]


def _pieces(seen: BoolArray) -> list[list[tuple[int, int, int]]]:
    """Group runs of seen nodes, (row, first, last), into pieces with one run in each row."""
    open_pieces: list[list[tuple[int, int, int]]] = []
    done: list[list[tuple[int, int, int]]] = []
    for row, nodes in enumerate(seen):
        edges = np.flatnonzero(np.diff(np.pad(nodes.astype(np.int8), 1)))
        runs = [(row, int(a), int(b) - 1) for a, b in zip(edges[::2], edges[1::2], strict=True)]
        goes_on = len(runs) == len(open_pieces) == 1
        if goes_on:
            open_pieces[0].append(runs[0])
            continue
        done += open_pieces
        open_pieces = [[run] for run in runs] if len(runs) == 1 else []
        done += [[run] for run in runs] if len(runs) > 1 else []
    return done + open_pieces


def _box(drawing: Drawing, window: _Window, volume: FloatArray) -> None:
    """Draw the outline of the volume."""
    (left, front), (right, back) = volume[:, window.axes].tolist()
    corners = ((left, front), (right, front), (right, back), (left, back))
    drawing.path(
        [window.at(*corner) for corner in corners], closed=True, stroke=PURPLE, stroke_width=1.3
    )


def _frame(drawing: Drawing, window: _Window, title: str, detail: str) -> None:
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


def _key(drawing: Drawing, view: CommonView) -> None:
    """Write the legend below the pictures."""
    x, y = 12.0, drawing.height - 12
    entries = (
        ("camera and its field", BLUE),
        (f"seen by {view.least} cameras", GREEN),
        (f"volume; ± is one standard deviation for {fixed(view.noise_px, 3)} px", PURPLE),
    )
    for label, colour in entries:
        drawing.dot((x, y), 3.5, colour)
        drawing.text((x + 8, y + 4), label)
        x += 26 + 5.6 * len(label)  # a letter is about half as wide as high


def _percents(shares: FloatArray) -> str:
    """Write shares as whole percents, once if they are alike."""
    texts = [f"{fixed(100 * float(share), 0)} %" for share in shares]
    return texts[0] if len(set(texts)) == 1 else ", ".join(texts)


def _short(value: float) -> str:
    """Write a length in mm without needless decimals."""
    return fixed(float(value), 1).removesuffix(".0")
