"""Blobs of a mask, and which of them look like ellipses."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from closerange.errors import GeometryError
from closerange.features.borders import follow_borders
from closerange.features.threshold import threshold_report
from closerange.geometry.arrays import BoolArray, IntArray
from closerange.geometry.ellipse import Ellipse, fit_ellipse

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
class Blob:
    """A connected region: its mask in a window and the window's first x, y."""

    mask: BoolArray
    first: tuple[int, int]

    @property
    def window(self) -> tuple[slice, slice]:
        """Rows and columns of the window."""
        (x, y), (h, w) = self.first, self.mask.shape
        return slice(y, y + h), slice(x, x + w)

    @property
    def signature(self) -> tuple[int, ...]:
        """Place, size and area: the same blob at another scale."""
        return (*self.first, *self.mask.shape, int(np.count_nonzero(self.mask)))


@dataclass(frozen=True, slots=True, eq=False)
class Regions:
    """The 8-connected regions of a mask.

    Attributes
    ----------
    labels : ndarray of int, shape (H, W)
        0 for the background, then one number a region.
    stats : ndarray of int, shape (R, 5)
        First x, first y, width, height and area of each label.
    """

    labels: NDArray[Any]
    stats: NDArray[Any]

    @classmethod
    def of(cls, mask: BoolArray) -> Regions:
        """Label the regions of a mask from top to bottom."""
        image = mask.astype(np.uint8)
        _, labels, stats, _ = cv2.connectedComponentsWithStats(image, connectivity=8)
        return cls(labels, stats)

    def blobs(self, largest_side: float, smallest_side: float = 0.0) -> Iterator[Blob]:
        """Give the regions whose size could be that of a disc."""
        width, height, area = self.stats[:, 2:].T
        # An ellipse fills pi/4 = 0.79 of its upright bounding box, a slanted one of axis ratio
        # 0.25 still 0.37; whole pixels are a little less strict.
        side = np.maximum(width, height)
        fits = (side <= largest_side) & (side >= smallest_side) & (area >= SMALLEST_AREA_PX)
        fits &= area >= 0.3 * width * height
        fits[0] = False  # the background
        for label in np.flatnonzero(fits):
            x, y, w, h = (int(v) for v in self.stats[label, :4])
            yield Blob(self.labels[y : y + h, x : x + w] == label, (x, y))

    def islands(self) -> int:
        """Count the regions that do not touch the image border and are no mere specks."""
        height, width = self.labels.shape
        x, y, w, h, area = self.stats[1:].T
        inside = (x > 0) & (y > 0) & (x + w < width) & (y + h < height)
        return int(np.count_nonzero(inside & (area >= SMALLEST_AREA_PX)))


def refined(residue: NDArray[Any], blob: Blob, floor: float) -> Blob:
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
    return Blob(part, (x0 + int(columns.min()), y0 + int(rows.min())))


def judge(pixels: NDArray[Any], blob: Blob, noise: float) -> list[Candidate]:
    """Make a candidate of a blob that passes all gates; else none."""
    (x, y), (h, w) = blob.first, blob.mask.shape
    height, width = pixels.shape
    at_border = x == 0 or y == 0 or x + w == width or y + h == height
    area = int(np.count_nonzero(blob.mask))
    if area < SMALLEST_AREA_PX:
        return []
    border = max(follow_borders(blob.mask), key=len) + np.array(blob.first)
    try:
        outline = _cut_outline(border, pixels.shape) if at_border else _moment_outline(blob)
    except GeometryError:
        return []
    a, b, _ = outline.axes
    share = area / outline.area
    least = SMALLEST_VISIBLE_SHARE if at_border else SMALLEST_ELLIPTICITY - ELLIPTICITY_PX / a
    if b < SMALLEST_AXIS_RATIO * a or share < least:
        return []
    seen = _not_at_rim(border, pixels.shape) if at_border else border
    if outline.signed_distance(seen).std() > BORDER_RMS_PX + BORDER_RMS_SHARE * a:
        return []
    contrast = _contrast(pixels, blob)
    significance = contrast * float(np.sqrt(area)) / noise
    if not significance > SMALLEST_SIGNIFICANCE:
        return []
    return [Candidate(outline, border, at_border, contrast, significance)]


def _moment_outline(blob: Blob) -> Ellipse:
    """Ellipse of the blob's first and second moments, its pixels being unit squares."""
    points = np.argwhere(blob.mask)[:, ::-1].astype(np.float64)
    centre = points.mean(axis=0)
    points -= centre
    covariance = points.T @ points / len(points) + np.eye(2) / 12
    return Ellipse.of_moments(centre + blob.first, covariance)


def _cut_outline(border: IntArray, shape: tuple[int, ...]) -> Ellipse:
    """Ellipse through the part of a border that is not the image's, half a pixel outside it."""
    # a guess for the grey-level fit, and most of what touches the border is no ellipse anyway
    inner = fit_ellipse(_not_at_rim(border, shape), max_iterations=15)
    a, b, angle = inner.axes
    return Ellipse.of(inner.centre, a + 0.5, b + 0.5, angle)


def _not_at_rim(border: IntArray, shape: tuple[int, ...]) -> IntArray:
    height, width = shape
    return border[((border > 0) & (border < [width - 1, height - 1])).all(axis=1)]


def _contrast(pixels: NDArray[Any], blob: Blob) -> float:
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
    return float(np.mean(window[own > 0]) - np.median(window[ring]))
