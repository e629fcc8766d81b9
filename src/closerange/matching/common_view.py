"""What cameras see in common: the field, the usable depth, a measuring volume to propose.

Figures 5.1 and 5.2 of the thesis: cameras with parallel axes share only a part of their images,
cameras that converge may share nearly all. Here for any number of cameras anywhere, by sampling.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike

from closerange.errors import GeometryError
from closerange.geometry.arrays import BoolArray, FloatArray, IntArray, frozen_array, frozen_ints
from closerange.geometry.transform import RigidTransform, rotation_from_vector
from closerange.matching.search import plane_mapping
from closerange.matching.sight import inside_image
from closerange.matching.view_grid import (
    MIN_ANGLE_RAD,
    checked_cameras,
    field_grid,
    lay_grid,
    pixel_grid,
)
from closerange.matching.volume_proposal import check_in_view, propose_volume
from closerange.rig.camera import Camera
from closerange.rig.rig import Rig

__all__ = [
    "MIN_ANGLE_RAD",
    "CommonView",
    "check_in_view",
    "common_view",
    "mean_direction",
    "parallel_axes",
    "propose_volume",
    "shared_field",
]

NODES = 33
"""Nodes along each side of the grid: areas and depths are good to some 3 %."""


@dataclass(frozen=True, slots=True, eq=False)
class CommonView:
    """The region that enough cameras see, on a grid of the world.

    Attributes
    ----------
    cameras : tuple of str
        Names.
    least : int
        How many of them must see a place.
    axes_mm : tuple of three ndarrays
        World X, Y and Z of the nodes; each in the middle of its cell.
    seen : ndarray of int, shape (nx, ny, nz)
        How many cameras see a node.
    inside : ndarray of bool, shape (nx, ny, nz)
        Nodes of the region: seen by enough, with rays that cross at 1 degree or more.
    std_mm : ndarray, shape (nx, ny, nz, 3)
        Standard deviation of X, Y, Z of a position for `noise_px`, without the calibration's
        part; NaN where not inside.
    noise_px : float
        Standard deviation of one image coordinate.
    depth_axis : int
        World axis nearest to the cameras' mean viewing direction: 0, 1 or 2 for X, Y, Z.
    """

    cameras: tuple[str, ...]
    least: int
    axes_mm: tuple[FloatArray, FloatArray, FloatArray]
    seen: IntArray
    inside: BoolArray
    std_mm: FloatArray
    noise_px: float
    depth_axis: int

    def __post_init__(self) -> None:
        axes = tuple(frozen_array(axis, (None,), "axes_mm") for axis in self.axes_mm)
        shape = tuple(len(axis) for axis in axes)
        object.__setattr__(self, "axes_mm", axes)
        object.__setattr__(self, "seen", frozen_ints(self.seen, shape, "seen"))
        object.__setattr__(self, "std_mm", frozen_array(self.std_mm, (*shape, 3), "std_mm"))
        inside = np.array(self.inside, np.bool_)
        inside.flags.writeable = False
        object.__setattr__(self, "inside", inside)

    @property
    def depths_mm(self) -> FloatArray:
        """World coordinate of the depth planes, shape (D,)."""
        return self.axes_mm[self.depth_axis]

    @property
    def area_mm2(self) -> FloatArray:
        """Area of the common field at each depth plane, shape (D,)."""
        across = tuple(axis for axis in range(3) if axis != self.depth_axis)
        cell = float(np.prod([self._cell_mm[axis] for axis in across]))
        return np.asarray(self.inside.sum(axis=across) * cell)

    @property
    def depth_std_mm(self) -> FloatArray:
        """Median standard deviation along the depth axis at each plane, (D,); NaN if empty."""
        planes = np.moveaxis(self.std_mm[..., self.depth_axis], self.depth_axis, 0)
        return np.array(
            [
                np.median(plane[np.isfinite(plane)]) if np.isfinite(plane).any() else np.nan
                for plane in planes
            ]
        )

    @property
    def depth_range_mm(self) -> tuple[float, float]:
        """Lowest and highest world coordinate along the depth axis that is of use."""
        planes = self.depths_mm[self.area_mm2 > 0]
        half = self._cell_mm[self.depth_axis] / 2
        return float(planes[0] - half), float(planes[-1] + half)

    @property
    def volume_mm3(self) -> float:
        """Volume of the region."""
        return float(self.inside.sum() * np.prod(self._cell_mm))

    @property
    def box_mm(self) -> FloatArray:
        """Box around the region, shape (2, 3)."""
        half = self._cell_mm / 2
        nodes = np.argwhere(self.inside)
        low, high = nodes.min(axis=0), nodes.max(axis=0)
        corners = [
            [axis[i] for axis, i in zip(self.axes_mm, at, strict=True)] for at in (low, high)
        ]
        return np.asarray(np.array(corners) + np.stack([-half, half]))

    @property
    def _cell_mm(self) -> FloatArray:
        return np.array([axis[1] - axis[0] for axis in self.axes_mm])


def common_view(
    rig: Rig | Sequence[Camera],
    *,
    least: int | None = None,
    noise_px: float | None = None,
    margin_px: float = 0.0,
    nodes: int = NODES,
    within_mm: ArrayLike | None = None,
) -> CommonView:
    """Find the region that the cameras of a rig see in common.

    Parameters
    ----------
    rig : Rig or sequence of Camera
        Two or more cameras.
    least : int, optional
        How many of them must see a place; all by default.
    noise_px : float, optional
        Image noise for the expected errors; that of the rig, or 1 px for bare cameras.
    margin_px : float, optional
        How far from the border of an image a place must be seen, such as half a structuring
        element.
    nodes : int, optional
        Nodes along each side of the grid.
    within_mm : array_like, shape (2, 3), optional
        Lay the grid into this box, to look closer at a part of the region.

    Returns
    -------
    CommonView
        Nothing hides anything in it: what will stand in the volume is not known.

    Raises
    ------
    InputError
        If `least` is not between 2 and the number of cameras, or an image has nothing left
        within the margin.
    GeometryError
        If there is no such place, or none within the box.
    """
    cameras, count = checked_cameras(rig, least, margin_px)
    noise = noise_px if noise_px is not None else rig.noise_px if isinstance(rig, Rig) else 1.0
    if within_mm is None:
        grid = field_grid(cameras, nodes=nodes, least=count, margin_px=margin_px)
    else:
        box = np.asarray(within_mm, np.float64)
        grid = lay_grid(cameras, box, nodes=nodes, least=count, margin_px=margin_px)
    if not grid.inside.any():
        raise GeometryError(
            "no place in the box is seen by enough cameras", remedy="choose a box that they see"
        )
    return CommonView(
        cameras=tuple(camera.name for camera in cameras),
        least=count,
        axes_mm=grid.axes_mm,
        seen=grid.seen,
        inside=grid.inside,
        std_mm=noise * np.sqrt(np.einsum("...ii->...i", grid.cov_px)),
        noise_px=noise,
        depth_axis=int(np.argmax(np.abs(mean_direction(cameras)))),
    )


def mean_direction(cameras: Sequence[Camera]) -> FloatArray:
    """Return the unit mean of the optical axes in the world, shape (3,)."""
    total = np.sum([camera.camera_from_world.rotation[2] for camera in cameras], axis=0)
    length = float(np.linalg.norm(total))
    # cameras that face each other have no mean: the first one's axis is as good as any
    first: FloatArray = cameras[0].camera_from_world.rotation[2]
    return first if length < 1e-6 else np.asarray(total / length)


def shared_field(
    cameras: Sequence[Camera], at_mm: ArrayLike, *, least: int | None = None
) -> FloatArray:
    """Return the share of each camera's image that the others see too, at one depth.

    Parameters
    ----------
    cameras : sequence of Camera
        C cameras.
    at_mm : array_like, shape (3,)
        A world point; the depth is the plane through it across the mean viewing direction.
    least : int, optional
        How many cameras must see a place, the camera itself included; all by default.

    Returns
    -------
    ndarray, shape (C,)
        0 to 1.
    """
    cameras, count = checked_cameras(cameras, least, 0.0)
    normal = mean_direction(cameras)
    offset = float(normal @ np.asarray(at_mm, np.float64))
    shares = []
    for camera in cameras:
        pixels = pixel_grid(camera)
        seen = np.zeros(len(pixels), np.int64)
        for other in cameras:
            mapped = plane_mapping(camera, other, pixels, normal=normal, offset_mm=offset)
            seen += (other is camera) | inside_image(other, mapped.xy_px)
        shares.append(float((seen >= count).mean()))
    return np.array(shares)


def parallel_axes(cameras: Sequence[Camera]) -> tuple[Camera, ...]:
    """Turn cameras where they stand until their optical axes are parallel, as in Fig. 5.1.

    Parameters
    ----------
    cameras : sequence of Camera
        Anywhere.

    Returns
    -------
    tuple of Camera
        The same lenses and centres, turned by the least angle to the mean viewing direction.
    """
    normal = mean_direction(cameras)
    turned = []
    for camera in cameras:
        rotation = camera.camera_from_world.rotation
        cross = np.cross(rotation[2], normal)
        sine, cosine = float(np.linalg.norm(cross)), float(rotation[2] @ normal)
        axis = cross / sine if sine > 0 else np.zeros(3)
        # a point that lay on the old axis lies on the new one after the world is turned
        new = rotation @ rotation_from_vector(np.arctan2(sine, cosine) * axis).T
        pose = RigidTransform(new, -new @ camera.centre_mm)
        turned.append(replace(camera, camera_from_world=pose))
    return tuple(turned)
