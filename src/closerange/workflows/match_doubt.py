"""Whether images can be those of the cameras they were given for, judged by how much matches."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import combinations, permutations
from typing import NamedTuple

import numpy as np
from scipy.spatial import cKDTree

from closerange.errors import GeometryError
from closerange.flags import Flag
from closerange.geometry.arrays import FloatArray, IntArray
from closerange.matching.correspondences import Correspondences
from closerange.matching.matcher import View, match_views
from closerange.rig.camera import Camera

SUSPICIOUS_SHARE = 0.5
"""Share of points matched without a flag below which other orders of the images are tried. Of the
edges of a part two views share more; a nearly symmetric pair of exchanged views, which shows the
relief turned inside out, matches up to two fifths."""

SAMPLE = 500
"""Edge points by which an order of the images is judged: a share is good to 2 %."""

FEWEST = 20
"""Edge points matched without a flag from which an order of the images may be one that fits."""

FITTING_SHARE = 0.1
"""Share of them from which it may be, and by which it must be better than the one given: an edge
or two more are chance, and repeated parts, each taken for its neighbour, make little more."""

BETTER = 1.25
"""Factor by which another order must match more edge points. Usually it is above ten; where a pair
is nearly symmetric 1.4, and 1 for a flat part, which looks the same in both orders."""

MAX_CAMERAS = 4
"""Cameras up to which all orders of images are tried; in a larger rig only among those named."""

NEARLY_NOTHING = 0.15
"""Share of points matched without a flag below which one is warned: of two images that have nothing
in common a tenth may match by chance."""

ENOUGH = 20
"""Points without which a share means nothing."""

SAME_PX, SAME_TURN_RAD, SAME_SHARE = 1.0, float(np.deg2rad(15.0)), 0.8
"""Two images show one view if so many edge points of the one have an edge of the same direction in
the other at the same place. Of two cameras' views of one part 1 to 3 % do, of two exposures of one
camera 99 %, even with more noise or less light."""

EVIDENT = {
    Flag.saturated: "lower the exposure",
    Flag.outside_image: "check their coordinates, and that the part is in all images",
    Flag.outside_volume: "widen the volume, with --z or --volume",
    Flag.untrusted: "calibrate again; the report of the calibration says what is missing",
    Flag.no_edge: "check that the part lies within the volume, and its contrast",
}
"""Flags that say by themselves why there is no match, and what to do."""

OTHERWISE = (
    "look at the flags; check focus, the images and their order, the volume, and that the rig took "
    "them"
)


@dataclass(frozen=True, slots=True)
class Doubt:
    """What is wrong with images and cameras as a whole; blank where nothing is.

    Attributes
    ----------
    verdict : str
        Why no match can be relied upon; one sentence without a full stop.
    remedy : str
        What to do about it.
    note : str
        What one should know, although the matches may be good.
    """

    verdict: str = ""
    remedy: str = ""
    note: str = ""


def find_doubt(
    views: Sequence[View],
    rig: Sequence[Camera],
    volume_mm: FloatArray,
    found: Correspondences,
    *,
    literal: bool,
) -> Doubt:
    """Tell whether the images seem to be others than those they were given for.

    Parameters
    ----------
    views : sequence of View
        Cameras with the images as given.
    rig : sequence of Camera
        All cameras that an image may be of.
    volume_mm : ndarray, shape (2, 3)
        Where points may be.
    found : Correspondences
        What was matched with them.
    literal : bool
        By the thesis' method, which takes the best place of each point however bad it is: how
        much it finds says nothing, and the program's matcher is asked instead.

    Returns
    -------
    Doubt
        The gravest; blank where nothing speaks against the images.
    """
    if same := _same_view(views):
        return Doubt(
            f"the images of {same} show one view: their edges stand at the same places",
            "give each camera its own image",
        )
    located = int(found.found[:, 0].sum())
    if not located:
        return Doubt()
    enough = not literal and located >= ENOUGH and found.clean.sum() >= SUSPICIOUS_SHARE * located
    return Doubt() if enough else _of_orders(views, rig, volume_mm, literal=literal)


def few_match(found: Correspondences) -> str | None:
    """Say so if nearly nothing matches in a view; None where enough does, or little was asked."""
    located = int(found.found[:, 0].sum())
    kept = found.found & (found.flags == 0) & (found.flags[:, :1] == 0)
    poorest = 1 + int(kept[:, 1:].sum(axis=0).argmin())
    clean = int(kept[:, poorest].sum())
    if located < ENOUGH or clean > NEARLY_NOTHING * located:
        return None
    what = f"{clean} of {located} points match without a flag"
    if len(found.cameras) > 2:
        what += f" in camera {found.cameras[poorest]!r}"
    if (flag := evident_flag(found)) is not None:
        return f"{what}; most are flagged {flag.name}: {EVIDENT[flag]}"
    return (
        f"{what}: the images may be blurred or not of one moment, a camera may have been moved "
        "since the calibration, or the part lies outside of the volume"
    )


def evident_flag(found: Correspondences) -> Flag | None:
    """Return the flag of most points, if it says by itself why they have no match."""
    often = [flag for flag, count in flags_of(found) if flag in EVIDENT and 2 * count > len(found)]
    return often[0] if often else None


def flags_of(found: Correspondences) -> list[tuple[Flag, int]]:
    """Return the flags of points with their number, the most frequent first."""
    counts = Counter(bit for flags in found.point_flags for bit in Flag if bit in Flag(int(flags)))
    return counts.most_common()


def _same_view(views: Sequence[View]) -> str:
    """Name two cameras that were given images of one view; blank if there are none."""
    for a, b in combinations(views, 2):
        if a.camera.size_px != b.camera.size_px or not len(b.edges):
            continue
        rows = np.flatnonzero(a.strong)
        away, nearest = cKDTree(b.edges.xy_px).query(a.edges.xy_px[rows])
        along = np.einsum("ij,ij->i", a.edges.normal[rows], b.edges.normal[nearest])
        same = (away < SAME_PX) & (along > np.cos(SAME_TURN_RAD))
        if len(rows) >= ENOUGH and same.mean() > SAME_SHARE:
            return f"{a.camera.name!r} and {b.camera.name!r}"
    return ""


def _of_orders(
    views: Sequence[View], rig: Sequence[Camera], volume_mm: FloatArray, *, literal: bool
) -> Doubt:
    """Match a sample of edge points with the images as given, and as those of other cameras."""
    given = tuple(view.camera for view in views)
    rows = _sample(views[0])
    here = _count(views, given, rows, volume_mm)
    if here >= SUSPICIOUS_SHARE * len(rows):
        return Doubt()
    best, chosen = 0, given
    for order in _orders(given, rig):
        count = _count(views, order, rows, volume_mm)
        if count > best:
            best, chosen = count, order
        if best >= SUSPICIOUS_SHARE * len(rows):
            break
    much = max(FEWEST, FITTING_SHARE * len(rows))
    if best >= much and best * BETTER >= here:
        better = best >= BETTER * here and best - here >= much
        return _exchanged(views, chosen, _Counts(here, best, len(rows)), better=better)
    if literal and len(rows) >= ENOUGH and here <= NEARLY_NOTHING * len(rows):
        return Doubt(
            f"the program's matcher keeps {here} of {len(rows)} edge points in these images, and "
            "the literal method cannot tell a bad match from a good one",
            "check focus, exposure, the images and their order, the volume, and that the rig took "
            "them",
        )
    return Doubt()


def _orders(given: tuple[Camera, ...], pool: Sequence[Camera]) -> Iterator[tuple[Camera, ...]]:
    """Yield other choices of cameras that the images may be of, by their sizes."""
    whole = pool if len(pool) <= MAX_CAMERAS else given
    if len(whole) > MAX_CAMERAS:
        return
    for order in permutations(whole, len(given)):
        pairs = list(zip(given, order, strict=True))
        if all(a.size_px == b.size_px for a, b in pairs) and any(a is not b for a, b in pairs):
            yield order


class _Counts(NamedTuple):
    """Edge points that match with the images as given, and of other cameras, of so many."""

    here: int
    there: int
    asked: int


def _exchanged(
    views: Sequence[View], order: Sequence[Camera], counts: _Counts, *, better: bool
) -> Doubt:
    """Say that the images fit other cameras better, or as well."""
    moved = " and ".join(
        f"the image given for {view.camera.name!r} is that of {camera.name!r}"
        for view, camera in zip(views, order, strict=True)
        if view.camera is not camera
    )
    found = (
        f"{counts.here} of {counts.asked} edge points match as they were given, {counts.there} if "
        f"{moved}"
    )
    if better:
        return Doubt(f"the images seem exchanged: {found}", "give each camera its own image")
    return Doubt(
        note=f"the images would fit as well if they were exchanged: {found}; so it is with a flat "
        "or symmetric part: check that each camera has its own image"
    )


def _sample(view: View) -> IntArray:
    """Draw strong edge points of an image, the same ones each time.

    Not every third: points are sorted by rows, and of an upright part, with an even number of
    edges in each row, a fixed step may leave out the same edges everywhere.
    """
    rows = np.flatnonzero(view.strong)
    if len(rows) <= SAMPLE:
        return rows
    return np.sort(np.random.default_rng(0).choice(rows, SAMPLE, replace=False))


def _count(
    views: Sequence[View], order: Sequence[Camera], rows: IntArray, volume_mm: FloatArray
) -> int:
    """Count the edge points of the first image that match if the images are of these cameras."""
    given = [
        View(camera, view.pixels, view.edges) for camera, view in zip(order, views, strict=True)
    ]
    seeds = views[0].edges.xy_px[rows]
    try:
        return int(np.count_nonzero(match_views(given, volume_mm, seeds_px=seeds).clean))
    except GeometryError:
        return 0
