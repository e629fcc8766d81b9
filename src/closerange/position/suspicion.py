"""Whether image points can be those of a rig at all, and what else they might be."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from itertools import combinations, permutations

import numpy as np

from closerange.errors import CloseRangeError, CloseRangeWarning
from closerange.features.image_points import ImagePoints
from closerange.geometry.arrays import BoolArray
from closerange.rig.rig import Rig

DOUBTFUL_SHARE = 0.2
"""Share of points that contradict the rig above which the rig is suspected, not the points: wrong
pairs are rarer. Exchanged cameras of a symmetric pair give less than half."""

MOST = 0.5
"""Share above which the table cannot be relied upon: points that fit are then the minority, and
nothing tells them from those that contradict less by luck."""

FEWEST = 3
"""Fewer points that contradict may be chance blunders."""

EXPLAINED = 0.75
"""An explanation holds if this share of the contradictions vanishes with it: what is left must be
rarer than what would be doubted on its own (`DOUBTFUL_SHARE` of all, if all contradicted)."""

TRIED = 200
"""Points on which explanations are tried: enough to tell 5 % from 20 % with certainty."""

MAX_PERMUTED = 4
"""Cameras up to which all orders are tried (23 besides the right one); of more, only pairs."""

SCALES = (2.0, 0.5, 4.0, 0.25)
"""Sizes of image that binning and halving give."""

REMEDY = (
    "measure again with the right images or rig file, or calibrate again; the table is written to "
    "be looked at, not relied on"
)


class DoubtWarning(CloseRangeWarning):
    """Warns that most of the points cannot be those of the rig."""


@dataclass(frozen=True, slots=True)
class Doubt:
    """Why image points do not seem to belong to a rig.

    Attributes
    ----------
    text : str
        One sentence, without a full stop.
    grave : bool
        Most points contradict, or an exchange or another size of image explains them: what was
        measured cannot be relied upon.
    """

    text: str
    grave: bool


def find_doubt(
    rig: Rig,
    points: ImagePoints,
    contradicts: BoolArray,
    miss_px: float,
    contradictions: Callable[[Rig, ImagePoints], BoolArray],
) -> Doubt | None:
    """Judge how many points contradict the rig, and look for the reason.

    Parameters
    ----------
    rig : Rig
        Calibrated cameras.
    points : ImagePoints
        What was measured.
    contradicts : ndarray of bool, shape (M,)
        Which of the M points that should be measurable do not fit the rig.
    miss_px : float
        By how much the rays of these miss each other (rms); NaN if they do not meet at all.
    contradictions : callable
        Gives `contradicts` for other image points.

    Returns
    -------
    Doubt or None
        None where points fit, but for single blunders.
    """
    count, total = int(contradicts.sum()), len(contradicts)
    if count < FEWEST or count <= DOUBTFUL_SHARE * total:
        return None
    text = (
        f"the rays of {count} of {total} points miss each other by {miss_px:.2f} px rms, the "
        f"calibration left {rig.noise_px:.3f} px: "
        if np.isfinite(miss_px)
        else f"the rays of {count} of {total} points do not meet before the cameras: "
    )
    some = _some(points)
    for words, other in (*_exchanges(rig, some), *_scalings(some)):
        left = _tried(rig, other, contradictions)
        if left.size and left.mean() <= (1 - EXPLAINED) * count / total:
            fit = f"{len(left) - int(left.sum())} of {len(left)} points fit"
            return Doubt(f"{text}{words} {fit}", grave=True)
    text += (
        "a camera was moved, the images are not of one moment, or this is another rig's file "
        "(neither exchanged cameras nor another image size explain it)"
    )
    return Doubt(text, grave=count > MOST * total)


def _tried(
    rig: Rig, points: ImagePoints, contradictions: Callable[[Rig, ImagePoints], BoolArray]
) -> BoolArray:
    """Return which points contradict; none where they cannot even be those of the rig's images."""
    try:
        return contradictions(rig, points)
    except CloseRangeError:
        return np.zeros(0, np.bool_)


def _some(points: ImagePoints) -> ImagePoints:
    """Keep all views of points that are spread over the table."""
    keys = list(zip(points.placement, points.reading, points.point, strict=True))
    unique = list(dict.fromkeys(keys))
    places = np.unique(np.linspace(0, len(unique) - 1, TRIED).astype(np.int64))
    chosen = {unique[place] for place in places}
    return points.select([key in chosen for key in keys])


def _exchanges(rig: Rig, points: ImagePoints) -> Iterator[tuple[str, ImagePoints]]:
    """Give the cameras each other's images."""
    names = [camera.name for camera in rig.cameras]
    orders = list(permutations(names)) if len(names) <= MAX_PERMUTED else []
    if not orders:
        for one, two in combinations(names, 2):
            swap = {one: two, two: one}
            orders.append(tuple(swap.get(name, name) for name in names))
    for order in orders:
        given = dict(zip(names, order, strict=True))
        moved = ", ".join(f"{a!r} as {b!r}" for a, b in given.items() if a != b)
        if moved:
            exchanged = tuple(given[name] for name in points.camera)
            other = replace(points, camera=exchanged, size_px={})
            yield f"the cameras' images seem exchanged: with {moved},", other


def _scalings(points: ImagePoints) -> Iterator[tuple[str, ImagePoints]]:
    """Take points as those of images of another size; not where the size is known to be right."""
    if points.size_px:
        return
    for scale in SCALES:
        xy = (points.xy_px + 0.5) * scale - 0.5
        other = replace(points, xy_px=xy, cov_px2=scale**2 * points.cov_px2)
        yield f"the images seem to be of another size: with x_px, y_px times {scale:g},", other
