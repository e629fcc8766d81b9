"""Checks of a written folder against itself; their lines go into its README."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import map_coordinates

from rendering.cameras import FloatArray, View
from rendering.truth import pixel_rays

REACH_PX = 4.0
CONTRAST_DN = 40.0
FLAT_DN = 3.0


def reprojection(view: View, xyz_mm: FloatArray, xy_px: FloatArray) -> str:
    """Compare listed edge points with OpenCV's projection."""
    turn = cv2.Rodrigues(view.rotation)[0]
    seen, _ = cv2.projectPoints(
        np.ascontiguousarray(xyz_mm), turn, view.translation_mm, view.matrix, np.array(view.brown)
    )
    worst = np.linalg.norm(seen.reshape(-1, 2) - xy_px, axis=1).max()
    return f"(a) {view.name} edge points: cv2 projection max {worst:.2e} px (n={len(xy_px)})"


def there_and_back(folder: Path, first: View, second: View) -> str:
    """Send visible pixels to the other view's stored depth map and back."""
    depth, owner, seen = _maps(folder, first, second)
    other_depth, other_owner, _ = _maps(folder, second, first)
    rays = pixel_rays(first)[seen.ravel()]
    there = second.project(first.world(rays, depth[seen]))
    corner = np.floor(there).astype(int)
    width, height = second.size_px
    inner = ((corner >= 0) & (corner < np.array([width - 1, height - 1]))).all(axis=1)
    column, row = np.clip(corner, 0, [width - 2, height - 2]).T
    four = [(row, column), (row, column + 1), (row + 1, column), (row + 1, column + 1)]
    for place in four:
        inner &= other_owner[place] == owner[seen]
    inverse = [1 / other_depth[place] for place in four]
    # a plane has no twist; a crease or a step has
    inner &= np.abs(inverse[0] + inverse[3] - inverse[1] - inverse[2]) < 1e-5 * inverse[0]
    x, y = (there - corner).T
    blend = (1 - x) * (1 - y), x * (1 - y), (1 - x) * y, x * y
    found = 1 / sum(b * i for b, i in zip(blend, inverse, strict=True))
    back = first.project(second.world(second.ideal(there), found))
    own = first.distorted_px(rays)
    error = np.linalg.norm(back - own, axis=1)[inner]
    median, high, higher = np.quantile(error, [0.5, 0.99, 0.999])
    return (
        f"(b) {first.name}->{second.name}: visible {100 * seen.mean():.1f} % of pixels; tested "
        f"{inner.sum()}; error px median {median:.2e}  p99 {high:.2e}  p99.9 {higher:.2e}; "
        f"share<0.01px {(error < 0.01).mean():.5f}"
    )


def measured_edges(
    grey_values: FloatArray, view: View, xyz_mm: FloatArray, direction: FloatArray
) -> str:
    """Measure edges across the listed points where linear grey values on both sides are even."""
    place = view.project(xyz_mm)
    along = view.project(xyz_mm + 0.05 * direction) - place
    along /= np.linalg.norm(along, axis=1, keepdims=True)
    across = np.column_stack([-along[:, 1], along[:, 0]])
    way = np.arange(-REACH_PX, REACH_PX + 0.05, 0.1)
    at = place[:, None] + way[None, :, None] * across[:, None]
    grey = map_coordinates(grey_values, [at[..., 1], at[..., 0]], order=3, mode="nearest")
    ends = grey[:, way < -2], grey[:, way > 2]
    low, high = (end.mean(axis=1) for end in ends)
    even = np.all([end.std(axis=1) < FLAT_DN for end in ends], axis=0)
    share = (grey - low[:, None]) / (high - low)[:, None]
    shift = np.trapezoid(1 - share, way, axis=1) - REACH_PX
    shift = shift[even & (np.abs(high - low) > CONTRAST_DN)]
    if not len(shift):
        return f"(d) {view.name}: no edge with even grey values on both sides"
    middle = np.median(shift)
    sigma = 1.4826 * np.median(np.abs(shift - middle))
    return (
        f"(d) {view.name}: edge position in the noisy image along the normal minus truth: "
        f"n={len(shift)} median {middle:+.4f} px, robust sigma {sigma:.4f} px"
    )


def _maps(
    folder: Path, view: View, other: View
) -> tuple[FloatArray, NDArray[np.uint8], NDArray[np.bool_]]:
    with np.load(folder / f"truth_{view.name}.npz") as maps:
        depth = maps["depth"].astype(np.float64)
        bits = np.unpackbits(maps[f"visible_in_{other.name}"])[: depth.size]
        return depth, maps["object_id"], bits.reshape(depth.shape).astype(bool)
