"""What the cameras see in common, as in Figs. 5.1 and 5.2 of the thesis, and a volume in it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from closerange.delivery.canvas import Canvas
from closerange.delivery.flat_view import HEIGHT, Window, draw_frame, inside_frame
from closerange.delivery.svg import BLUE, FULL_WIDTH, GREEN, INK, PURPLE, Point
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
"""The fields of the upper row end this much of the volume's depth behind it."""

_AROUND = 0.55
"""The lower row shows this much of the volume's sides around it: room for the errors beside it."""

_LINE = 14.0
"""Height of a line of text in drawing units."""

_AIR = 0.13
"""Room around the cameras in the upper row, for their names, as a share of the picture."""

_FARTHEST = 1.0
"""A calibrated volume is shown as far as it reaches this many sides beyond the proposed one."""

_DASH = 5.0


@dataclass(frozen=True, slots=True, eq=False)
class _Field:
    """Cameras, and how many of them must see a place."""

    cameras: tuple[Camera, ...]
    least: int


def draw_common_view(
    cameras: Sequence[Camera],
    view: CommonView,
    volume_mm: ArrayLike,
    *,
    calibrated_mm: ArrayLike | None = None,
) -> Canvas:
    """Draw cameras with their common field, the same with parallel axes, and a volume within.

    Parameters
    ----------
    cameras : sequence of Camera
        Those of `view`.
    view : CommonView
        Their common view.
    volume_mm : array_like, shape (2, 3)
        Measuring volume, as a rule the proposed one.
    calibrated_mm : array_like, shape (2, 3), optional
        Another volume, to be compared with it.

    Returns
    -------
    Canvas
        As wide as the page. Above: the cameras as they stand (Fig. 5.2) and turned until their
        axes are parallel (Fig. 5.1). Below: sections of the common field through the middle of
        the volume, along either axis across the depth.
    """
    volume = np.asarray(volume_mm, np.float64)
    other = None if calibrated_mm is None else np.asarray(calibrated_mm, np.float64)
    sides = " x ".join(_short(side) for side in volume[1] - volume[0])
    drawing = Canvas(
        FULL_WIDTH,
        2 * HEIGHT + 42,
        "Common field of view",
        f"{len(cameras)} cameras and a volume of {sides} mm in what {view.least} of them see",
    )
    up = 1.0 if float(mean_direction(cameras)[view.depth_axis]) < 0 else -1.0
    picture = _Picture(drawing, view, volume, other, up)
    fields = (_Field(tuple(cameras), view.least), _Field(parallel_axes(cameras), view.least))
    _draw_cameras(picture, fields)
    across = [axis for axis in range(3) if axis != view.depth_axis]
    for column, axis in enumerate(across):
        _section(picture, fields[0], axis, corner=(column * FULL_WIDTH / 2, HEIGHT))
    _key(picture)
    return drawing


@dataclass(frozen=True, slots=True, eq=False)
class _Picture:
    """What is drawn, where to, and which way along the depth is up."""

    drawing: Canvas
    view: CommonView
    volume: FloatArray
    calibrated: FloatArray | None
    up: float


def _draw_cameras(picture: _Picture, fields: tuple[_Field, _Field]) -> None:
    """Draw the upper row: the cameras as they stand, and with parallel axes."""
    drawing, volume, depth = picture.drawing, picture.volume, picture.view.depth_axis
    middle = volume.mean(axis=0)
    centres = np.stack([camera.centre_mm for camera in fields[0].cameras])
    across = (axis for axis in range(3) if axis != depth)
    widest = max(across, key=lambda axis: float(np.ptp(centres[:, axis])))
    far = _far(fields[0].cameras, volume)
    frusta = [[_frustum(camera, field, far) for camera in field.cameras] for field in fields]
    everything = np.concatenate([volume, *(frustum for group in frusta for frustum in group)])
    for column, (field, words) in enumerate(
        zip(fields, ("as they stand", "with parallel axes"), strict=True)
    ):
        window = Window.around(
            everything,
            (widest, depth),
            corner=(column * FULL_WIDTH / 2, 0),
            up=picture.up,
            air=_AIR,
        )
        shares = shared_field(field.cameras, middle, least=field.least)
        detail = f"shared part of the images: {_percents(shares)}"
        draw_frame(drawing, window, f"Cameras {words}", detail)
        _common(drawing, window, field, middle, far=far)
        _boxes(picture, window)
        for camera, frustum in zip(field.cameras, frusta[column], strict=True):
            _camera(drawing, window, camera, frustum)


