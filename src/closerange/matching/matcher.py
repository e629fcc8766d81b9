"""Points of one view found in all others: the matcher that puts the room together."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from closerange.errors import InputError
from closerange.features.edge_operators import edge_mask
from closerange.features.edges import EdgePoints, find_edges
from closerange.flags import Flag
from closerange.geometry.arrays import BoolArray, FloatArray, IntArray, all_finite
from closerange.matching.all_views import Found, along_and_across, in_all_views
from closerange.matching.candidates import sweep_axis
from closerange.matching.correspondences import Correspondences
from closerange.matching.edge_matcher import EdgeMatches, match_edges, on_rays
from closerange.matching.pencil import Pencil
from closerange.matching.sight import checked_volume, inside_image
from closerange.matching.texture import (
    FEW,
    believes_window,
    mostly_texture,
    texture_lines,
    wants_window,
)
from closerange.matching.volume_proposal import check_in_view
from closerange.matching.window_matcher import WindowMatches, match_windows
from closerange.rig.camera import Camera

ON_EDGE_PX = 1.0
"""A given point so near to an edge is taken to mean the edge."""

ACROSS_PX = 0.02
"""Least standard deviation across the epipolar curve: a match lies on the curve by construction."""

OWN_SHARE = 0.3
"""Least share of a match's uncertainty that stays with it when the seed's own is taken out."""


@dataclass(frozen=True, slots=True, eq=False)
class View:
    """One camera's image, ready to be matched.

    Attributes
    ----------
    camera : Camera
        The camera.
    pixels : ndarray, shape (H, W)
        Grey values.
    edges : EdgePoints
        Its edges.
    """

    camera: Camera
    pixels: NDArray[Any]
    edges: EdgePoints

    @classmethod
    def of(cls, camera: Camera, pixels: NDArray[Any]) -> View:
        """Check an image against its camera and find its edges.

        Raises
        ------
        InputError
            If the image has another size than the camera.
        """
        size = (pixels.shape[1], pixels.shape[0])
        if size != camera.size_px:
            raise InputError(
                f"camera {camera.name!r}: image of {size[0]} x {size[1]} pixels, calibrated with "
                f"{camera.size_px[0]} x {camera.size_px[1]}",
                remedy="use images of the calibrated size, or calibrate at this one",
            )
        return cls(camera, pixels, find_edges(pixels))

    @property
    def strong(self) -> BoolArray:
        """Which edge points rise above the image's own edge threshold, shape (N,)."""
        return strong_edges(self.pixels, self.edges)


def strong_edges(pixels: NDArray[Any], edges: EdgePoints) -> BoolArray:
    """Mark edge points at or beside a pixel that blur-minimum and Trussell's threshold call edge.

    Parameters
    ----------
    pixels : ndarray, shape (H, W)
        Grey values.
    edges : EdgePoints
        N points of the same image.

    Returns
    -------
    ndarray of bool, shape (N,)
        The thesis' edge points, to a fraction of a pixel (section 5.3).
    """
    mask, _ = edge_mask(pixels)
    near = cv2.dilate(mask.astype(np.uint8), np.ones((3, 3), np.uint8))
    column, row = np.rint(edges.xy_px).astype(np.int64).T
    return np.asarray(near[row, column] > 0)


def views_of(cameras: Sequence[Camera], images: Sequence[NDArray[Any]]) -> list[View]:
    """Find the edges of all images, several at once.

    Raises
    ------
    InputError
        If there are fewer than two, or a size is wrong.
    """
    if len(cameras) < 2:
        raise InputError(
            f"{len(cameras)} image; a match needs two views of different cameras",
            remedy="give one image of each camera: NAME=IMAGE NAME=IMAGE",
        )
    with ThreadPoolExecutor(2) as pool:
        return list(pool.map(View.of, cameras, images))


