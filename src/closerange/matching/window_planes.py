"""Planes through the rays of seeds, and how they carry a neighbourhood into the other view."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from closerange.geometry.arrays import FloatArray, IntArray
from closerange.matching.candidates import sweep_axis
from closerange.matching.pencil import Pencil
from closerange.rig.camera import Camera

TILT = 0.6
"""Tangent of the tilts that are tried beside none. Halfway to the next one a window fits well
enough for the refinement to find the rest: tilts up to 0.9, 42 degrees, are reached."""

TILTS = np.array([[a, b] for a in (0.0, -TILT, TILT) for b in (0.0, -TILT, TILT)])
"""Hypotheses: along the line between the cameras and across it; none first."""

NODES = 9
"""Places on an epipolar segment at which the mapping is computed; it is linear between them."""

_DIFFERENCE_PX = 1.0
"""Step of the difference quotient for the change of a ray's direction with its pixel."""


@dataclass(frozen=True, slots=True, eq=False)
class SeedRays:
    """Rays of N pixels of the first view, cut to unit depth.

    A plane of the world is ``omega = omega0 + slope . (offset in px)`` exactly, but for lens
    distortion, with omega the inverse of the depth in the first camera: planes are linear, whether
    near or far, and so is the numerator of the projection into the second view.

    Attributes
    ----------
    first, second : Camera
        Views.
    axis : int
        World axis along which both look most nearly.
    xy_px : ndarray, shape (N, 2)
        Pixels, to a fraction.
    ray : ndarray, shape (N, 3)
        World direction whose component along the first camera's axis is 1.
    by_px : ndarray, shape (N, 3, 2)
        Its change per px.
    """

    first: Camera
    second: Camera
    axis: int
    xy_px: FloatArray
    ray: FloatArray
    by_px: FloatArray

    @classmethod
    def of(cls, pencil: Pencil, xy_px: ArrayLike) -> SeedRays:
        """Build the rays of pixels of the first view."""
        pixels = np.reshape(np.asarray(xy_px, np.float64), (-1, 2))
        change = [
            unit_depth_rays(pencil.first, pixels + step)
            - unit_depth_rays(pencil.first, pixels - step)
            for step in _DIFFERENCE_PX * np.eye(2)
        ]
        return cls(
            pencil.first,
            pencil.second,
            sweep_axis(pencil),
            pixels,
            unit_depth_rays(pencil.first, pixels),
            np.stack(change, axis=2) / (2 * _DIFFERENCE_PX),
        )

    def __len__(self) -> int:
        return len(self.xy_px)

    def select(self, rows: ArrayLike | slice) -> SeedRays:
        """Keep or reorder rows."""
        kept = np.arange(len(self))[rows if isinstance(rows, slice) else np.asarray(rows)]
        return SeedRays(
            self.first, self.second, self.axis, self.xy_px[kept], self.ray[kept], self.by_px[kept]
        )

    def at(self, omega: FloatArray) -> FloatArray:
        """Return the world points of inverse depths, shape (N, 3), mm."""
        point: FloatArray = self.first.centre_mm + self.ray / omega[:, None]
        return point

    def pace(self, omega: FloatArray) -> FloatArray:
        """Return d px of the second view / d omega, shape (N, 2)."""
        by_point = self.second.project_jacobian(self.at(omega))
        return np.asarray(np.einsum("nij,nj->ni", by_point, -self.ray / omega[:, None] ** 2))

    def back(self, omega: FloatArray) -> FloatArray:
        """Return steps in the first view that undo 1 px along the epipolar curve, shape (N, 2).

        On the plane across the sweep axis. The grey value at a place changes by as much when the
        image is shifted by one of these steps as when the match is shifted by 1 px.
        """
        pace = self.pace(omega)
        along = pace / np.linalg.norm(pace, axis=1, keepdims=True)
        slope = self.slope(np.ones(len(omega)), np.zeros((len(omega), 2)))
        moved = self.by_px - self.ray[:, :, None] * slope[:, None, :]
        by_point = self.second.project_jacobian(self.at(omega)) / omega[:, None, None]
        warp = by_point @ moved
        determinant = np.linalg.det(np.where(np.isfinite(warp), warp, 0.0))
        regular = np.abs(determinant) > 1e-9
        warp = np.where(regular[:, None, None], warp, np.eye(2))
        step = np.linalg.solve(warp, along[:, :, None])[:, :, 0]
        return np.where(regular[:, None], step, np.nan)

    def slope(self, omega: FloatArray, tilts: FloatArray) -> FloatArray:
        """Return d omega / d px of the first view on planes through points of the rays.

        Parameters
        ----------
        omega : ndarray, shape (N,)
            Of the points.
        tilts : ndarray, shape (N, 2)
            Tangents of the plane's tilt against the plane across the sweep axis, along the line
            between the cameras and across it.

        Returns
        -------
        ndarray, shape (N, 2)
            Inverse mm per px.
        """
        normal = self._normals(tilts)
        facing = np.einsum("ni,ni->n", normal, self.ray)
        with np.errstate(divide="ignore", invalid="ignore"):
            change = np.einsum("ni,nij->nj", normal, self.by_px) / facing[:, None]
        return np.asarray(omega[:, None] * change)

    def along_plane(self, tilt: FloatArray) -> FloatArray:
        """Return inverse depths of all rays on one plane, those of the middle one being 1.

        Parameters
        ----------
        tilt : ndarray, shape (2,)
            Tangents of the plane's tilt.

        Returns
        -------
        ndarray, shape (N,)
            Planes that are parallel have the same ones, times the inverse depth of the middle.
        """
        facing = self.ray @ self._normals(tilt[None])[0]
        return np.asarray(facing / facing[len(facing) // 2])

    def _normals(self, tilts: FloatArray) -> FloatArray:
        across = np.eye(3)[self.axis]
        along = self.second.centre_mm - self.first.centre_mm
        along = along - across * (along @ across)
        length = np.linalg.norm(along)
        # one camera above the other along the sweep axis: any direction serves
        along = along / length if length > 0 else np.eye(3)[self.axis - 1]
        normal: FloatArray = across + tilts @ np.stack([along, np.cross(across, along)])
        return normal


def unit_depth_rays(camera: Camera, xy_px: FloatArray) -> FloatArray:
    """Return world directions of pixels, scaled to depth 1 in the camera, shape (N, 3)."""
    direction = camera.directions(xy_px)
    depth = direction @ camera.camera_from_world.rotation[2]
    scaled: FloatArray = direction / depth[:, None]
    return scaled


def segment_warps(
    rays: SeedRays, omega: FloatArray, count: IntArray, tilts: FloatArray
) -> FloatArray:
    """Return how neighbourhoods are mapped at every sample of epipolar segments.

    Parameters
    ----------
    rays : SeedRays
        N seeds.
    omega : ndarray, shape (N, K)
        Inverse depths of the samples; anything after the last of each segment.
    count : ndarray of int, shape (N,)
        Samples of each segment, at least 1.
    tilts : ndarray, shape (H, 2)
        Hypotheses of the surface's tilt.

    Returns
    -------
    ndarray, shape (N, K, H, 2, 2)
        d px of the second view / d px of the first on the plane of the hypothesis, float32.
    """
    rows, width = omega.shape
    share = np.linspace(0.0, 1.0, NODES)
    place = np.rint(share * (count[:, None] - 1)).astype(np.int64)
    at_node = np.take_along_axis(omega, place, axis=1)
    repeated = rays.select(np.repeat(np.arange(rows), NODES))
    flat = at_node.ravel()
    by_point = rays.second.project_jacobian(repeated.at(flat)) / flat[:, None, None]
    warps = np.empty((rows * NODES, len(tilts), 2, 2), dtype=np.float32)
    for number, tilt in enumerate(tilts):
        slope = repeated.slope(np.ones(len(flat)), np.broadcast_to(tilt, (len(flat), 2)))
        moved = repeated.by_px - repeated.ray[:, :, None] * slope[:, None, :]
        warps[:, number] = by_point @ moved
    warps = warps.reshape(rows, NODES, len(tilts), 2, 2)
    steps = np.maximum(count - 1, 1)[:, None]
    where = np.clip(np.arange(width) * (NODES - 1) / steps, 0, NODES - 1)
    lower = np.minimum(where.astype(np.int64), NODES - 2)
    part = (where - lower).astype(np.float32)[:, :, None, None, None]
    row = np.arange(rows)[:, None]
    return np.asarray(warps[row, lower] * (1 - part) + warps[row, lower + 1] * part)


def tilt_hypotheses(rays: SeedRays, omega: FloatArray, half_width: float) -> FloatArray:
    """Return the tilts that are worth a try, shape (H, 2); the first is none.

    A tilt that moves the rim of the window by less than half a px is found by the refinement
    alone: cameras that stand close together need no hypotheses.
    """
    level = np.zeros((len(rays), 2))
    change = rays.slope(omega, level + np.array([TILT, 0.0])) - rays.slope(omega, level)
    pace = np.linalg.norm(rays.pace(omega), axis=1)
    moved = pace * np.linalg.norm(change, axis=1) * half_width
    finite = moved[np.isfinite(moved)]
    if not finite.size or np.median(finite) < 0.5:
        return np.zeros((1, 2))
    return TILTS