def _section(picture: _Picture, field: _Field, axis: int, *, corner: Point) -> None:
    """Draw the common field around the volume, cut through the volume's middle."""
    drawing, volume, depth_axis = picture.drawing, picture.volume, picture.view.depth_axis
    size = volume[1] - volume[0]
    shown = [volume[0] - _AROUND * size, volume[1] + _AROUND * size]
    if picture.calibrated is not None:
        limits = volume[0] - _FARTHEST * size, volume[1] + _FARTHEST * size
        shown += [np.clip(wall, *limits) for wall in picture.calibrated]
    window = Window.around(
        np.stack(shown), (axis, depth_axis), corner=corner, up=picture.up, air=0.02
    )
    middle = volume.mean(axis=0)
    names, cut = "XYZ", 3 - axis - depth_axis
    draw_frame(
        drawing,
        window,
        f"Section at {names[cut]} = {_short(middle[cut])} mm",
        f"volume: {_short(size[axis])} mm in {names[axis]}, {_short(size[depth_axis])} mm in "
        f"{names[depth_axis]}",
    )
    _common(drawing, window, field, middle)
    _boxes(picture, window)
    beside = window.of(volume[1])[0] + 6
    errors = _depth_errors(field, picture.view, volume)
    if abs(window.of(volume[1])[1] - window.of(volume[0])[1]) < 2 * _LINE:
        errors = errors[1:2]  # a thin volume: there is room for one line
    for level, std in errors:
        _, y = window.at(float(middle[axis]), level)
        text = f"{names[depth_axis]} ± {short_length(std)}"
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


def _camera(drawing: Canvas, window: Window, camera: Camera, frustum: FloatArray) -> None:
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
    drawing: Canvas, window: Window, field: _Field, middle: FloatArray, *, far: float = np.inf
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
        drawing.path(inside_frame(window, outline), closed=True, fill=GREEN, fill_opacity="0.28")


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


def _boxes(picture: _Picture, window: Window) -> None:
    """Draw the outlines of the volumes; what is only compared with is dashed."""
    drawing = picture.drawing
    if picture.calibrated is not None:
        drawing.segments(_dashes(_outline(window, picture.calibrated)), INK, 1.2)
    drawing.path(_outline(window, picture.volume), closed=True, stroke=PURPLE, stroke_width=1.3)


def _outline(window: Window, volume: FloatArray) -> list[Point]:
    """Return the corners of a box in the drawing, cut at the frame."""
    (left, front), (right, back) = volume[:, window.axes].tolist()
    corners = ((left, front), (right, front), (right, back), (left, back))
    return inside_frame(window, [window.at(*corner) for corner in corners])


def _dashes(outline: Sequence[Point]) -> list[tuple[Point, Point]]:
    """Divide the sides of an outline into dashes that begin and end at its corners."""
    pairs: list[tuple[Point, Point]] = []
    for start, end in zip(outline, [*outline[1:], outline[0]], strict=True):
        a, way = np.array(start), np.subtract(end, start)
        count = max(1, round((float(np.linalg.norm(way)) / _DASH - 1) / 2))
        steps = np.arange(count + 1)[:, None] * 2 / (2 * count + 1)
        ends = np.stack([a + steps * way, a + (steps + 1 / (2 * count + 1)) * way], axis=1)
        pairs += [((float(p[0]), float(p[1])), (float(q[0]), float(q[1]))) for p, q in ends]
    return pairs


def _key(picture: _Picture) -> None:
    """Write the legend below the pictures."""
    drawing, view = picture.drawing, picture.view
    x, y = 12.0, drawing.height - 28
    several = picture.calibrated is not None
    entries = [
        ("camera and its field", BLUE),
        (f"seen by {view.least} cameras", GREEN),
        ("proposed volume" if several else "volume", PURPLE),
        *([("calibrated volume", INK)] if several else []),
    ]
    for label, colour in entries:
        drawing.dot((x, y), 3.5, colour)
        drawing.text((x + 8, y + 4), label)
        x += 26 + 5.6 * len(label)  # a letter is about half as wide as high
    text = f"±: one standard deviation of a position for {fixed(view.noise_px, 3)} px in the images"
    drawing.text((8.5, y + 20), text)


def _percents(shares: FloatArray) -> str:
    """Write shares as whole percents, once if they are alike."""
    texts = [f"{fixed(100 * float(share), 0)} %" for share in shares]
    return texts[0] if len(set(texts)) == 1 else ", ".join(texts)


def _short(value: float) -> str:
    """Write a length in mm without needless decimals."""
    return fixed(float(value), 1).removesuffix(".0")
