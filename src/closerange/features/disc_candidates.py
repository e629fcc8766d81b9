"""Blobs that look like ellipses: where a disc may be."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from closerange.errors import InputError
from closerange.features.blobs import Candidate, Regions, judge, refined
from closerange.features.threshold import ThresholdReport, threshold_report
from closerange.geometry.arrays import BoolArray
from closerange.images.frame import Frame

POLARITIES = ("white-on-dark", "dark-on-white")
STRATEGIES = ("auto", "global", "local")

# Noise floor of the local strategy: one in 3 million Gaussian pixels exceeds five sigma.
FLOOR_SIGMAS = 5.0
# Smoothing of the local strategy: matched to the smallest dots, radius 2 px.
SMOOTHING_PX = 1.0
# Sides of the square structuring elements: each serves discs up to 0.8 of its side, because the
# smoothed foot of a disc's edge must fit as well. Light on a disc larger than half of the
# image is beyond what a flat structuring element can even out.
FIRST_ELEMENT_PX = 11
ELEMENT_FILL, SMALLEST_FILL = 0.8, 0.3
LARGEST_LOCAL_SHARE = 0.5
# The largest disc of the global strategy: it needs some background on both sides.
LARGEST_GLOBAL_SHARE = 0.9
# Discs of one target differ by this factor at most: larger marks, perspective.
SAME_SIZE = 2.0
CONVINCING_SHARE = 0.8


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
        "local". In grey values of the image.
    noise : float
        Standard deviation of a pixel, robust over the image.
    """

    candidates: tuple[Candidate, ...]
    foreground: BoolArray
    strategy: str
    thresholds: ThresholdReport
    noise: float


def find_candidates(frame: Frame, *, polarity: str, strategy: str = "auto") -> DiscCandidates:
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
        blob. "auto": "global", completed by what "local" finds in the same sizes, or wholly if
        "local" finds more blobs of one size.

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
    if polarity == "white-on-dark":
        return _find(frame.pixels, strategy)
    found = _find(frame.full_scale - frame.pixels, strategy)
    if found.strategy == "local":
        return found
    report = found.thresholds.in_units(-1.0, frame.full_scale, image=found.thresholds.image)
    return replace(found, thresholds=report)


def _find(pixels: NDArray[Any], strategy: str) -> DiscCandidates:
    """Find bright blobs."""
    noise = pixel_noise(pixels)
    if strategy == "local":
        return _local(pixels, noise)
    whole, islands = _global(pixels, noise)
    if strategy == "global":
        return whole
    size, count = _usual_size(whole)
    # Where nearly all that the threshold left are discs of one size, only more of that size can
    # be missing (in the shade): one structuring element finds them.
    convincing = count > 0 and count >= CONVINCING_SHARE * islands
    local = (
        _local(pixels, noise, size_px=size, known=whole) if convincing else _local(pixels, noise)
    )
    return _joined(whole, local)


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


def _global(pixels: NDArray[Any], noise: float) -> tuple[DiscCandidates, int]:
    """Return the candidates above one threshold, and how many regions are above it at all."""
    report = threshold_report(pixels)
    mask = pixels > report.threshold
    regions = Regions.of(mask)
    found: list[Candidate] = []
    for blob in regions.blobs(LARGEST_GLOBAL_SHARE * min(pixels.shape)):
        found += judge(pixels, blob, noise)
    whole = DiscCandidates(_ordered(found), mask, "global", report, noise)
    return whole, regions.islands()


def _local(
    pixels: NDArray[Any],
    noise: float,
    *,
    size_px: float | None = None,
    known: DiscCandidates | None = None,
) -> DiscCandidates:
    """Look at top-hats of growing elements, or at the one for discs of a known semi-axis.

    Blobs upon `known` candidates are passed over.
    """
    fine = _fine_steps(pixels)
    covered = _painted(known.candidates if known else (), fine.shape)
    found: list[Candidate] = []
    reports: list[tuple[int, ThresholdReport]] = []
    seen: set[tuple[int, ...]] = set()
    for side in _sides(fine.shape, size_px):
        element = cv2.getStructuringElement(cv2.MORPH_RECT, (side, side))
        residue = cv2.morphologyEx(fine, cv2.MORPH_TOPHAT, element)
        report = threshold_report(residue, floor=_floor(residue))
        # What is smaller has been seen at the scale before, or is not of the wanted size.
        smallest_side = 0.0 if side == FIRST_ELEMENT_PX else SMALLEST_FILL * side
        before = len(found)
        levels = {report.floor, report.threshold} if size_px is None else {report.floor}
        for level in sorted(levels):
            regions = Regions.of(residue > level)
            for rough in regions.blobs(ELEMENT_FILL * side, smallest_side):
                if known and covered[rough.window][rough.mask].any():
                    continue
                blob = refined(residue, rough, report.floor)
                if blob.signature not in seen:
                    seen.add(blob.signature)
                    found += judge(pixels, blob, noise)
        reports.append((len(found) - before, report))
    found = _without_doubles(found)
    report = max(reports, key=lambda item: item[0])[1]
    report = report.in_units(1 / _steps(pixels), image="top-hat of the grey values")
    return DiscCandidates(tuple(found), _painted(found, fine.shape), "local", report, noise)


