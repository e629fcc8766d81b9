"""Exact ray casting on triangles in double precision: depth maps, visibility, closure.

A ray of a camera is its undistorted normalised coordinates (x, y), that is the direction
(x, y, 1): where it meets the plane of a triangle, the parameter of the ray is the depth. A
triangle can only be met by rays within the box of its projected corners, so that triangles are
gone through one by one and rays are found by cells of a grid.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from rendering.cameras import FloatArray, View

IntArray = NDArray[np.int64]
BoolArray = NDArray[np.bool_]

PER_CELL = 8  # rays
CHUNK = 600_000  # rays at a time, for memory
SAME_MM = 1e-3
"""Depth by which a surface may lie before a point and not hide it: the rounding at an edge seen at
grazing incidence; far below what shows in an image."""


@dataclass(frozen=True, slots=True, eq=False)
class Surfaces:
    """All triangles of a scene.

    Attributes
    ----------
    corners_mm : ndarray, shape (M, 3, 3)
        World corners.
    owner : ndarray of int, shape (M,)
        Number of the object; 0 is the work plane.
    """

    corners_mm: FloatArray
    owner: IntArray


def cast(view: View, surfaces: Surfaces, ideal: FloatArray) -> tuple[FloatArray, IntArray]:
    """Follow rays to the first surface.

    Parameters
    ----------
    view : View
        Camera whose rays they are.
    surfaces : Surfaces
        What they may meet.
    ideal : ndarray, shape (N, 2)
        Undistorted normalised coordinates.

    Returns
    -------
    depth_mm : ndarray, shape (N,)
        Along the optical axis; infinite where nothing is met.
    triangle : ndarray of int, shape (N,)
        Which; -1 for none.
    """
    corners = view.in_camera(surfaces.corners_mm)
    if (corners[..., 2] <= 0).any():
        raise ValueError(f"a triangle reaches behind camera {view.name}; make it smaller")
    parts = [_cast(corners, ideal[start : start + CHUNK]) for start in range(0, len(ideal), CHUNK)]
    return np.concatenate([part[0] for part in parts]), np.concatenate([part[1] for part in parts])


def _cast(corners: FloatArray, ideal: FloatArray) -> tuple[FloatArray, IntArray]:
    """Cast one chunk; corners are in the camera's frame."""
    depth, triangle = np.full(len(ideal), np.inf), np.full(len(ideal), -1)
    cells = _Cells(ideal)
    flat = corners[..., :2] / corners[..., 2:]
    low, high = flat.min(axis=1), flat.max(axis=1)
    # edge functions: opposite signs on both sides of a shared edge, exactly
    sides = np.cross(corners, np.roll(corners, -1, axis=1))
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    offset = np.einsum("ij,ij->i", normals, corners[:, 0])
    for index in range(len(corners)):
        rows = cells.within(low[index], high[index])
        if not len(rows):
            continue
        ray = np.column_stack([ideal[rows], np.ones(len(rows))])
        which = ray @ sides[index].T
        hit = (which >= 0).all(axis=1) | (which <= 0).all(axis=1)
        rows, ray = rows[hit], ray[hit]
        with np.errstate(divide="ignore", invalid="ignore"):
            found = offset[index] / (ray @ normals[index])
        nearer = np.isfinite(found) & (found > 0) & (found < depth[rows])
        depth[rows[nearer]], triangle[rows[nearer]] = found[nearer], index
    return depth, triangle


class _Cells:
    """Points of a plane, found by boxes."""

    def __init__(self, points: FloatArray) -> None:
        self._count = max(int(np.sqrt(len(points) / PER_CELL)), 1)
        self._low = points.min(axis=0)
        span = np.maximum(points.max(axis=0) - self._low, 1e-12)
        self._per = self._count / (span * (1 + 1e-9))
        cell = self._cell(points)
        key = cell[:, 1] * self._count + cell[:, 0]
        self._order = np.argsort(key, kind="stable")
        self._start = np.searchsorted(key[self._order], np.arange(self._count**2 + 1))

    def _cell(self, points: FloatArray) -> IntArray:
        return np.asarray(np.floor((points - self._low) * self._per), np.int64)

    def within(self, low: FloatArray, high: FloatArray) -> IntArray:
        """Return the rows of all points within a box, and some around it."""
        (left, top), (right, bottom) = self._cell(low), self._cell(high)
        if right < 0 or bottom < 0 or left >= self._count or top >= self._count:
            return np.empty(0, np.int64)
        left, top = max(left, 0), max(top, 0)
        right, bottom = min(right, self._count - 1), min(bottom, self._count - 1)
        lines = np.arange(top, bottom + 1) * self._count
        first, last = self._start[lines + left], self._start[lines + right + 1]
        return np.concatenate([self._order[a:b] for a, b in zip(first, last, strict=True)])


def pixel_rays(view: View) -> FloatArray:
    """Return the rays of all pixel centres, row by row, shape (H W, 2)."""
    width, height = view.size_px
    u, v = np.meshgrid(np.arange(width, dtype=np.float64), np.arange(height, dtype=np.float64))
    return view.ideal(np.column_stack([u.ravel(), v.ravel()]))


def visible(view: View, surfaces: Surfaces, xyz_mm: FloatArray) -> BoolArray:
    """Tell which points of surfaces, shape (N, 3), a camera sees."""
    seen = view.inside(view.project(xyz_mm))
    point = view.in_camera(xyz_mm[seen])
    if len(point):
        depth, _ = cast(view, surfaces, point[:, :2] / point[:, 2:])
        seen[seen] = depth > point[:, 2] - SAME_MM
    return seen


def truth_maps(
    view: View, others: list[View], surfaces: Surfaces
) -> tuple[dict[str, NDArray[np.generic]], dict[str, float]]:
    """Return the arrays of ``truth_<camera>.npz`` and the worst closures.

    Parameters
    ----------
    view : View
        Camera of the maps.
    others : list of View
        Cameras in which its surface points may be visible.
    surfaces : Surfaces
        The scene.

    Returns
    -------
    maps : dict of str to ndarray
        ``depth`` (float32), ``object_id`` (uint8), ``visible_in_<other>`` (packed bits).
    closure_px : dict of str to float
        Largest distance between a pixel and its image by way of each other view: its surface
        point is cast again there, exactly, and projected back.
    """
    width, height = view.size_px
    rays = pixel_rays(view)
    depth, triangle = cast(view, surfaces, rays)
    if not np.isfinite(depth).all():
        raise ValueError(f"camera {view.name} looks beyond the work plane; make it larger")
    xyz = view.world(rays, depth)
    maps: dict[str, NDArray[np.generic]] = {
        "depth": depth.reshape(height, width).astype(np.float32),
        "object_id": surfaces.owner[triangle].reshape(height, width).astype(np.uint8),
    }
    closures = {}
    for other in others:
        seen = visible(other, surfaces, xyz)
        point = other.in_camera(xyz[seen])
        there = point[:, :2] / point[:, 2:]
        again = other.world(there, cast(other, surfaces, there)[0])
        back = np.linalg.norm(view.project(again) - view.project(xyz[seen]), axis=1)
        # at a silhouette a ray may pass the edge it is meant to meet
        wrong = back > 5e-3
        seen[np.flatnonzero(seen)[wrong]] = False
        closures[other.name] = float(back[~wrong].max(initial=0))
        maps[f"visible_in_{other.name}"] = np.packbits(seen)
    return maps, closures
