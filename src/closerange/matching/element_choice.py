"""The best structuring element for each point, chosen from the two images alone.

The thesis leaves open (section VII.4) how large a structuring element should be and of what
shape. A small one has few edges and fits in many places; a large one reaches over surfaces of
other depths, which move against each other from view to view. Here all elements of a set are
scanned, and these are asked of each: does its match, matched back, return to the point; is the
point's own edge there; how far does its best place stand out from all others, in units of what
chance makes; and do the other elements, smaller and larger, fit there too.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields, replace

import numpy as np
from numpy.typing import ArrayLike

from closerange.errors import InputError
from closerange.flags import Flag
from closerange.geometry.arrays import BoolArray, FloatArray, IntArray, all_finite
from closerange.matching.literal import BAND_PX, LiteralMatcher, Search
from closerange.matching.literal_band import Bands
from closerange.matching.literal_element import footprint, strip_footprint
from closerange.matching.literal_matches import LiteralMatches, join_matches
from closerange.matching.literal_scan import Chosen, Hits, choose_places
from closerange.rig.camera import Camera

SIZES_PX = (9, 15, 21, 29, 41, 59)
"""Sides of elements: from a few edge widths to the thesis' largest, in steps of about 1.45."""

ELEMENTS = tuple(
    (shape, size) for shape in ("square", "disc", "cross", "strip") for size in SIZES_PX
)
"""Shapes and sizes to choose from; a strip follows the edge through its candidate."""

PEAK_PX = 2
"""Places so near to the best one belong to it: an edge is a band of two or three pixels, which
still covers a part of itself two pixels away."""

THICKNESS_PX = 3.0
"""Pixels across an edge, which are there or missing together: so many are one observation."""

OWN_SHARE = 0.5
"""Share of the best that the smallest element finds anywhere which it must find at a place: half
of a candidate's own edge may be hidden, or lost in the threshold, but not all of it."""

UNLIKE = 0.1
"""Share of an element's pixels that may be missing for a common cause (another depth, a shadow, a
threshold) however large it is. The choice hardly depends on it: see
`benchmarks/bench_structuring.py`."""

RETURN_PX = 2.0
"""A match, matched back, returns to within this: both are rounded to whole pixels (0.7 px each) and
may be a tie's neighbour (0.5 px)."""

_DIRECTIONS = 16  # a strip of 59 px turned by half a step ends 3 px off, inside its width of 19
_NEAR_PX = 4  # half a window in which an edge's direction is measured: half of the smallest element
_PIECE = 1024  # points whose counts for all elements are held at once: 8 MB for segments of 160 px


@dataclass(frozen=True, slots=True, eq=False)
class ElementChoice:
    """Matches of N points with the element that was chosen for each among K.

    Attributes
    ----------
    matches : LiteralMatches
        Of the chosen elements; `inconsistent` marks those that do not return.
    element : ndarray of int, shape (N,)
        Which element was chosen; -1 without a match.
    xy_px : ndarray, shape (N, K, 2)
        Match of every element; NaN without one.
    distinctness : ndarray, shape (N, K)
        Pixels by which the best place beats the best one elsewhere, in standard deviations of
        chance; 0 without a match.
    support : ndarray, shape (N, K)
        How well all elements fit there: the mean of pixels present over the most present
        anywhere, 0 to 1.
    returns : ndarray of bool, shape (N, K)
        Whether the match, matched back with an element of the same kind, returns to the point.
    centred : ndarray of bool, shape (N, K)
        Whether the point lies on an edge and that edge is there too, as seen by the smallest
        element.
    """

    matches: LiteralMatches
    element: IntArray
    xy_px: FloatArray
    distinctness: FloatArray
    support: FloatArray
    returns: BoolArray
    centred: BoolArray

    def __len__(self) -> int:
        return len(self.element)


