"""Crimmins and Brown's shape recognition: a shape fits, and its background fits around it.

The theorem (section 4.5 and equation 5.5 of the thesis, which lost the complement's bar): the
shape A in the window W occurs in the image I at and only at

    [I erosion A] and [complement of I erosion (W - A)].

`occurrences` is that, for sets. `find_shapes` uses it on grey images, at every threshold at once:
there is a threshold at which A occurs at x exactly if the darkest pixel under A is brighter than
the brightest under W - A, that is, if the grey erosion by A exceeds the grey dilation by the
reflected W - A. So no threshold needs to be right for the whole image, and gain and offset
of the light do not matter. Between A and W - A a band on both sides of the border is left out
("don't care"), because a border never falls on the same pixels twice.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from closerange.errors import InputError
from closerange.features.morphology import dilate, erode
from closerange.features.shapes import Shape, without_specks
from closerange.features.structuring import StructuringElement
from closerange.flags import Flag
from closerange.geometry.arrays import BoolArray, FloatArray, IntArray

LEAST_SHARPNESS = 0.5
"""Sharpness of a find, as a share of the sharpness when the shape was taught. Where the border of
what is seen lies inside the band, the contrast is whole; where it lies at the band's rim, the
darkest pixel of A is just half-way up the border. On discs and boxes at all places between pixels
(blur 0.7 px, margin 2 px) the same shape keeps at least 0.91, borders 1 px off keep at least
0.53, 2 px off at most 0.44. A smooth hill of grey values, whose every height line is some
shape's outline, has little either. Light cancels in a share."""

MIN_STEP = 2.0
"""Grey levels between shape and background below which a difference is rounding."""

_PROBES = 48  # pixels of A and of W - A that are looked at everywhere; the rest only where they fit
_GATHERED = 2**22  # pixels read at once where all are looked at
_FLAT = (np.uint8, np.uint16)

Progress = Callable[[int, int], None]


@dataclass(frozen=True, slots=True, eq=False)
class ShapeHit:
    """A taught shape, found.

    Attributes
    ----------
    shape : str
        Name of the shape.
    xy_px : ndarray, shape (2,)
        Where the centroid of the taught pixels lies: the centroid of all places (and rolls) at
        which the shape fits, because within the margin it fits at several neighbouring ones.
    cov_px2 : ndarray, shape (2, 2)
        Covariance of these places, a pixel being a unit square: an upper bound, since all of
        them fit.
    roll_rad : float
        By how much it is turned against the taught one, from +x towards +y; 0 if no other
        rolls were asked for. The best of the stack's steps, for symmetric shapes any of them.
    contrast : float
        Darkest pixel of the shape less brightest of its background, in grey levels, at best.
    flags : Flag
        `at_border`: the image ends before the window does, so that part of the background is
        unseen. `ambiguous`: another taught shape of the same polarity fits here too.
    """

    shape: str
    xy_px: FloatArray
    cov_px2: FloatArray
    roll_rad: float
    contrast: float
    flags: Flag


class _Fits(NamedTuple):
    """Places (row, column), rolls and contrasts at which a shape fits."""

    places: FloatArray
    rolls: FloatArray
    contrasts: FloatArray


def occurrences(
    image: BoolArray, shape: StructuringElement, window: StructuringElement
) -> BoolArray:
    """Return where a shape occurs in a binary image, by Crimmins and Brown's theorem.

    Parameters
    ----------
    image : ndarray of bool, shape (H, W)
        I, the set of foreground pixels; nothing outside the image belongs to it.
    shape : StructuringElement
        A, flat.
    window : StructuringElement
        W, flat, around the same origin. Pixels that are in neither A nor W do not matter.

    Returns
    -------
    ndarray of bool, shape (H, W)
        [I erosion A] and [complement of I erosion (W - A)], equation 5.5. If W - A is empty, the
        erosion by A alone: then smaller shapes are not told from equal ones.

    Raises
    ------
    InputError
        If the image is not binary or an element not flat.
    """
    if image.dtype != bool:
        raise InputError(
            f"an image of {image.dtype} is no set of pixels",
            remedy="give a mask, for instance pixels above a threshold",
        )
    inside = {tuple(point) for point in shape.offsets.tolist()}
    around = [point for point in window.offsets.tolist() if tuple(point) not in inside]
    fits = erode(image, shape, outside="background")
    if around:
        fits &= erode(~image, StructuringElement.of_points(around))
    return np.asarray(fits)


