"""A grid of the world with what cameras see of each node, and where such a grid should lie."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from closerange.errors import GeometryError, InputError
from closerange.flags import Flag
from closerange.geometry.arrays import BoolArray, FloatArray, IntArray, all_finite
from closerange.geometry.intersection import widest_angle
from closerange.matching.segment_clipping import SecondView
from closerange.matching.sight import SightLines, inside_image, sight_line
from closerange.rig.camera import Camera
from closerange.rig.rig import Rig

MIN_ANGLE_RAD = float(np.deg2rad(1.0))
"""Rays that meet at less have no usable depth: `measure` flags them as nearly parallel. It also
ends the common view of parallel cameras, which would reach to infinity."""

_PIXELS = 17
"""Rays along each side of an image that outline its field; the corners are among them."""

_FIELD_PIXELS = 41
"""Pixels along each side of an image whose shared part is counted: good to 1 %."""

_FEW = 27
"""With fewer nodes inside, a grid says little of a region: it is then laid closer around it."""

_HALVINGS = 12
"""Halvings of a grid that misses the region; 1/4000 of its field is no measuring volume."""


@dataclass(frozen=True, slots=True, eq=False)
class ViewGrid:
    """Nodes of a box in the world, in the middle of equal cells.

    Attributes
    ----------
    axes_mm : tuple of three ndarrays
        World X, Y and Z of the nodes; shapes (nx,), (ny,), (nz,).
    seen : ndarray of int, shape (nx, ny, nz)
        How many cameras see a node.
    inside : ndarray of bool, shape (nx, ny, nz)
        Seen by enough cameras, whose rays cross at `MIN_ANGLE_RAD` or more.
    cov_px : ndarray, shape (nx, ny, nz, 3, 3)
        Covariance of a position in mm^2 for image noise of 1 px; NaN where not inside.
    """

    axes_mm: tuple[FloatArray, FloatArray, FloatArray]
    seen: IntArray
    inside: BoolArray
    cov_px: FloatArray

    @property
    def cell_mm(self) -> FloatArray:
        """Lengths of the sides of a cell, shape (3,)."""
        return np.array([axis[1] - axis[0] for axis in self.axes_mm])


def lay_grid(
    cameras: Sequence[Camera], box_mm: FloatArray, *, nodes: int, least: int, margin_px: float
) -> ViewGrid:
    """Look at the nodes of a box with all cameras.

    Parameters
    ----------
    cameras : sequence of Camera
        C cameras.
    box_mm : ndarray, shape (2, 3)
        Corners; the nodes are the middles of its cells.
    nodes : int
        Along each axis, two or more.
    least : int
        How many cameras must see a node.
    margin_px : float
        How far from the border of the image.

    Returns
    -------
    ViewGrid
        Nothing hides anything in it: what stands in the volume is not known.
    """
    share = (np.arange(nodes) + 0.5) / nodes
    axes = [box_mm[0, i] + share * (box_mm[1, i] - box_mm[0, i]) for i in range(3)]
    xyz = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
    sees = np.stack([sees_points(camera, xyz, margin_px) for camera in cameras], axis=1)
    seen = sees.sum(axis=1)
    inside = seen >= least
    rows = np.flatnonzero(inside)
    inside[rows] = widest_angle(_towards(cameras, xyz[rows]), sees[rows]) >= MIN_ANGLE_RAD
    rows = np.flatnonzero(inside)
    cov = np.full((len(xyz), 3, 3), np.nan)
    cov[rows] = _covariance(cameras, xyz[rows], sees[rows])
    shape = (nodes, nodes, nodes)
    return ViewGrid(
        (axes[0], axes[1], axes[2]),
        seen.reshape(shape),
        inside.reshape(shape),
        cov.reshape(*shape, 3, 3),
    )


def sees_points(camera: Camera, xyz_mm: FloatArray, margin_px: float = 0.0) -> BoolArray:
    """Tell which world points lie inside of a camera's image, by a margin, shape (N,)."""
    pixels = camera.project(xyz_mm)
    seen = inside_image(camera, pixels - margin_px) & inside_image(camera, pixels + margin_px)
    return np.asarray(seen)