def match_views(
    views: Sequence[View],
    volume_mm: FloatArray,
    *,
    seeds_px: FloatArray | None = None,
    seeds_cov_px2: FloatArray | None = None,
    point: Sequence[str] | None = None,
    placement: str = "",
    progress: Callable[[int, int], None] | None = None,
) -> Correspondences:
    """Find points of the first view in all others.

    Parameters
    ----------
    views : sequence of View
        At least two; the first holds the points.
    volume_mm : ndarray, shape (2, 3)
        Measuring volume: where the points may be. Infinite where there is no limit.
    seeds_px : ndarray, shape (M, 2), optional
        Points of the first view; without them, all of its strong edge points.
    seeds_cov_px2 : ndarray, shape (M, 2, 2), optional
        Their covariances; NaN where unknown.
    point : sequence of str, optional
        Their names; numbers otherwise.
    placement : str, optional
        For the rows of the table.
    progress : callable, optional
        Called with (done, total) after each further view.

    Returns
    -------
    Correspondences
        M points, one column for each view. A match that may not be relied upon carries flags; one
        that was not found is NaN.

    Raises
    ------
    InputError
        If the volume lies behind a camera or outside of the views.
    """
    volume = checked_volume(volume_mm)
    check_in_view([view.camera for view in views], volume)
    first = views[0]
    if seeds_px is None:
        rows = np.flatnonzero(first.strong)
        seeds, seed_cov = first.edges.xy_px[rows], _edge_cov(first.edges, rows)
    else:
        seeds = np.asarray(seeds_px, dtype=np.float64).reshape(-1, 2)
        seed_cov = np.full((len(seeds), 2, 2), np.nan) if seeds_cov_px2 is None else seeds_cov_px2
    count = len(seeds)
    outside = np.where(inside_image(first.camera, seeds), 0, int(Flag.outside_image))
    return in_all_views(
        views,
        lambda other, rest: _pair(first, other, rest, volume, seeds, seed_cov),
        Found(seeds, seed_cov, np.full(count, np.nan), outside),
        cameras=[view.camera.name for view in views],
        point=list(point) if point is not None else [f"e{row}" for row in range(count)],
        placement=placement,
        progress=progress,
    )


def _pair(
    first: View,
    second: View,
    rest: Sequence[View],
    volume_mm: FloatArray,
    seeds: FloatArray,
    seed_cov: FloatArray,
) -> Found:
    """Match by edges what lies on an edge, by windows what lies on texture or on neither."""
    pencil = Pencil.of(first.camera, second.camera)
    greys = (first.pixels.astype(np.float32), second.pixels.astype(np.float32))
    edges = (first.edges, second.edges)
    near, edge = _nearest(first.edges, seeds)
    lines = texture_lines(first.edges)
    textured = mostly_texture(lines)
    found = _nothing(len(seeds))
    if near.any() and not (textured and near.sum() < FEW * len(first.edges)):
        others = [(view.camera, view.edges) for view in rest]
        matches = match_edges(pencil, edges, greys, volume_mm, others)
        rows = np.flatnonzero(near)
        _put(found, rows, _by_edges(pencil, matches, edge[rows], seeds[rows], seed_cov[rows]))
    further = [(view.camera, view.pixels) for view in rest]
    on_texture = np.flatnonzero(near)
    wanted = wants_window(lines[edge[near]], found.flags[near], textured=textured)
    on_texture = on_texture[wanted]
    beside = np.flatnonzero(~near & all_finite(seeds, 1) & inside_image(first.camera, seeds))
    none = np.zeros(0, dtype=np.int64)
    no_edges = (first.edges.select(none), second.edges.select(none))
    if beside.size:
        around = no_edges if textured else edges
        windows = match_windows(pencil, greys, around, seeds[beside], volume_mm, others=further)
        _put(found, beside, _by_windows(windows))
    if on_texture.size:
        windows = match_windows(
            pencil, greys, no_edges, seeds[on_texture], volume_mm, others=further
        )
        part = _by_windows(windows)
        better = believes_window(
            lines[edge[on_texture]],
            (found.flags[on_texture], found.xy_px[on_texture]),
            (part.flags, part.xy_px),
        )
        _put(found, on_texture[better], _rows(part, better))
    outside = all_finite(found.xy_px, 1) & ~inside_image(second.camera, found.xy_px)
    found.flags[outside] |= int(Flag.outside_image)
    return found