def find_shapes(
    pixels: NDArray[Any],
    shapes: Sequence[Shape],
    *,
    least_sharpness: float = LEAST_SHARPNESS,
    progress: Progress | None = None,
) -> list[ShapeHit]:
    """Find taught shapes in a grey image.

    Parameters
    ----------
    pixels : ndarray of uint8 or uint16, shape (H, W)
        Grey image. Single hot and dead pixels are removed first (median of 3 x 3).
    shapes : sequence of Shape
        What to look for; names are unique.
    least_sharpness : float, optional
        Share of the taught sharpness that a find must have, 0 to 1.
    progress : callable, optional
        Called with (done, total) after each shape.

    Returns
    -------
    list of ShapeHit
        In the order of the shapes, then from top to bottom. Empty if nothing fits. Several
        places of one blob are one hit.

    Raises
    ------
    InputError
        If the image is of another form, a name occurs twice or `least_sharpness` is no share.
    """
    _check(pixels, shapes, least_sharpness)
    smooth = without_specks(pixels)
    hits: list[ShapeHit] = []
    for done, shape in enumerate(shapes, start=1):
        bright = smooth if shape.bright else np.iinfo(smooth.dtype).max - smooth
        hits.extend(_hits(bright, shape, least_sharpness * shape.sharpness))
        if progress:
            progress(done, len(shapes))
    return _marked(hits, {shape.name: shape for shape in shapes})


def _check(pixels: NDArray[Any], shapes: Sequence[Shape], least_sharpness: float) -> None:
    if pixels.ndim != 2 or pixels.size == 0 or pixels.dtype not in _FLAT:
        raise InputError(
            f"an image of {pixels.dtype} and shape {pixels.shape} cannot be searched for shapes",
            remedy="give a two-dimensional image of uint8 or uint16",
        )
    names = [shape.name for shape in shapes]
    if len(set(names)) < len(names):
        raise InputError(f"shapes are named twice: {names}", remedy="give each its own name")
    if not 0 <= least_sharpness <= 1:
        raise InputError(
            f"least_sharpness is {least_sharpness}", remedy="give a share from 0 to 1, such as 0.5"
        )


def _hits(bright: NDArray[Any], shape: Shape, least_sharpness: float) -> list[ShapeHit]:
    """Find one shape at all its rolls and merge neighbouring places."""
    places, rolls, contrasts = [], [], []
    window = np.zeros((2, 2), np.int64)  # the largest window of all rolls
    for angle, inner, around in shape.stack():
        window[0] = np.minimum(window[0], around.min(axis=0))
        window[1] = np.maximum(window[1], around.max(axis=0))
        found, gap = _fits(bright, inner, around, least_sharpness)
        # the unrolled element is centred on a whole pixel, its centroid is not
        places.append(found + (shape.centroid_offset if angle == 0 else 0.0))
        rolls.append(np.full(len(found), angle))
        contrasts.append(gap)
    place, roll, contrast = map(np.concatenate, (places, rolls, contrasts))
    return [
        _merged(shape, _Fits(place[own], roll[own], contrast[own]), bright.shape, window)
        for own in _groups(place, bright.shape, shape.margin_px)
    ]


