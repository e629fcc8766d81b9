"""The verb `match`: points of one image found in the images of other cameras."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import ArrayLike

from closerange.errors import CloseRangeWarning, DetectionError
from closerange.features.edge_chains import chain_places
from closerange.features.image_points import ImagePoints
from closerange.flags import Flag
from closerange.geometry.arrays import BoolArray, FloatArray, IntArray, all_finite
from closerange.images import Frame, check_frame
from closerange.matching.corner_matcher import match_corners
from closerange.matching.correspondences import Correspondences
from closerange.matching.literal import match_literal
from closerange.matching.matcher import View, match_views, views_of
from closerange.matching.sight import inside_image
from closerange.matching.volume_proposal import check_in_view
from closerange.position.suspicion import DoubtWarning
from closerange.rig.rig import Rig
from closerange.rig.rig_file import read_rig
from closerange.workflows.match_doubt import few_match, find_doubt
from closerange.workflows.match_inputs import (
    LITERAL_PX,
    Images,
    Method,
    Origin,
    Points,
    Wanted,
    read_frames,
    read_seeds,
    volume_of,
)

Progress = Callable[[int, int], None]
LITERAL_VARIANCE_PX2 = 1 / 6
"""Least variance of a literal match in x and in y: its element is cut around a whole pixel and
placed on a whole pixel, and either rounding has the variance 1/12."""

SATURATED_REACH_PX = 2
"""Pixels around a point that may hold no saturated one: the blur of edge and operator. More than
1 % of 25 pixels is any of them."""

__all__ = ["Matched", "Wanted", "match", "match_images"]


@dataclass(frozen=True, slots=True, eq=False)
class Matched:
    """What the verb `match` has found.

    Attributes
    ----------
    matches : Correspondences
        Points, the reference camera first.
    doubt : str
        Why the images do not seem to be those of the cameras; empty where nothing says so.
    remedy : str
        What to do about it.
    volume_mm : ndarray, shape (2, 3)
        Where matches were sought; infinite where there was no limit.
    volume_origin : {"stated", "rig", "proposed"}
        Whether that volume was given, is the rig's, or was proposed because the rig's is flat.
    """

    matches: Correspondences
    doubt: str
    remedy: str
    volume_mm: FloatArray
    volume_origin: Origin


def match(  # noqa: PLR0913
    rig: Rig | Path | str,
    images: Images,
    *,
    points: Points | None = None,
    edges: bool = False,
    corners: bool = False,
    z_mm: tuple[float, float] | None = None,
    volume_mm: ArrayLike | None = None,
    placement: str | None = None,
    method: Method = "default",
    element_px: int | None = None,
    progress: Progress | None = None,
) -> Correspondences:
    """Find points of one image in the images of other cameras.

    Parameters
    ----------
    rig : Rig or path
        Calibrated cameras, or their file.
    images : mapping of str to path or Frame
        One image of each camera, taken at one moment, by the camera's name. The points are those
        of the first, unless `points` are of another.
    points : ImagePoints, Correspondences or path, optional
        Points to be found: rows of one camera and one placement, of `Correspondences` those of
        the first camera. Names, placement, reading, covariances and flags are kept and the rows
        are repeated unmoved. A match carries the flags of its point: what displaces the one
        displaces the other. Points outside of the image and points without a position stay in
        the table, flagged, without matches.
    edges : bool, optional
        All edge points instead; the default if neither `points` nor `corners` are given. They are
        named ``e{chain}.{place}``: neighbours on an edge have successive places.
    corners : bool, optional
        Corners instead, where straight pieces of edges meet.
    z_mm : (float, float), optional
        Least and largest Z of the points; replaces the rig's volume in Z and lifts its limits in
        X and Y.
    volume_mm : array_like, shape (2, 3), optional
        Lower and upper corner of the volume in which the points are. By default the rig's; where
        that is flat, what `propose_volume` proposes for the cameras.
    placement : str, optional
        Name for the rows of edges and corners; of `points`, the placement whose rows are used.
    method : {"default", "literal"}, optional
        The program's matcher, or that of the thesis' chapter 5 for comparison.
    element_px : int, optional
        Side of the literal method's structuring element, odd; 15 by default. The default method
        chooses its elements itself.
    progress : callable, optional
        Called with (done, total) after each pair of cameras.

    Returns
    -------
    Correspondences
        One row for each point, the reference camera first, then the others as given. A match
        that may not be relied upon carries flags; one that was not found is NaN and flagged.
        With an untrustworthy rig all matches are flagged `untrusted`; where the images do not
        seem to be those of the cameras, `ambiguous`.

    Raises
    ------
    InputError
        If a file or an option cannot be used, a camera is not in the rig, or an image has
        another size than its camera.
    DataError
        If an image is uniform, has no edges or corners where they are asked for, or the volume
        is not in view.

    Warns
    -----
    DoubtWarning
        If the images do not seem to be those of the cameras: exchanged, or of one view; with the
        literal method, also if the program's matcher finds nearly nothing in them.
    CloseRangeWarning
        If nearly nothing matches, or the images would fit as well if they were exchanged.
    """
    wanted = Wanted(
        points=points, edges=edges, corners=corners, z_mm=z_mm, volume_mm=volume_mm,
        placement=placement, method=method, element_px=element_px,
    )  # fmt: skip
    matched = match_images(rig, images, wanted, progress=progress)
    if matched.doubt:
        warnings.warn(matched.doubt, DoubtWarning, stacklevel=2)
    return matched.matches


def match_images(
    rig: Rig | Path | str, images: Images, wanted: Wanted, *, progress: Progress | None = None
) -> Matched:
    """Do what `match` does; return the doubt beside the matches instead of warning of it."""
    rig = rig if isinstance(rig, Rig) else read_rig(rig)
    frames = read_frames(rig, images)
    volume, origin = volume_of(rig, frames, z_mm=wanted.z_mm, volume_mm=wanted.volume_mm)
    seeds = None
    if wanted.points is not None:
        seeds = read_seeds(wanted.points, frames, wanted.placement)
        frames = {seeds.camera[0]: frames[seeds.camera[0]], **frames}  # the reference comes first
    views = views_of([rig.camera(name) for name in frames], [f.pixels for f in frames.values()])
    for view, frame in zip(views, frames.values(), strict=True):
        if not len(view.edges):
            check_frame(frame)  # not before: it takes a dense speckle for noise
    found = _found(views, volume, wanted, seeds, progress)
    found = _with_marks(found, frames, untrusted=not rig.trusted)
    doubt = find_doubt(views, rig.cameras, volume, found, literal=wanted.literal)
    if doubt.verdict:
        found = _flag_matches(found, int(Flag.ambiguous))
    elif note := doubt.note or few_match(found):
        warnings.warn(note, CloseRangeWarning, stacklevel=3)
    return Matched(found, doubt.verdict, doubt.remedy, volume, origin)


def _found(
    views: list[View],
    volume_mm: FloatArray,
    wanted: Wanted,
    seeds: ImagePoints | None,
    progress: Progress | None,
) -> Correspondences:
    """Match what is asked for."""
    if seeds is not None:
        return _of_seeds(views, volume_mm, wanted, seeds, progress)
    first, placement = views[0], wanted.placement or ""
    if wanted.corners:
        found = match_corners(views, volume_mm, placement=placement, progress=progress)
        if not len(found):
            raise _nothing_there(first, "corners")
        return found
    rows = np.flatnonzero(first.strong)
    if not rows.size:
        raise _nothing_there(first, "edges")
    variance = first.edges.noise_px[rows] ** 2 + first.edges.model_px[rows] ** 2
    seeds = ImagePoints.of(
        camera=first.camera.name,
        placement=placement,
        point=edge_names(first.edges.after, rows),
        xy_px=first.edges.xy_px[rows],
        cov_px2=variance[:, None, None] * np.eye(2),
    )
    return _of_seeds(views, volume_mm, wanted, seeds, progress)


def _nothing_there(view: View, what: str) -> DetectionError:
    return DetectionError(
        f"the image of camera {view.camera.name!r} has no {what}",
        remedy="check focus, exposure and lighting, or give points with --points",
    )


def edge_names(after: IntArray, rows: IntArray) -> list[str]:
    """Name edge points by their chain and their place on it.

    Parameters
    ----------
    after : ndarray of int, shape (N,)
        The next point of each point's chain, or -1.
    rows : ndarray of int, shape (M,)
        Points to be named.

    Returns
    -------
    list of str
        ``e{chain}.{place}``.
    """
    chain, place = chain_places(after)
    return [f"e{chain[row]}.{place[row]}" for row in rows]


def _of_seeds(
    views: list[View],
    volume_mm: FloatArray,
    wanted: Wanted,
    seeds: ImagePoints,
    progress: Progress | None,
) -> Correspondences:
    """Match points; repeat their rows unmoved and carry their flags to the matches."""
    if wanted.literal:
        side_px = wanted.element_px or LITERAL_PX
        found = _literal(views, volume_mm, side_px, seeds, progress)
    else:
        found = match_views(
            views,
            volume_mm,
            seeds_px=seeds.xy_px,
            seeds_cov_px2=seeds.cov_px2,
            point=seeds.point,
            progress=progress,
        )
    outside = seeds.found & ~inside_image(views[0].camera, seeds.xy_px)
    own = seeds.flags | np.where(outside, int(Flag.outside_image), 0)
    lost = outside | ~seeds.found
    xy, cov = found.xy_px.copy(), found.cov_px2.copy()
    flags = found.flags | own[:, None]
    xy[lost, 1:], cov[lost, 1:] = np.nan, np.nan
    flags[lost] = own[lost, None]
    xy[:, 0], cov[:, 0], flags[:, 0] = seeds.xy_px, seeds.cov_px2, own
    return replace(
        found,
        placement=seeds.placement,
        reading=seeds.reading,
        xy_px=xy,
        cov_px2=cov,
        mismatch=np.where(lost, np.nan, found.mismatch),
        flags=flags,
    )


def _literal(
    views: list[View],
    volume_mm: FloatArray,
    element_px: int,
    seeds: ImagePoints,
    progress: Progress | None,
) -> Correspondences:
    """Match with the thesis' method, the first view with each of the others."""
    first = views[0]
    check_in_view([view.camera for view in views], volume_mm)
    xy, flags, mismatch = [seeds.xy_px], [seeds.flags], np.full(len(seeds), np.nan)
    for done, other in enumerate(views[1:], start=1):
        found = match_literal(
            (first.pixels, other.pixels), (first.camera, other.camera), seeds.xy_px, volume_mm,
            side_px=element_px,
        )  # fmt: skip
        xy.append(found.xy_px)
        flags.append(found.flags)
        mismatch = np.fmin(mismatch, found.mismatch)
        if progress:
            progress(done, len(views) - 1)
    places = np.stack(xy, axis=1)
    known = all_finite(places, 2)
    cov = np.where(known[..., None, None], LITERAL_VARIANCE_PX2 * np.eye(2), np.nan)
    return Correspondences.of(
        cameras=[view.camera.name for view in views],
        point=seeds.point,
        xy_px=places,
        cov_px2=cov,
        mismatch=mismatch,
        flags=np.stack(flags, axis=1),
    )


