"""A measuring volume for cameras: proposed, or refused because they do not see it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from closerange.errors import GeometryError, InputError
from closerange.flags import Flag
from closerange.geometry.arrays import FloatArray
from closerange.matching.box_search import Slices, best_box
from closerange.matching.segment_clipping import SecondView
from closerange.matching.sight import checked_volume, sight_line
from closerange.matching.view_grid import (
    ViewGrid,
    checked_cameras,
    field_grid,
    lay_grid,
    pixel_grid,
    sees_points,
)
from closerange.rig.camera import Camera
from closerange.rig.rig import Rig

EVEN = 2.0
"""Inside of a proposed volume the error in space at the worst place is at most twice that at the
best: one figure may then stand for the volume, and it does not reach where depth fades away."""

_BAND_STEP = 2.0**0.25
"""Bands of accuracy are tried in steps of a quarter of their width."""

_START_ANGLES_RAD = tuple(np.deg2rad([1.0, 4.0, 16.0]))
"""Cameras with wide lenses see far beyond where they measure well: a grid around all of that, down
to rays that cross at 1 degree, would have its nodes too far apart to find the best place."""

_SEARCH_NODES = 25
_START_ROUNDS, _ROUNDS = 2, 3
"""Each round looks closer at the best box of the one before. Two tell which start is the best;
three more, for that one only, make its sides good to about 2 %."""

_CHECK_NODES = 11
_PUSHES = 5
_SHRINK, _SHRINKS = 0.99, 100
"""A lens may bend the walls of the region inwards: the box is then made smaller, 1 % at a time."""


@dataclass(frozen=True, slots=True, eq=False)
class _Sought:
    """Cameras, what of their view counts, and where the volume may be; None for anywhere."""

    cameras: tuple[Camera, ...]
    least: int
    margin_px: float
    within_mm: FloatArray | None

    def grid(self, box_mm: FloatArray, nodes: int) -> ViewGrid:
        """Look at the nodes of a box."""
        return lay_grid(
            self.cameras, box_mm, nodes=nodes, least=self.least, margin_px=self.margin_px
        )

    def clipped(self, box_mm: FloatArray) -> FloatArray:
        """Cut a box at the limits."""
        return box_mm if self.within_mm is None else np.clip(box_mm, *self.within_mm)

    def allows(self, box_mm: FloatArray) -> bool:
        """Tell whether a box stays within the limits."""
        return np.array_equal(self.clipped(box_mm), box_mm)


def propose_volume(
    rig: Rig | Sequence[Camera],
    *,
    least: int | None = None,
    margin_px: float = 0.0,
    within_mm: ArrayLike | None = None,
) -> FloatArray:
    """Propose a measuring volume: the box in which the cameras can tell most positions apart.

    Parameters
    ----------
    rig : Rig or sequence of Camera
        Two or more cameras.
    least, margin_px
        As in `common_view`.
    within_mm : array_like, shape (2, 3), optional
        Where it may lie, such as above a table (`between_planes`); infinite on axes without limits.

    Returns
    -------
    ndarray, shape (2, 3)
        Lower and upper corner, along the world's axes, all of it inside of the common view; the
        error in space differs within it by at most a factor of `EVEN`. Sides are rounded to
        three digits, inwards.

    Raises
    ------
    InputError, GeometryError
        As `common_view`.

    Notes
    -----
    The volume is counted in units of its own uncertainty, 1 / sqrt(det C). The largest box in mm^3
    would lie as far away as the cameras see, where they see least.
    """
    cameras, count = checked_cameras(rig, least, margin_px)
    limits = None if within_mm is None else _with_depth(checked_volume(within_mm))
    sought = _Sought(cameras, count, margin_px, limits)
    box, cell_mm = _best_start(sought)
    for _ in range(_SHRINKS):
        if _fits(sought, box):
            return _rounded_inwards(_grown(sought, box, cell_mm))
        middle = box.mean(axis=0)
        box = middle + _SHRINK * (box - middle)
    raise GeometryError(
        "no box along the axes of the world fits into the common view",
        remedy="give the measuring volume yourself, with calibrate --volume",
    )


def check_in_view(rig: Rig | Sequence[Camera], volume_mm: ArrayLike) -> None:
    """Refuse a volume in which no match can be found.

    Parameters
    ----------
    rig : Rig or sequence of Camera
        Two or more cameras.
    volume_mm : array_like, shape (2, 3)
        As for `sight_line`; infinite on axes without limits.

    Raises
    ------
    InputError
        If the volume is none.
    GeometryError
        If a camera sees nothing of it, saying whether it lies behind the camera, or no two
        cameras see the same place of it.
    """
    cameras, _ = checked_cameras(rig, 2, 0.0)
    volume = checked_volume(volume_mm)
    views = [SecondView(camera) for camera in cameras]
    shared = False
    for index, camera in enumerate(cameras):
        lines = sight_line(camera, pixel_grid(camera), volume)
        nodes = _finite_nodes(volume)
        if (lines.flags != 0).all() and not sees_points(camera, nodes).any():
            behind = (lines.flags & int(Flag.behind_camera)).any()
            behind |= len(nodes) > 0 and (camera.depth_mm(nodes) <= 0).all()
            where = "behind it" if behind else "outside of its image"
            raise GeometryError(
                f"camera {camera.name!r} does not see the volume, which lies {where}",
                remedy="check the limits of the volume, and which way the world's axes point",
            )
        for other, view in enumerate(views):
            segments = view.clip(lines)
            shared |= other != index and bool((segments.near_mm <= segments.far_mm).any())
        seen = np.sum([sees_points(other, nodes) for other in cameras], axis=0)
        shared |= bool((seen >= 2).any())
    if not shared:
        raise GeometryError(
            "no place of the volume is seen by two cameras",
            remedy="move the limits of the volume to where the fields of view overlap",
        )


def _best_start(sought: _Sought) -> tuple[FloatArray, FloatArray]:
    """Search from afar and from near; return the box with most positions and its grid's cell."""
    found: list[tuple[float, ViewGrid, FloatArray]] = []
    for angle in _START_ANGLES_RAD:
        try:
            grid = field_grid(
                sought.cameras,
                nodes=_SEARCH_NODES,
                least=sought.least,
                margin_px=sought.margin_px,
                angle_rad=angle,
                within_mm=sought.within_mm,
            )
        except GeometryError:
            if not found:
                raise
            break  # nothing is seen so near
        grid, box = _closer(sought, grid, _START_ROUNDS - 1)
        inner = sought.grid(box, _CHECK_NODES)
        density = 1 / np.sqrt(np.linalg.det(inner.cov_px[inner.inside]))
        found.append((float(density.sum() * np.prod(inner.cell_mm)), grid, box))
    _, grid, _ = max(found, key=lambda item: item[0])
    grid, box = _closer(sought, grid, _ROUNDS)
    return box, grid.cell_mm


