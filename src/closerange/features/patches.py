"""Bright patches: faces that stand out from their surroundings, and their centroids."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from closerange.features.borders import follow_borders
from closerange.features.edges import EdgePoints, find_edges
from closerange.features.threshold import threshold_report
from closerange.geometry.arrays import BoolArray, FloatArray, frozen_array

SMALLEST_PX = 200
"""Area below which a bright spot is no face: 16 px across, where a centroid is as good as its
outline and noise makes no such regions."""

TWO_FACES = 0.8
"""Share of the variance of a region's grey values between two classes from which on they are two
faces. Cutting noise in half gives 2 / pi = 0.64, a plain slope of brightness 0.75, two faces that
differ by five times their scatter more than 0.85."""

DEEPEST = 3
"""How often a region is parted: a top from a side, and once more for parts that touch."""

BLUR_PX = 2
"""Pixels along the border of a region whose grey values are the blur's, not those of a face."""

WHOLE = 0.85
"""Share of a region that must be brighter than half-way from its threshold to its own grey for it
to be tightened: what is lost then is a strip that belongs to a neighbour, not a part in shadow."""

ON_EDGE_PX = 2.0
"""How far the border of a region may be from the edge that it stands for: half the blur of an edge
on either side, and a pixel."""


@dataclass(frozen=True, slots=True, eq=False)
class Patches:
    """Bright patches of an image; N patches, the largest first.

    Attributes
    ----------
    xy_px : ndarray, shape (N, 2)
        Centroid of the area within the outline.
    area_px : ndarray, shape (N,)
        That area.
    outline_px : tuple of ndarray, each (K, 2)
        The outline, in order of following.
    """

    xy_px: FloatArray
    area_px: FloatArray
    outline_px: tuple[FloatArray, ...]

    def __post_init__(self) -> None:
        count = len(self.area_px)
        object.__setattr__(self, "xy_px", frozen_array(self.xy_px, (count, 2), "xy_px"))
        object.__setattr__(self, "area_px", frozen_array(self.area_px, (count,), "area_px"))
        outlines = (frozen_array(line, (None, 2), "outline_px") for line in self.outline_px)
        object.__setattr__(self, "outline_px", tuple(outlines))

    def __len__(self) -> int:
        return len(self.area_px)


def find_patches(pixels: NDArray[Any], edges: EdgePoints | None = None) -> Patches:
    """Find bright faces, as the thesis' example 2 does, and their centroids.

    Parameters
    ----------
    pixels : ndarray, shape (H, W)
        Grey values.
    edges : EdgePoints, optional
        Edges of the same image, if they have been found already.

    Returns
    -------
    Patches
        Those that do not touch the image border.

    Notes
    -----
    The image is thresholded by Trussell's method and the borders are followed (section 2.3). A
    region whose own grey values fall into two classes, such as a bright top with its darker
    sides, is parted in the same way and its brighter part kept; of two faces of different
    brightness whose images touch, that is the brighter one alone. Where the border runs along an
    edge, the edge's sub-pixel points take its place, and the centroid is that of the area.
    """
    grey = np.asarray(pixels)
    edges = find_edges(grey) if edges is None else edges
    tree = cKDTree(edges.xy_px) if len(edges) else None
    found = []
    level = threshold_report(grey).threshold
    for region in _parted(grey, _regions(grey > level), level):
        border: FloatArray = max(follow_borders(region), key=len).astype(np.float64)
        if tree is not None:
            border = _on_edges(border, edges, tree)
        area, centroid = area_centroid(border)
        if area > 0:
            found.append((centroid, area, border))
    found.sort(key=lambda patch: -patch[1])
    return Patches(
        np.array([centroid for centroid, _, _ in found]).reshape(-1, 2),
        np.array([area for _, area, _ in found]),
        tuple(border for _, _, border in found),
    )


def area_centroid(outline_px: FloatArray) -> tuple[float, FloatArray]:
    """Return area and centroid of what a closed line goes around.

    Parameters
    ----------
    outline_px : ndarray, shape (K, 2)
        Corners of a polygon in order; three or more.

    Returns
    -------
    float
        Area in px^2.
    ndarray, shape (2,)
        Centroid x, y in px; the mean of the corners if the area is 0.
    """
    origin = outline_px.mean(axis=0)  # small numbers lose no digits
    first = outline_px - origin
    second = np.roll(first, -1, axis=0)
    cross = first[:, 0] * second[:, 1] - second[:, 0] * first[:, 1]
    area = float(cross.sum() / 2)
    if area == 0:
        return 0.0, np.asarray(origin)
    centroid = ((first + second) * cross[:, None]).sum(axis=0) / (6 * area)
    return abs(area), np.asarray(origin + centroid)


def _regions(mask: BoolArray) -> list[BoolArray]:
    """Return the 8-connected regions that are large enough and do not touch the border."""
    count, labels, stats, _ = cv2.connectedComponentsWithStats(
        mask.astype(np.uint8), connectivity=8
    )
    height, width = mask.shape
    kept = []
    for label in range(1, count):
        x, y, w, h, area = (int(value) for value in stats[label])
        inside = x > 0 and y > 0 and x + w < width and y + h < height
        if inside and area >= SMALLEST_PX:
            kept.append(np.asarray(labels == label))
    return kept


def _parted(
    grey: NDArray[Any], regions: list[BoolArray], level: float, depth: int = 0
) -> list[BoolArray]:
    """Part the regions that hold two faces, keep the brighter parts and tighten them.

    The regions are those above `level`.
    """
    kept: list[BoolArray] = []
    for region in regions:
        values = _inner(grey, region)
        report = threshold_report(values)
        variance = float(values.astype(np.float64).var())
        share = max(report.between_class_variance, default=0.0) / variance if variance else 0.0
        brighter = _regions(region & (grey > report.threshold)) if share >= TWO_FACES else []
        if brighter and depth < DEEPEST:
            kept += _parted(grey, brighter, report.threshold, depth + 1)
        else:
            kept.append(_tightened(grey, region, (float(np.median(values)) + level) / 2))
    return kept


def _tightened(grey: NDArray[Any], region: BoolArray, level: float) -> BoolArray:
    """Return the part of a region above a level, if that is nearly all of it."""
    parts = _regions(region & (grey > level))
    largest = max(parts, key=np.count_nonzero, default=region)
    whole = np.count_nonzero(largest) >= WHOLE * np.count_nonzero(region)
    return largest if whole else region


def _inner(grey: NDArray[Any], region: BoolArray) -> NDArray[Any]:
    """Return the grey values of a region that its border does not touch; all of a thin one's."""
    side = 2 * BLUR_PX + 1
    inner = cv2.erode(region.astype(np.uint8), np.ones((side, side), np.uint8)) > 0
    return np.asarray(grey[inner if inner.any() else region])


def _on_edges(border: FloatArray, edges: EdgePoints, tree: cKDTree) -> FloatArray:
    """Move each border pixel to the nearest edge point; without one it stays."""
    distance, nearest = tree.query(border)
    near = distance <= ON_EDGE_PX
    return np.where(near[:, None], edges.xy_px[np.where(near, nearest, 0)], border)