def match_with_best_element(
    cameras: Sequence[Camera],
    masks: Sequence[BoolArray],
    xy_px: ArrayLike,
    volume_mm: ArrayLike,
    *,
    elements: Sequence[tuple[str, int]] = ELEMENTS,
    band_px: float = BAND_PX,
    progress: Callable[[int, int], None] | None = None,
) -> ElementChoice:
    """Match points of view 1, each with the structuring element that suits it best.

    Parameters
    ----------
    cameras : sequence of two Cameras
        View 1 and view 2.
    masks : sequence of two ndarrays of bool, shape (H, W)
        Edge pixels; see `closerange.matching.literal.binary_images`.
    xy_px : array_like, shape (N, 2)
        Points of view 1.
    volume_mm : array_like, shape (2, 3)
        Where the points may be.
    elements : sequence of (str, int), optional
        Shape ("square", "disc", "cross" or "strip") and odd size of each element.
    band_px : float, optional
        Half-width of the neighbourhood around the segment.
    progress : callable, optional
        Called with the number of elements done and of all, for each piece of the points.

    Returns
    -------
    ElementChoice
        Elements whose match returns go before those whose match does not, then those that are
        centred before others, then the larger product of distinctness and support; of equal ones
        the first.

    Raises
    ------
    InputError
        If there is no element, and as `closerange.matching.literal.LiteralMatcher` and its
        elements do.
    """
    if not elements:
        raise InputError("no element to choose from", remedy="name at least one shape and size")
    there = LiteralMatcher(cameras, masks, volume_mm, band_px=band_px)
    back = LiteralMatcher(cameras[::-1], masks[::-1], volume_mm, band_px=band_px)
    points = np.reshape(np.asarray(xy_px, np.float64), (-1, 2))
    points = np.where(np.isfinite(points), points, np.nan)
    smallest = int(np.argmin([size for _, size in elements]))
    parts = []
    for first in range(0, max(len(points), 1), _PIECE):
        search = there.search(points[first : first + _PIECE])
        trials = []
        for done, kind in enumerate(elements, start=1):
            scan = _matched(there, masks[0], search, kind)
            trials.append(_Trial(*scan, _returning((back, masks[1]), scan[0], kind)))
            if progress is not None:
                progress(done, len(elements))
        parts.append(_chosen(trials, smallest, _on_edge(masks[0], search.pixel)))
    return _joined(parts)


def distinctness(hits: Hits, places: Bands, chosen: Chosen, pixels: IntArray) -> FloatArray:
    """Return how far the best place of each element stands out from the others.

    Parameters
    ----------
    hits : ndarray, shape (M, L)
        Pixels of the element that are present at each place.
    places : Bands
        The places.
    chosen : Chosen
        The best of them.
    pixels : ndarray of int, shape (M,)
        Pixels of each element.

    Returns
    -------
    ndarray, shape (M,)
        (most present - most present elsewhere) / sqrt(t p + (u p)^2), p the pixels, t
        `THICKNESS_PX`, u `UNLIKE`; elsewhere is beyond `PEAK_PX`.
    """
    rows = np.arange(len(hits))
    away = np.maximum(
        np.abs(places.column - places.column[rows, chosen.place][:, None]),
        np.abs(places.row - places.row[rows, chosen.place][:, None]),
    )
    elsewhere = np.where(away > PEAK_PX, hits, 0).max(axis=1, initial=0).astype(np.float64)
    chance = np.sqrt(THICKNESS_PX * pixels + (UNLIKE * pixels) ** 2)
    return np.asarray((chosen.hits - elsewhere) / np.maximum(chance, 1.0))


def edge_directions(mask: BoolArray, pixel: IntArray) -> IntArray:
    """Return the direction of the edge at pixels, in sixteenths of half a turn.

    Parameters
    ----------
    mask : ndarray of bool, shape (H, W)
        Edge pixels.
    pixel : ndarray of int, shape (M, 2)
        x, y in the image.

    Returns
    -------
    ndarray of int, shape (M,)
        0 along +x, 8 along +y: the longer axis of the edge pixels within 4 px, about the
        candidate itself, so that a second edge beside it counts less than its own length.
    """
    reach = np.arange(-_NEAR_PX, _NEAR_PX + 1)
    padded = np.pad(np.asarray(mask, np.bool_), _NEAR_PX)
    across, down = np.meshgrid(reach, reach)
    near = padded[
        pixel[:, 1, None] + down.ravel() + _NEAR_PX, pixel[:, 0, None] + across.ravel() + _NEAR_PX
    ]
    xx, yy, xy = (
        near @ (a * b).ravel() for a, b in ((across, across), (down, down), (across, down))
    )
    angle = 0.5 * np.arctan2(2.0 * xy, xx - yy)
    return np.asarray(np.rint(angle * _DIRECTIONS / np.pi), np.int64) % _DIRECTIONS


@dataclass(frozen=True, slots=True, eq=False)
class _Trial:
    """One element on M points: what it found, and its counts over the neighbourhoods."""

    matches: LiteralMatches
    hits: Hits
    place: IntArray
    distinctness: FloatArray
    returns: BoolArray


_Scan = tuple[LiteralMatches, Hits, IntArray, FloatArray]