def _closer(sought: _Sought, grid: ViewGrid, rounds: int) -> tuple[ViewGrid, FloatArray]:
    """Lay closer grids around the best box of a grid; return the last one and its best box."""
    box = _box_of(grid, _most_positions(grid))
    for _ in range(rounds):
        around = np.stack([box[0] - 2 * grid.cell_mm, box[1] + 2 * grid.cell_mm])
        closer = sought.grid(sought.clipped(around), _SEARCH_NODES)
        if not closer.inside.any():
            break
        grid, box = closer, _box_of(closer, _most_positions(closer))
    return grid, box


def _most_positions(grid: ViewGrid) -> Slices:
    """Return the box of nodes with most distinguishable positions and an even accuracy."""
    inside = grid.inside
    cov = grid.cov_px[inside]
    worth, error = np.zeros(inside.shape), np.full(inside.shape, np.nan)
    worth[inside] = 1 / np.sqrt(np.linalg.det(cov))
    error[inside] = np.sqrt(np.einsum("nii->n", cov))
    worth /= worth.max()
    low, high = float(np.nanmin(error)), float(np.nanmax(error))
    steps = max(0, int(np.ceil(np.log(high / low / EVEN) / np.log(_BAND_STEP))))
    bands = []
    for step in range(steps + 1):
        start = low * _BAND_STEP**step
        with np.errstate(invalid="ignore"):
            band = inside & (error >= start * (1 - 1e-12)) & (error <= start * EVEN)
        bands.append((float(worth[band].sum()), band))
    most, best = -1.0, None
    for limit, band in sorted(bands, key=lambda item: -item[0]):
        found = best_box(band, worth) if limit > most else None
        if found is not None and found[1] > most:
            best, most = found
    if best is None:  # there is a node, so there is a box
        raise GeometryError("the common view is empty", remedy="turn the cameras to each other")
    return best


