"""Blobs that look like ellipses: where a disc may be."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any, Literal, TypeAlias

import cv2
import numpy as np
from numpy.typing import NDArray

from closerange.errors import GeometryError, InputError
from closerange.features.borders import follow_borders
from closerange.features.threshold import ThresholdReport, threshold_report
from closerange.geometry.arrays import BoolArray, FloatArray, IntArray
from closerange.geometry.ellipse import Ellipse, fit_ellipse
from closerange.images.frame import Frame

Polarity: TypeAlias = Literal["white-on-dark", "dark-on-white"]
Strategy: TypeAlias = Literal["auto", "global", "local"]
POLARITIES = ("white-on-dark", "dark-on-white")
STRATEGIES = ("auto", "global", "local")

# Fewer pixels than parameters of an ellipse plus its two grey levels cannot be told from noise.
SMALLEST_AREA_PX = 8
# A disc seen more than 75 degrees from its normal is not readable in print or in paint.
SMALLEST_AXIS_RATIO = 0.25
# Of all shapes with the same second moments the ellipse has the largest area: the quotient is
# 1 for an ellipse, 0.955 for a square, 0.83 for a triangle, less for rings and branches.
# Jagged borders of small blobs cost about a pixel's width of perimeter noise, hence 2 / a.
SMALLEST_ELLIPTICITY, ELLIPTICITY_PX = 0.97, 0.25
# Border pixels scatter by 0.3 px where the outline is rounded to pixels; noise on a faint, small
# disc doubles that. A tenth of it grows with the disc: light that varies bends the outline.
BORDER_RMS_PX, BORDER_RMS_SHARE = 0.5, 0.02
# Mean contrast times sqrt(area) over the noise: at 10 a chance speck among 10^7 places is out
# of question and the centre is good to about a tenth of the radius.
SMALLEST_SIGNIFICANCE = 10.0
# Part of a disc that must be inside the image for its outline to say anything of the rest.
SMALLEST_VISIBLE_SHARE = 0.5
# Noise floor of the local strategy: one in 3 million Gaussian pixels exceeds five sigma.
FLOOR_SIGMAS = 5.0
# Smoothing of the local strategy: matched to the smallest dots, radius 2 px.
SMOOTHING_PX = 1.0
# Sides of the square structuring elements: each serves discs up to 0.8 of its side; the last
# covers discs of a third of the image's height.
FIRST_ELEMENT_PX = 11
ELEMENT_FILL = 0.8


@dataclass(frozen=True, slots=True, eq=False)
class Candidate:
    """One blob that looks like an ellipse.

    Attributes
    ----------
    outline : Ellipse
        Ellipse of the blob's area moments; where the image border cuts the blob, the ellipse
        through the rest of its outline.
    border : ndarray of int, shape (N, 2)
        Border pixels x, y in order of following.
    at_border : bool
        Whether the blob touches the image border.
    contrast : float
        Mean grey value of the blob minus that of a ring around it.
    significance : float
        |contrast| sqrt(area) / noise.
    """

    outline: Ellipse
    border: IntArray
    at_border: bool
    contrast: float
    significance: float


@dataclass(frozen=True, slots=True, eq=False)
class DiscCandidates:
    """All candidates of an image.

    Attributes
    ----------
    candidates : tuple of Candidate
        From the top of the image to its bottom.
    foreground : ndarray of bool, shape (H, W)
        All pixels of the discs' brightness, candidates or not: what a fit must keep away from.
    strategy : str
        The strategy that was used, "global" or "local".
    thresholds : ThresholdReport
        Of the image for "global"; of the top-hat image of the scale with most candidates for
        "local".
    noise : float
        Standard deviation of a pixel, robust over the image.
    """

    candidates: tuple[Candidate, ...]
    foreground: BoolArray
    strategy: str
    thresholds: ThresholdReport
    noise: float


def find_candidates(
    frame: Frame, *, polarity: Polarity, strategy: Strategy = "auto"
) -> DiscCandidates:
    """Find blobs of one polarity that look like ellipses.

    Parameters
    ----------
    frame : Frame
        Image.
    polarity : {"white-on-dark", "dark-on-white"}
        Discs brighter or darker than their surroundings.
    strategy : {"auto", "global", "local"}, optional
        "global": one Trussell threshold for the image, as in the thesis. "local": white (or
        black) top-hats with structuring elements of growing size remove uneven light, then
        Trussell's threshold, but never below five times the noise, and once more around each
        blob. "auto": whichever finds more; "global" if they find as many.

    Returns
    -------
    DiscCandidates
        Candidates, also those cut by the image border.

    Raises
    ------
    InputError
        If polarity or strategy is unknown.
    """
    if polarity not in POLARITIES:
        raise InputError(f"polarity {polarity!r}", remedy=f"use one of {', '.join(POLARITIES)}")
    if strategy not in STRATEGIES:
        raise InputError(f"strategy {strategy!r}", remedy=f"use one of {', '.join(STRATEGIES)}")
    pixels = frame.pixels if polarity == "white-on-dark" else frame.full_scale - frame.pixels
    noise = pixel_noise(pixels)
    if strategy == "local":
        return _local(pixels, noise)
    whole = _global(pixels, noise)
    if strategy == "global":
        return whole
    local = _local(pixels, noise)
    return local if _score(local) > _score(whole) else whole


def pixel_noise(pixels: NDArray[Any]) -> float:
    """Estimate the standard deviation of a pixel from second differences.

    Parameters
    ----------
    pixels : ndarray, shape (H, W)
        Grey values.

    Returns
    -------
    float
        At least that of rounding to whole grey values, 0.29.

    Notes
    -----
    The mask [1 -2 1; -2 4 -2; 1 -2 1] sees neither planes nor straight edges along the axes and
    has the variance 36 sigma^2 (doi:10.1006/cviu.1996.0060); the median ignores what it does see.
    """
    mask = np.array([[1, -2, 1], [-2, 4, -2], [1, -2, 1]], dtype=np.float32)
    detail = np.abs(cv2.filter2D(pixels.astype(np.float32), -1, mask))[::2, ::2]
    return max(1.4826 * float(np.median(detail)) / 6, float(np.sqrt(1 / 12)))


def _global(pixels: NDArray[Any], noise: float) -> DiscCandidates:
    report = threshold_report(pixels)
    mask = pixels > report.threshold
    found = [
        c for blob in _blobs(mask, _largest_side(pixels)) if (c := _judge(pixels, blob, noise))
    ]
    return DiscCandidates(tuple(found), mask, "global", report, noise)


def _local(pixels: NDArray[Any], noise: float) -> DiscCandidates:
    smooth = cv2.GaussianBlur(pixels.astype(np.float32), (0, 0), SMOOTHING_PX)
    best: list[Candidate] = []
    foreground = np.zeros(pixels.shape, dtype=bool)
    reports: list[tuple[int, ThresholdReport]] = []
    side = FIRST_ELEMENT_PX
    while side * ELEMENT_FILL <= _largest_side(pixels):
        element = cv2.getStructuringElement(cv2.MORPH_RECT, (side, side))
        residue = cv2.morphologyEx(smooth, cv2.MORPH_TOPHAT, element)
        middle = float(np.median(residue))
        spread = 1.4826 * float(np.median(np.abs(residue - middle)))
        report = threshold_report(np.rint(residue), floor=middle + FLOOR_SIGMAS * spread)
        found = []
        for level in sorted({report.floor, report.threshold}):
            mask = residue > level
            foreground |= mask
            for blob in _blobs(mask, ELEMENT_FILL * side):
                candidate = _judge(pixels, _refined(residue, blob, report.floor), noise)
                if candidate is not None:
                    found.append(candidate)
        reports.append((len(found), report))
        best += found
        side = 2 * side - 1
    most = max(reports, key=lambda item: item[0])[1] if reports else threshold_report(pixels)
    return DiscCandidates(tuple(_without_doubles(best)), foreground, "local", most, noise)


@dataclass(frozen=True, slots=True, eq=False)
class _Blob:
    """A connected region: its mask in a window and the window's first x, y."""

    mask: BoolArray
    first: tuple[int, int]


