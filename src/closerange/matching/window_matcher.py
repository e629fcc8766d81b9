"""Correspondences of points that lie on no edge: texture, speckle, centroids of faces and discs."""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from closerange.errors import InputError
from closerange.features.edges import EdgePoints
from closerange.flags import Flag
from closerange.geometry.arrays import FloatArray, IntArray, all_finite
from closerange.matching.pencil import Pencil
from closerange.matching.search import checked_volume, inside_image
from closerange.matching.window_candidates import OTHER_LEVEL
from closerange.matching.window_images import ImagePair, pyramid
from closerange.matching.window_information import (
    Information,
    chosen_sizes,
    half_widths,
)
from closerange.matching.window_plain import match_plain
from closerange.matching.window_planes import SeedRays
from closerange.matching.window_search import PIECE, Search, Spans
from closerange.matching.window_texture import UNSURE_PX, Found, match_textured, refining_scale
from closerange.rig.camera import Camera

EPIPOLAR_PX = 0.1
"""Standard deviation of epipolar curves: what a good calibration leaves."""


@dataclass(frozen=True, slots=True, eq=False)
class WindowMatches:
    """Matches of points by the windows around them; N points.

    Attributes
    ----------
    xyz_mm : ndarray, shape (N, 3)
        World point on the ray of each point; NaN without a match.
    xy_px : ndarray, shape (N, 2)
        Where it was found in the second view: up to a few tenths of a pixel beside the epipolar
        curve if the calibration is off by as much; NaN without a match.
    std_px : ndarray, shape (N,)
        Standard deviation along the epipolar curve in the second view.
    epipolar : ndarray, shape (N, 2)
        Unit vector along that curve.
    cost : ndarray, shape (N,)
        Misfit of the window or of the edges around the point, px along the curve.
    half_width_px : ndarray, shape (N,)
        Of the structuring element that was chosen.
    half_width_mm : ndarray, shape (N,)
        The same at the depth of the match. What is asked of a window, and the largest that is
        tried, follow the resolution: twice as many px per mm make it at most a step smaller.
    flags : ndarray of int, shape (N,)
        `Flag` bits; 0 for what may be relied upon.
    """

    xyz_mm: FloatArray
    xy_px: FloatArray
    std_px: FloatArray
    epipolar: FloatArray
    cost: FloatArray
    half_width_px: FloatArray
    half_width_mm: FloatArray
    flags: IntArray


def match_windows(
    pencil: Pencil,
    greys: tuple[NDArray[Any], NDArray[Any]],
    edges: tuple[EdgePoints, EdgePoints],
    xy_px: ArrayLike,
    volume_mm: ArrayLike,
    *,
    half_width_px: int | None = None,
    epipolar_px: float = EPIPOLAR_PX,
    others: Sequence[tuple[Camera, NDArray[Any]]] = (),
) -> WindowMatches:
    """Match points of the first view by what surrounds them.

    Where there is texture a window is correlated along the epipolar segment and refined; on plain
    surfaces the edges around the point tell its plane. Size and shape of the structuring element
    are chosen for each point from the images.

    Parameters
    ----------
    pencil : Pencil
        Of the two cameras.
    greys : tuple of two ndarrays, shape (H, W)
        Grey values of both images, float32; gain and offset between them may be anything.
    edges : tuple of two EdgePoints
        Of both views; empty where only texture is to be matched.
    xy_px : array_like, shape (N, 2)
        Points of the first view.
    volume_mm : array_like, shape (2, 3)
        Measuring volume; infinite where there is no limit.
    half_width_px : int, optional
        One half-width for the refinement of all points instead of a choice for each.
    epipolar_px : float, optional
        Standard deviation of the epipolar curves that the calibration leaves.
    others : sequence of (Camera, ndarray), optional
        Further views and their grey values: what a place explains there too speaks for it.

    Returns
    -------
    WindowMatches
        One row for each point.

    Raises
    ------
    InputError
        If the images are not as large as the cameras', the volume is none, or the window is
        smaller than 7 x 7 pixels or larger than the image.
    """
    volume = checked_volume(volume_mm)
    points = np.reshape(np.asarray(xy_px, np.float64), (-1, 2))
    _check(pencil, greys, half_width_px, epipolar_px)
    rays = SeedRays.of(pencil, points)
    found = Found.empty(len(points))
    if not len(points):
        return _matches(rays, found, volume)
    pair = ImagePair(greys)
    widths = half_widths(pencil.first.size_px[0]) if half_width_px is None else (half_width_px,)
    pair.prepare({refining_scale(width) for width in widths})
    information = Information.of(pair.greys[0], np.nan_to_num(points), widths)

    spans = Spans.of(pencil, rays, volume)
    size = _sizes(rays, spans.middle, information, widths, half_width_px is not None)
    found = _open(rays, spans)
    textured = np.flatnonzero((found.flags == int(Flag.no_edge)) & (size > 0))
    further = tuple(
        (camera, pyramid([np.asarray(grey, np.float32)], OTHER_LEVEL)) for camera, grey in others
    )
    search = Search(pencil, pair, volume, epipolar_px, further)
    search = search.swept(rays.select(textured), spans.select(textured))

    def piece(part: slice) -> Found:
        rows = textured[part]
        number = np.arange(len(textured))[part]
        return match_textured(search, rays.select(rows), size[rows], number)

    pieces = [slice(start, start + PIECE) for start in range(0, len(textured), PIECE)]
    # two at a time: OpenCV, BLAS and SciPy release the interpreter for most of the work
    with ThreadPoolExecutor(2) as pool:
        for part, matched in zip(pieces, pool.map(piece, pieces), strict=True):
            found.put(textured[part], matched)
    plain = np.flatnonzero(np.isfinite(found.omega) & (found.flags == int(Flag.no_edge)))
    if plain.size:
        middle = found.omega[plain]
        found.put(plain, match_plain(pencil, rays.select(plain), middle, edges, volume))
    return _matches(rays, found, volume)