def _box_of(grid: ViewGrid, slices: Slices) -> FloatArray:
    """Return the corners of a box of nodes; of their middle cell's half, for a single one."""
    rows = []
    for axis, piece, cell in zip(grid.axes_mm, slices, grid.cell_mm, strict=True):
        air = 0.25 * cell if piece.stop - piece.start == 1 else 0.0
        rows.append((axis[piece.start] - air, axis[piece.stop - 1] + air))
    return np.array(rows).T


def _with_depth(limits_mm: FloatArray) -> FloatArray:
    """Refuse limits between which there is no room for a volume."""
    for axis in np.flatnonzero(limits_mm[0] == limits_mm[1]):
        raise InputError(
            f"the volume may only have {'XYZ'[axis]} = {limits_mm[0, axis]:g} mm",
            remedy="give two different limits",
        )
    return limits_mm


def _rounded_inwards(box_mm: FloatArray) -> FloatArray:
    """Round to a thousandth to a hundredth of each side: numbers that one can read."""
    places = 2 - np.floor(np.log10(box_mm[1] - box_mm[0])).astype(int)
    corners = np.empty((2, 3))
    for axis, digits in enumerate(places):
        step = 10.0 ** -int(digits)
        corners[0, axis] = round(float(np.ceil(box_mm[0, axis] / step - 1e-9)) * step, int(digits))
        corners[1, axis] = round(float(np.floor(box_mm[1, axis] / step + 1e-9)) * step, int(digits))
    return np.asarray(corners + 0.0)  # no negative zero


def _fits(sought: _Sought, box_mm: FloatArray) -> bool:
    """Test a close grid of a box, walls and corners included: in view, and evenly accurate."""
    if not sought.allows(box_mm):
        return False
    cell = (box_mm[1] - box_mm[0]) / (_CHECK_NODES - 1)
    grid = sought.grid(np.stack([box_mm[0] - cell / 2, box_mm[1] + cell / 2]), _CHECK_NODES)
    if not grid.inside.all():
        return False
    variance = np.einsum("...ii->...", grid.cov_px)
    # 1e-6: the box may end where the band of accuracy ends
    return bool(variance.max() <= (1 + 1e-6) * EVEN**2 * variance.min())


def _grown(sought: _Sought, box_mm: FloatArray, cell_mm: FloatArray) -> FloatArray:
    """Push the walls outwards as far as they go: the best box of nodes ends at nodes."""
    box = box_mm
    for halving in range(_PUSHES):
        for axis in range(3):
            for wall, sign in ((0, -1), (1, 1)):
                pushed = box.copy()
                pushed[wall, axis] += sign * cell_mm[axis] / 2**halving
                pushed = sought.clipped(pushed)
                if _fits(sought, pushed):
                    box = pushed
    return box


def _finite_nodes(volume_mm: FloatArray) -> FloatArray:
    """Return nodes of a volume that has no infinite side, shape (N, 3)."""
    if not np.isfinite(volume_mm).all():
        return np.empty((0, 3))
    axes = [np.linspace(volume_mm[0, i], volume_mm[1, i], 9) for i in range(3)]
    return np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