def _sides(shape: tuple[int, ...], size_px: float | None) -> list[int]:
    """Sides of the structuring elements, each about twice as large as the one before."""
    if size_px is not None:
        return [2 * int(np.ceil(size_px * np.sqrt(SAME_SIZE) / ELEMENT_FILL)) + 1]
    sides = [FIRST_ELEMENT_PX]
    while (2 * sides[-1] - 1) * ELEMENT_FILL <= LARGEST_LOCAL_SHARE * min(shape):
        sides.append(2 * sides[-1] - 1)
    return sides


def _fine_steps(pixels: NDArray[Any]) -> NDArray[np.uint16]:
    """Smoothed image in sixteenths of a grey value, or in what 16 bits allow."""
    steps = _steps(pixels)
    smooth = cv2.GaussianBlur(pixels.astype(np.float32) * steps, (0, 0), SMOOTHING_PX)
    fine: NDArray[np.uint16] = np.rint(smooth).astype(np.uint16)
    return fine


def _steps(pixels: NDArray[Any]) -> int:
    return 16 if pixels.dtype == np.uint8 else 1


def _floor(residue: NDArray[np.uint16]) -> float:
    """Median plus five robust sigma of a top-hat image, which is background for the most part."""
    residue = residue[::2, ::2]  # a quarter of the pixels knows the noise well enough
    half = residue.size / 2
    middle = int(np.searchsorted(np.cumsum(np.bincount(residue.ravel())), half))
    deviation = np.abs(residue.astype(np.int32) - middle)
    spread = int(np.searchsorted(np.cumsum(np.bincount(deviation.ravel())), half))
    return middle + FLOOR_SIGMAS * 1.4826 * max(spread, 1)


def _painted(candidates: Sequence[Candidate], shape: tuple[int, ...]) -> BoolArray:
    """Return the mask of all candidates' blobs."""
    image = np.zeros(shape, dtype=np.uint8)
    borders = [np.ascontiguousarray(c.border.reshape(-1, 1, 2), np.int32) for c in candidates]
    cv2.drawContours(image, borders, -1, 1, cv2.FILLED)
    return image > 0


def _joined(whole: DiscCandidates, local: DiscCandidates) -> DiscCandidates:
    """Join both strategies; the less fruitful one adds what the other has not.

    Where the global strategy has as many discs of one size, what else the local one found is
    taken for specks unless it has that size.
    """
    size, count = _usual_size(whole)
    more_local = _usual_size(local)[1] > count
    base, other = (local, whole) if more_local else (whole, local)
    centres = np.array([c.outline.centre for c in base.candidates]).reshape(-1, 2)
    reach = np.array([c.outline.axes[0] for c in base.candidates])
    added = []
    for candidate in other.candidates:
        a = candidate.outline.axes[0]
        if other is local and not size / SAME_SIZE <= a <= size * SAME_SIZE:
            continue
        apart = np.hypot(*(centres - candidate.outline.centre).T)
        if not (apart < np.maximum(reach, a)).any():
            added.append(candidate)
    foreground = base.foreground | _painted(added, base.foreground.shape)
    joined = _ordered([*base.candidates, *added])
    return DiscCandidates(joined, foreground, base.strategy, base.thresholds, base.noise)


def _usual_size(found: DiscCandidates) -> tuple[float, int]:
    """Semi-axis that has most candidates within a factor of `SAME_SIZE`, and how many."""
    sizes = np.sort([c.outline.axes[0] for c in found.candidates if not c.at_border])
    if sizes.size == 0:
        return 0.0, 0
    root = np.sqrt(SAME_SIZE)
    counts = np.searchsorted(sizes, sizes * root, "right") - np.searchsorted(sizes, sizes / root)
    best = int(np.argmax(counts))
    return float(sizes[best]), int(counts[best])


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
    return list(_ordered(kept))


def _ordered(candidates: list[Candidate]) -> tuple[Candidate, ...]:
    """Sort from the top of the image to its bottom."""
    return tuple(sorted(candidates, key=lambda c: (c.outline.centre[1], c.outline.centre[0])))