def field_grid(
    cameras: Sequence[Camera],
    *,
    nodes: int,
    least: int,
    margin_px: float,
    angle_rad: float = MIN_ANGLE_RAD,
    within_mm: FloatArray | None = None,
) -> ViewGrid:
    """Lay a grid around all that enough cameras see.

    Parameters
    ----------
    cameras, nodes, least, margin_px
        As in `lay_grid`.
    angle_rad : float, optional
        Leave out what is so far away that rays cannot cross at this angle.
    within_mm : ndarray, shape (2, 3), optional
        Leave out what lies outside of this box; infinite on axes without limits.

    Returns
    -------
    ViewGrid
        Around the whole region, or, where that would leave it with hardly a node, around a part.

    Raises
    ------
    GeometryError
        If there is no place that enough cameras see under a usable angle.
    """
    ends, middle = _shared_rays(cameras, least, angle_rad, within_mm)
    box = np.stack([ends.min(axis=0), ends.max(axis=0)])
    half = (box[1] - box[0]) / 2
    grid = lay_grid(cameras, box, nodes=nodes, least=least, margin_px=margin_px)
    for _ in range(_HALVINGS):
        if grid.inside.sum() >= _FEW:
            return grid
        half = half / 2
        box = np.stack([middle - half, middle + half])
        grid = lay_grid(cameras, box, nodes=nodes, least=least, margin_px=margin_px)
    raise _no_common_view(cameras, least, within_mm)


def ray_fan(camera: Camera, reach_mm: float, within_mm: FloatArray | None = None) -> SightLines:
    """Return rays through a grid of pixels, corners included, from a camera up to a distance.

    Of each ray the part within a box is kept, if one is given.
    """
    width, height = camera.size_px
    across, down = (np.linspace(-0.5, side - 0.5, _PIXELS) for side in (width, height))
    pixels = np.stack(np.meshgrid(across, down), axis=-1).reshape(-1, 2)
    if within_mm is not None:
        lines = sight_line(camera, pixels, within_mm)
        return replace(lines, far_mm=np.minimum(lines.far_mm, reach_mm))
    direction = camera.directions(pixels)
    known = all_finite(direction, 1)
    return SightLines(
        centre_mm=camera.centre_mm,
        direction=direction,
        near_mm=np.where(known, 0.0, np.nan),
        far_mm=np.where(known, reach_mm, np.nan),
        flags=np.where(known, 0, int(Flag.not_converged)),
    )


def checked_cameras(
    rig: Rig | Sequence[Camera], least: int | None, margin_px: float
) -> tuple[tuple[Camera, ...], int]:
    """Return the cameras and how many of them must see a place, or say what is wrong.

    Parameters
    ----------
    rig : Rig or sequence of Camera
        C cameras.
    least : int or None
        How many must see a place; None for all.
    margin_px : float
        How far from the border of the image.

    Returns
    -------
    cameras, least : tuple of Camera, int
        Two or more.

    Raises
    ------
    InputError
        If there are fewer than two cameras, `least` is not between 2 and C, or the margin leaves
        nothing of an image.
    """
    cameras = tuple(rig.cameras if isinstance(rig, Rig) else rig)
    if len(cameras) < 2:
        raise InputError(
            f"{len(cameras)} camera: a common view needs two", remedy="give a rig of two or more"
        )
    count = len(cameras) if least is None else least
    if not 2 <= count <= len(cameras):
        raise InputError(
            f"{count} cameras of {len(cameras)} must see a place",
            remedy=f"ask for 2 to {len(cameras)}" if len(cameras) > 2 else "both must, of a pair",
        )
    smallest = min(min(camera.size_px) for camera in cameras)
    if not 0 <= margin_px < smallest / 2:
        raise InputError(
            f"a margin of {margin_px} px in an image {smallest} px high or wide",
            remedy=f"give 0 to less than {smallest / 2} px",
        )
    return cameras, count


