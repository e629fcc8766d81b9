"""Whether images can be those of the cameras they were given for, judged by how much matches."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import permutations

import numpy as np

from closerange.errors import GeometryError
from closerange.geometry.arrays import FloatArray
from closerange.matching.correspondences import Correspondences
from closerange.matching.matcher import View, match_views
from closerange.rig.camera import Camera

SUSPICIOUS_SHARE = 0.5
"""Share of points matched without a flag below which other orders of the images are tried. Of the
edges of a part two views share more; a nearly symmetric pair of exchanged views, which shows the
relief turned inside out, matches up to two fifths."""

FEWEST = 20
"""Edge points matched without a flag from which an order of the images counts as one that fits."""

BETTER = 1.25
"""Factor by which another order must match more edge points. Usually it is above ten; where a pair
is nearly symmetric 1.4, and 1 for a flat part, which looks the same in both orders."""

MAX_CAMERAS = 4
"""Cameras up to which all orders of images are tried."""

NEARLY_NOTHING = 0.05
"""Share of points matched without a flag below which one is warned: chance gives as much."""

ENOUGH = 20
"""Points without which a share means nothing."""


def find_exchange(views: Sequence[View], volume_mm: FloatArray, found: Correspondences) -> str:
    """Tell whether the images seem to belong to other cameras than those they were given for.

    Parameters
    ----------
    views : sequence of View
        Cameras with the images as given.
    volume_mm : ndarray, shape (2, 3)
        Where points may be.
    found : Correspondences
        What was matched with them.

    Returns
    -------
    str
        One sentence without a full stop; empty where nothing says so.
    """
    located = found.found[:, 0]
    clean = int(found.clean.sum())
    if not located.any() or clean >= SUSPICIOUS_SHARE * located.sum() or len(views) > MAX_CAMERAS:
        return ""
    cameras = [view.camera for view in views]
    best, order = 0, tuple(range(len(views)))
    here = _count(cameras, views, order, volume_mm)
    for other in permutations(range(len(views))):
        if other == order or not _fits(cameras, views, other):
            continue
        count = _count(cameras, views, other, volume_mm)
        if count > best:
            best, chosen = count, other
    if best < FEWEST or best < BETTER * here:
        return ""
    moved = ", ".join(
        f"{views[place].camera.name!r} as {camera.name!r}"
        for camera, place in zip(cameras, chosen, strict=True)
        if views[place].camera is not camera
    )
    return (
        f"the images seem exchanged: {here} edge points match as they were given, {best} with the "
        f"image of {moved}"
    )


def few_match(found: Correspondences) -> str | None:
    """Say so if nearly nothing matches; None where enough does, or too little was asked."""
    located = int(found.found[:, 0].sum())
    clean = int(found.clean.sum())
    if located < ENOUGH or clean > NEARLY_NOTHING * located:
        return None
    return (
        f"{clean} of {located} points match without a flag: the images may not be of one moment, a "
        "camera may have been moved since the calibration, or the part lies outside of the volume"
    )


def _fits(cameras: Sequence[Camera], views: Sequence[View], order: tuple[int, ...]) -> bool:
    """Tell whether the images, in another order, have the sizes of the cameras."""
    return all(
        views[place].camera.size_px == camera.size_px
        for camera, place in zip(cameras, order, strict=True)
    )


def _count(
    cameras: Sequence[Camera],
    views: Sequence[View],
    order: tuple[int, ...],
    volume_mm: FloatArray,
) -> int:
    """Count the edge points that match with the images in some order."""
    given = [
        View(camera, views[place].pixels, views[place].edges)
        for camera, place in zip(cameras, order, strict=True)
    ]
    try:
        return int(np.count_nonzero(match_views(given, volume_mm).clean))
    except GeometryError:
        return 0