def _open(rays: SeedRays, spans: Spans) -> Found:
    """Mark the points to be matched as `no_edge`, in the middle of their segments."""
    found = Found.empty(len(rays))
    inside = inside_image(rays.first, rays.xy_px)
    found.flags[:] = np.where(inside | (spans.flags != 0), spans.flags, int(Flag.outside_image))
    rows = np.flatnonzero(found.flags == 0)
    found.omega[rows] = spans.middle[rows]
    found.flags[rows] = int(Flag.no_edge)
    return found


def _sizes(
    rays: SeedRays,
    middle: FloatArray,
    information: Information,
    widths: tuple[int, ...],
    fixed: bool,
) -> IntArray:
    """Return the half-width of each window, px; 0 where there is no texture."""
    sizes = np.zeros(len(rays), dtype=np.int64)
    known = np.isfinite(middle)
    if not known.any():
        return sizes
    back = rays.select(known).back(middle[known])
    # the second image is as noisy as the first
    told = information.select(known).along(np.nan_to_num(back)) / 2
    chosen = chosen_sizes(told, widths, UNSURE_PX if fixed else None)
    sizes[known] = np.where(chosen >= 0, np.array(widths)[chosen], 0)
    return sizes


def _matches(rays: SeedRays, found: Found, volume_mm: FloatArray) -> WindowMatches:
    xyz = rays.at(found.omega)
    known = all_finite(xyz, 1)
    pace = np.full((len(rays), 2), np.nan)
    pace[known] = rays.select(known).pace(found.omega[known])
    # omega falls with the way along the ray: the curve runs away from the first camera
    epipolar = -pace / np.linalg.norm(pace, axis=1, keepdims=True)
    # across was counted from the direction of growing omega
    beside = np.column_stack([epipolar[:, 1], -epipolar[:, 0]])
    flags = found.flags.copy()
    with np.errstate(invalid="ignore"):
        outside = known & ~((xyz >= volume_mm[0]) & (xyz <= volume_mm[1])).all(axis=1)
    flags[outside] |= int(Flag.outside_volume)
    flags[~known & (flags == 0)] |= int(Flag.not_found)
    focal = np.sqrt(rays.first.matrix_px[0, 0] * rays.first.matrix_px[1, 1])
    return WindowMatches(
        xyz,
        rays.second.project(xyz) + found.across_px[:, None] * beside,
        found.std_px,
        epipolar,
        found.cost,
        found.half_width_px,
        found.half_width_px / (focal * found.omega),
        flags,
    )


def _check(
    pencil: Pencil,
    greys: tuple[NDArray[Any], NDArray[Any]],
    half_width_px: int | None,
    epipolar_px: float,
) -> None:
    for camera, grey in zip((pencil.first, pencil.second), greys, strict=True):
        width, height = camera.size_px
        if np.shape(grey) != (height, width):
            raise InputError(
                f"the image of camera {camera.name!r} has the shape {np.shape(grey)}, its "
                f"calibration is for {height} rows of {width} pixels",
                remedy="give the whole image of the camera, in grey values",
            )
        if half_width_px is not None and not 3 <= half_width_px <= min(width, height) // 2:
            raise InputError(
                f"windows of {half_width_px} px on each side; possible are 3 to "
                f"{min(width, height) // 2}",
                remedy="leave the size out: it is then chosen for each point",
            )
    if not (np.isfinite(epipolar_px) and epipolar_px > 0):
        raise InputError(
            f"an uncertainty of epipolar curves of {epipolar_px} px",
            remedy="give a number above zero, such as 0.1",
        )