def _blobs(mask: BoolArray, largest_side: float) -> Iterator[_Blob]:
    """Give the 8-connected regions whose size could be that of a disc, from top to bottom."""
    _, labels, stats, _ = cv2.connectedComponentsWithStats(mask.astype(np.uint8), connectivity=8)
    width, height, area = stats[:, 2], stats[:, 3], stats[:, 4]
    # An ellipse fills pi/4 = 0.79 of its upright bounding box, a slanted one of axis ratio 0.25
    # still 0.37; whole pixels are a little less strict.
    fits = (np.maximum(width, height) <= largest_side) & (area >= SMALLEST_AREA_PX)
    fits &= area >= 0.3 * width * height
    fits[0] = False  # the background
    for label in np.flatnonzero(fits):
        x, y, w, h = (int(v) for v in stats[label, :4])
        yield _Blob(labels[y : y + h, x : x + w] == label, (x, y))


def _refined(residue: FloatArray, blob: _Blob, floor: float) -> _Blob:
    """Threshold the surroundings of a blob by themselves and keep the region that it became."""
    (x, y), (h, w) = blob.first, blob.mask.shape
    x0, y0 = max(x - 2, 0), max(y - 2, 0)
    window = residue[y0 : y + h + 2, x0 : x + w + 2]
    level = threshold_report(np.rint(window), floor=floor).threshold
    count, labels = cv2.connectedComponents((window > level).astype(np.uint8), connectivity=8)
    if count < 2:
        return blob
    own = np.zeros(window.shape, dtype=bool)
    own[y - y0 : y - y0 + h, x - x0 : x - x0 + w] = blob.mask
    sizes = np.bincount(labels[own], minlength=count)
    label = int(np.argmax(sizes[1:])) + 1
    rows, columns = np.nonzero(labels == label)
    part = labels[rows.min() : rows.max() + 1, columns.min() : columns.max() + 1] == label
    return _Blob(part, (x0 + int(columns.min()), y0 + int(rows.min())))