def _put(found: Found, rows: IntArray, part: Found) -> None:
    for name in ("xy_px", "cov_px2", "mismatch", "flags"):
        getattr(found, name)[rows] = getattr(part, name)


def _rows(part: Found, rows: BoolArray) -> Found:
    return Found(part.xy_px[rows], part.cov_px2[rows], part.mismatch[rows], part.flags[rows])


def _by_edges(
    pencil: Pencil,
    matches: EdgeMatches,
    edge: IntArray,
    seeds: FloatArray,
    seed_cov: FloatArray,
) -> Found:
    axis = sweep_axis(pencil)
    xyz_mm = on_rays(pencil, seeds, matches.xyz_mm[edge, axis], axis)
    xy_px = pencil.second.project(xyz_mm)
    flags = matches.flags[edge]
    lost = ~all_finite(xy_px, 1)
    flags[lost & (flags == 0)] |= int(Flag.occluded)
    cov = _match_cov(matches, edge, seed_cov)
    cov[lost] = np.nan
    # a third view that agrees lowers the cost, even below nothing: a misfit is none then
    return Found(xy_px, cov, np.maximum(matches.cost[edge], 0.0), flags)


def _by_windows(matches: WindowMatches) -> Found:
    lost = ~all_finite(matches.xy_px, 1)
    flags = np.array(matches.flags)
    flags[lost & (flags == 0)] |= int(Flag.not_found)
    across = np.full(len(lost), ACROSS_PX**2)
    cov = along_and_across(matches.epipolar, matches.std_px**2, across)
    cov[lost] = np.nan
    return Found(np.array(matches.xy_px), cov, np.array(matches.cost), flags)


def _nothing(count: int) -> Found:
    """Return that nothing was found, to be filled in."""
    return Found(
        np.full((count, 2), np.nan),
        np.full((count, 2, 2), np.nan),
        np.full(count, np.nan),
        np.full(count, int(Flag.no_edge), dtype=np.int64),
    )


def _nearest(edges: EdgePoints, seeds: FloatArray) -> tuple[BoolArray, IntArray]:
    """Return which seeds lie on an edge, and the edge point nearest to each."""
    near, edge = np.zeros(len(seeds), dtype=bool), np.zeros(len(seeds), dtype=np.int64)
    known = np.flatnonzero(all_finite(seeds, 1))
    if len(edges) and known.size:
        distance, edge[known] = cKDTree(edges.xy_px).query(seeds[known])
        near[known] = distance <= ON_EDGE_PX
    return near, edge


def _match_cov(matches: EdgeMatches, edge: IntArray, seed_cov: FloatArray) -> FloatArray:
    """Return covariances of matches, given that the seeds' own are counted separately.

    The uncertainty along the epipolar curve is that of both edges. What the seed's covariance
    says along its curve is taken out, so that a position from both rows does not count it twice.
    """
    own = np.nan_to_num(0.5 * np.trace(seed_cov, axis1=1, axis2=2), nan=0.0)
    total = matches.std_px[edge] ** 2
    along = np.maximum(total - own * matches.rate[edge] ** 2, OWN_SHARE**2 * total)
    across = np.maximum(own, ACROSS_PX**2)
    return along_and_across(matches.epipolar[edge], along, across)


def _edge_cov(edges: EdgePoints, rows: IntArray) -> FloatArray:
    """Return isotropic covariances of edge points: the place along the edge is a choice."""
    variance = edges.noise_px[rows] ** 2 + edges.model_px[rows] ** 2
    return np.asarray(variance[:, None, None] * np.eye(2))