def pixel_grid(camera: Camera) -> FloatArray:
    """Return the middles of equal parts of a camera's image, shape (N, 2) in px."""
    width, height = camera.size_px
    share = (np.arange(_FIELD_PIXELS) + 0.5) / _FIELD_PIXELS
    grid = np.meshgrid(share * width - 0.5, share * height - 0.5)
    return np.stack(grid, axis=-1).reshape(-1, 2)


def _shared_rays(
    cameras: Sequence[Camera], least: int, angle_rad: float, within_mm: FloatArray | None
) -> tuple[FloatArray, FloatArray]:
    """Return the ends (M, 3) of all pieces of rays that enough cameras see, and one inner point.

    Two planes of every corner of the region belong to one camera, if there are two cameras: the
    corners lie on the rays of image corners and the box around the ends is exact.
    """
    centres = np.stack([camera.centre_mm for camera in cameras])
    baseline = float(np.linalg.norm(centres[:, None] - centres, axis=2).max())
    # sine rule: rays that cross at an angle a do so within baseline / sin(a) of either camera
    reach = baseline / np.sin(angle_rad)
    if not reach > 0:
        raise GeometryError(
            f"the {len(cameras)} cameras stand in one place: their rays never cross",
            remedy="move the cameras apart",
        )
    views = [SecondView(camera) for camera in cameras]
    ends, middles, lengths = [], [], []
    for index, camera in enumerate(cameras):
        fan = ray_fan(camera, reach, within_mm)
        others = [view.clip(fan) for place, view in enumerate(views) if place != index]
        near = np.stack([segments.near_mm for segments in others], axis=1)
        far = np.stack([segments.far_mm for segments in others], axis=1)
        events = np.sort(np.concatenate([near, far], axis=1), axis=1)  # NaN comes last
        between = (events[:, 1:] + events[:, :-1]) / 2
        within = (near[:, None] <= between[..., None]) & (between[..., None] <= far[:, None])
        count = within.sum(axis=2)
        rows, pieces = np.nonzero((count >= least - 1) & np.isfinite(between))
        low, high = events[rows, pieces], events[rows, pieces + 1]
        ends += [fan.centre_mm + d[:, None] * fan.direction[rows] for d in (low, high)]
        middles.append(fan.centre_mm + between[rows, pieces][:, None] * fan.direction[rows])
        lengths.append(high - low)
    length = np.concatenate(lengths)
    if not length.size:
        raise _no_common_view(cameras, least, within_mm)
    return np.concatenate(ends), np.concatenate(middles)[int(np.argmax(length))]


def _no_common_view(
    cameras: Sequence[Camera], least: int, within_mm: FloatArray | None
) -> GeometryError:
    names = ", ".join(camera.name for camera in cameras)
    angle = np.rad2deg(MIN_ANGLE_RAD)
    place, remedy = "place", "turn the cameras towards each other, move them apart"
    if within_mm is not None:
        place, remedy = "place within the limits", "widen the limits"
    return GeometryError(
        f"there is no {place} that {least} of the cameras {names} see with rays that cross at "
        f"{angle:.0f} degree or more",
        remedy=f"{remedy}, or ask for fewer of them" if least > 2 else remedy,
    )


def _towards(cameras: Sequence[Camera], xyz_mm: FloatArray) -> FloatArray:
    """Return unit vectors from each camera to each point, shape (N, C, 3)."""
    centres = np.stack([camera.centre_mm for camera in cameras])
    away = xyz_mm[:, None] - centres
    return np.asarray(away / np.linalg.norm(away, axis=2, keepdims=True))


def _covariance(cameras: Sequence[Camera], xyz_mm: FloatArray, sees: BoolArray) -> FloatArray:
    """Return covariances of positions, (N, 3, 3), for unit image noise and known cameras."""
    normal = np.zeros((len(xyz_mm), 3, 3))
    for index, camera in enumerate(cameras):
        rows = np.flatnonzero(sees[:, index])
        jacobian = camera.project_jacobian(xyz_mm[rows])
        normal[rows] += np.swapaxes(jacobian, 1, 2) @ jacobian
    # regular: at least two rays that cross at a degree
    return np.asarray(np.linalg.inv(normal))