def _returning(
    back: tuple[LiteralMatcher, BoolArray],
    matches: LiteralMatches,
    kind: tuple[str, int],
) -> BoolArray:
    """Tell which matches, matched back, return to their points."""
    found = all_finite(matches.xy_px, 1)
    returns = np.zeros(len(matches), np.bool_)
    if found.any():
        matcher, mask = back
        home = _matched(matcher, mask, matcher.search(matches.xy_px[found]), kind)[0]
        with np.errstate(invalid="ignore"):
            away = np.hypot(*(home.xy_px - matches.seed_px[found]).T)
            returns[found] = away < RETURN_PX
    return returns


def _matched(
    matcher: LiteralMatcher,
    mask: BoolArray,
    search: Search,
    kind: tuple[str, int],
) -> _Scan:
    """Match points with one kind of element."""
    shape, size = kind
    if shape != "strip":
        return _scanned(matcher, search, footprint(size, shape))
    direction = edge_directions(mask, search.pixel)
    groups = [np.flatnonzero(direction == turn) for turn in range(_DIRECTIONS)]
    found = []
    for turn, rows in enumerate(groups):
        angle = np.pi * turn / _DIRECTIONS
        strip = strip_footprint(size, (float(np.cos(angle)), float(np.sin(angle))))
        found.append(_scanned(matcher, search.select(rows), strip))
    order = np.argsort(np.concatenate(groups), kind="stable")
    matches, hits, place, distinct = zip(*found, strict=True)
    return (
        join_matches(matches, order),
        np.concatenate(hits)[order],
        np.concatenate(place)[order],
        np.concatenate(distinct)[order],
    )


def _scanned(matcher: LiteralMatcher, search: Search, inside: BoolArray) -> _Scan:
    elements = matcher.elements(search, inside)
    hits = matcher.scan(elements, search.places)
    chosen = choose_places(hits, search.places)
    matches = matcher.decided(search, elements, len(inside), chosen)
    distinct = distinctness(hits, search.places, chosen, elements.pixels)
    return matches, hits, chosen.place, distinct


def _on_edge(mask: BoolArray, pixel: IntArray) -> BoolArray:
    """Tell which pixels are, or touch, an edge pixel."""
    column, row = pixel.T
    padded = np.pad(np.asarray(mask, np.bool_), 1)
    near = [padded[row + down, column + across] for down in (0, 1, 2) for across in (0, 1, 2)]
    return np.asarray(np.any(near, axis=0))


def _fits(trials: Sequence[_Trial], smallest: int) -> tuple[FloatArray, FloatArray]:
    """Return how well all elements, and the smallest, fit at each one's place, shape (M, K)."""
    rows = np.arange(len(trials[0].place))[:, None]
    place = np.stack([trial.place for trial in trials], axis=1)
    total, asked = np.zeros(place.shape), np.zeros((len(place), 1))
    own = np.zeros(place.shape)
    for number, trial in enumerate(trials):
        most = trial.hits.max(axis=1, initial=0)[:, None]
        fit = trial.hits[rows, place] / np.maximum(most, 1)
        total += fit
        asked += most > 0
        if number == smallest:
            own = fit
    return total / np.maximum(asked, 1), own


def _chosen(trials: Sequence[_Trial], smallest: int, on_edge: BoolArray) -> ElementChoice:
    """Choose for each point; elements without a match never win against one with it."""
    found = np.stack([all_finite(trial.matches.xy_px, 1) for trial in trials], axis=1)
    returns = np.stack([trial.returns for trial in trials], axis=1)
    distinct = np.stack([trial.distinctness for trial in trials], axis=1) * found
    support, own = _fits(trials, smallest)
    centred = found & on_edge[:, None] & (own >= OWN_SHARE)
    value = distinct * support
    merit = 4.0 * found + 2.0 * returns + centred + value / (1.0 + value.max(initial=0.0))
    element = np.argmax(merit, axis=1)
    rows = np.arange(len(element))
    matches = join_matches([trial.matches for trial in trials], element * len(element) + rows)
    lost = found[rows, element] & ~returns[rows, element]
    flags = np.where(lost, matches.flags | int(Flag.inconsistent), matches.flags)
    return ElementChoice(
        matches=replace(matches, flags=flags),
        element=np.where(found[rows, element], element, -1),
        xy_px=np.stack([trial.matches.xy_px for trial in trials], axis=1),
        distinctness=distinct,
        support=support * found,
        returns=returns,
        centred=centred,
    )


def _joined(parts: Sequence[ElementChoice]) -> ElementChoice:
    count = sum(len(part) for part in parts)
    columns = {
        field.name: np.concatenate([getattr(part, field.name) for part in parts])
        for field in fields(ElementChoice)
        if field.name != "matches"
    }
    return ElementChoice(
        join_matches([part.matches for part in parts], np.arange(count)), **columns
    )