def _with_marks(
    found: Correspondences, frames: Mapping[str, Frame], *, untrusted: bool
) -> Correspondences:
    """Flag what lies beside saturated pixels, and all matches of a rig that is not trusted."""
    flags = found.flags.copy()
    side = 2 * SATURATED_REACH_PX + 1
    for column, name in enumerate(found.cameras):
        full = (frames[name].pixels >= frames[name].full_scale).astype(np.uint8)
        if not full.any():
            continue
        near = cv2.dilate(full, np.ones((side, side), np.uint8))
        rows = np.flatnonzero(found.found[:, column])
        pixel = np.rint(found.xy_px[rows, column]).astype(np.int64)
        inside = ((pixel >= 0) & (pixel < frames[name].size_px)).all(axis=1)
        rows, pixel = rows[inside], pixel[inside]
        beside: BoolArray = np.asarray(near)[pixel[:, 1], pixel[:, 0]] > 0
        flags[rows[beside], column] |= int(Flag.saturated)
    found = replace(found, flags=flags)
    return _flag_matches(found, int(Flag.untrusted)) if untrusted else found


def _flag_matches(found: Correspondences, flag: int) -> Correspondences:
    """Flag every match that has a position; the points themselves are what they were."""
    flags = found.flags.copy()
    flags[:, 1:] |= np.where(found.found[:, 1:], flag, 0)
    return replace(found, flags=flags)