def _judge(pixels: NDArray[Any], blob: _Blob, noise: float) -> Candidate | None:
    """Make a candidate of a blob that passes all gates."""
    (x, y), (h, w) = blob.first, blob.mask.shape
    height, width = pixels.shape
    at_border = x == 0 or y == 0 or x + w == width or y + h == height
    area = int(np.count_nonzero(blob.mask))
    if area < SMALLEST_AREA_PX:
        return None
    border = max(follow_borders(blob.mask), key=len) + np.array(blob.first)
    try:
        outline = _cut_outline(border, pixels.shape) if at_border else _moment_outline(blob)
    except GeometryError:
        return None
    a, b, _ = outline.axes
    share = area / outline.area
    least = SMALLEST_VISIBLE_SHARE if at_border else SMALLEST_ELLIPTICITY - ELLIPTICITY_PX / a
    if b < SMALLEST_AXIS_RATIO * a or share < least:
        return None
    seen = _not_at_rim(border, pixels.shape) if at_border else border
    if outline.signed_distance(seen).std() > BORDER_RMS_PX + BORDER_RMS_SHARE * a:
        return None
    contrast = _contrast(pixels, blob)
    significance = contrast * float(np.sqrt(area)) / noise
    if not significance > SMALLEST_SIGNIFICANCE:
        return None
    return Candidate(outline, border, at_border, contrast, significance)


def _moment_outline(blob: _Blob) -> Ellipse:
    """Ellipse of the blob's first and second moments, its pixels being unit squares."""
    rows, columns = np.nonzero(blob.mask)
    points = np.stack([columns, rows]).astype(np.float64)
    covariance = np.cov(points, bias=True) + np.eye(2) / 12
    return Ellipse.of_moments(points.mean(axis=1) + blob.first, covariance)


def _cut_outline(border: IntArray, shape: tuple[int, ...]) -> Ellipse:
    """Ellipse through the part of a border that is not the image's, half a pixel outside it."""
    inner = fit_ellipse(_not_at_rim(border, shape))
    a, b, angle = inner.axes
    return Ellipse.of(inner.centre, a + 0.5, b + 0.5, angle)


def _not_at_rim(border: IntArray, shape: tuple[int, ...]) -> IntArray:
    height, width = shape
    return border[((border > 0) & (border < [width - 1, height - 1])).all(axis=1)]


def _contrast(pixels: NDArray[Any], blob: _Blob) -> float:
    """Mean of the blob minus the median of a ring that begins two pixels outside it."""
    (x, y), (h, w) = blob.first, blob.mask.shape
    x0, y0 = max(x - 5, 0), max(y - 5, 0)
    window = pixels[y0 : y + h + 5, x0 : x + w + 5]
    own = np.zeros(window.shape, dtype=np.uint8)
    own[y - y0 : y - y0 + h, x - x0 : x - x0 + w] = blob.mask
    near, far = (cv2.dilate(own, np.ones((size, size), np.uint8)) for size in (5, 11))
    ring = (far > 0) & (near == 0)
    if not ring.any():
        return 0.0
    return float(window[own > 0].mean() - np.median(window[ring]))


def _without_doubles(candidates: list[Candidate]) -> list[Candidate]:
    """Keep the most significant of candidates that lie upon each other; order by place."""
    kept: list[Candidate] = []
    centres = np.zeros((0, 2))
    reach = np.zeros(0)
    for candidate in sorted(candidates, key=lambda c: -c.significance):
        centre, size = candidate.outline.centre, candidate.outline.axes[0]
        apart = np.hypot(*(centres - centre).T)
        if (apart < np.maximum(reach, size)).any():
            continue
        kept.append(candidate)
        centres, reach = np.vstack([centres, centre]), np.append(reach, size)
    return sorted(kept, key=lambda c: (c.outline.centre[1], c.outline.centre[0]))


def _largest_side(pixels: NDArray[Any]) -> float:
    """Largest disc looked for: it needs background on both sides of it."""
    return 0.9 * min(pixels.shape)


def _score(found: DiscCandidates) -> int:
    return sum(not candidate.at_border for candidate in found.candidates)