def _fits(
    bright: NDArray[Any], inner: IntArray, around: IntArray, least_sharpness: float
) -> tuple[IntArray, FloatArray]:
    """Return rows and columns where a shape fits, and min under A - max under W - A there.

    A few pixels of each are tried everywhere first: the gap over all is never larger, so no
    place that fits is lost.
    """
    # the whole of A must be seen; of W - A what lies beyond the image is not asked for
    lowest = erode(bright, StructuringElement(_probes(inner)), outside="background")
    highest = dilate(bright, StructuringElement(-_probes(around)))
    first, last = inner.min(axis=0), inner.max(axis=0)
    height, width = bright.shape
    seen = np.zeros(bright.shape, dtype=bool)
    seen[
        max(0, -first[0]) : max(0, height - last[0]), max(0, -first[1]) : max(0, width - last[1])
    ] = True
    places = np.argwhere(seen & (lowest.astype(np.int64) - highest >= MIN_STEP))
    reach = int(np.abs(around).max())
    padded = np.pad(bright, reach)  # 0 is below everything in a maximum
    gaps = np.empty(len(places))
    step = max(1, _GATHERED // (len(inner) + len(around)))
    for start in range(0, len(places), step):
        part = places[start : start + step] + reach
        low = _gathered(padded, part, inner).min(axis=1).astype(np.float64)
        gaps[start : start + step] = low - _gathered(padded, part, around).max(axis=1)
    kept = np.flatnonzero(gaps >= MIN_STEP)
    steps = [
        np.median(_gathered(padded, place, inner)) - np.median(_gathered(padded, place, around))
        for place in places[kept, None] + reach
    ]
    kept = kept[gaps[kept] >= least_sharpness * np.array(steps)]
    return places[kept], gaps[kept]


def _probes(offsets: IntArray) -> IntArray:
    """Take some pixels of an element, evenly around its outline."""
    angle = np.arctan2(*(offsets - offsets.mean(axis=0)).T)
    order = offsets[np.lexsort((offsets[:, 0], angle))]
    return order[:: max(1, len(order) // _PROBES)]


def _gathered(padded: NDArray[Any], places: IntArray, offsets: IntArray) -> NDArray[Any]:
    """Return pixel values, (places, offsets)."""
    width = padded.shape[1]
    start = places[:, 0] * width + places[:, 1]
    return np.asarray(np.take(padded, start[:, None] + offsets @ np.array([width, 1])))


def _groups(
    places: FloatArray, size: tuple[int, ...], margin_px: float
) -> Iterator[NDArray[np.intp]]:
    """Put places together that are within twice the margin of one another, top to bottom."""
    if not len(places):
        return
    mask = np.zeros(size, np.uint8)
    # a centroid may lie outside the image if the shape is a bow that is cut by its border
    cells = np.clip(np.rint(places).astype(int), 0, np.array(size) - 1)
    mask[cells[:, 0], cells[:, 1]] = 1
    spread = cv2.dilate(mask, _disc_kernel(margin_px + 1))
    _, labels = cv2.connectedComponents(spread, connectivity=8)
    label = labels[cells[:, 0], cells[:, 1]]
    for value in np.unique(label):  # labels count from top to bottom
        yield np.flatnonzero(label == value)


def _disc_kernel(radius_px: float) -> NDArray[np.uint8]:
    mask, _ = StructuringElement.disc(radius_px).mask()
    return mask.astype(np.uint8)


def _merged(shape: Shape, fits: _Fits, size: tuple[int, ...], window: IntArray) -> ShapeHit:
    """Make one hit of all places and rolls at which one blob fits."""
    yx = fits.places.mean(axis=0)
    away = fits.places - yx
    spread = away.T @ away / len(away) + np.eye(2) / 12
    cut = (np.rint(yx) + window[0] < 0).any() or (np.rint(yx) + window[1] >= size).any()
    best = int(np.argmax(fits.contrasts))
    return ShapeHit(
        shape.name,
        yx[::-1].copy(),
        spread[::-1, ::-1].copy(),
        float(fits.rolls[best]),
        float(fits.contrasts[best]),
        Flag.at_border if cut else Flag.none,
    )


def _marked(hits: list[ShapeHit], shapes: dict[str, Shape]) -> list[ShapeHit]:
    """Flag hits of different shapes at one place."""
    marked = []
    for hit in hits:
        own = shapes[hit.shape]
        shared = any(
            other.shape != hit.shape
            and shapes[other.shape].bright == own.bright
            and math.dist(other.xy_px, hit.xy_px) <= own.margin_px + shapes[other.shape].margin_px
            for other in hits
        )
        flags = hit.flags | (Flag.ambiguous if shared else Flag.none)
        marked.append(
            ShapeHit(hit.shape, hit.xy_px, hit.cov_px2, hit.roll_rad, hit.contrast, flags)
        )
    return marked
