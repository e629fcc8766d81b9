"""Teaching a shape: the region of an image that stands out most around a place."""

from __future__ import annotations

import math
import warnings
from typing import Any

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from closerange.errors import CloseRangeWarning, DetectionError, InputError
from closerange.features.shapes import (
    MARGIN_PX,
    MAX_MARGIN_PX,
    POLARITIES,
    RING_PX,
    Polarity,
    Shape,
    elements,
    without_specks,
)
from closerange.geometry.arrays import BoolArray

WEAK_SHARPNESS = 0.25
"""A shape that stands out by less of its contrast somewhere is warned of: noise that takes half
of that makes it be missed, and lighting that varies over the part by a quarter is common."""

_LEVELS = 64  # thresholds tried when a region is looked for around a place


def teach_shape(
    pixels: NDArray[Any],
    *,
    name: str,
    at_px: tuple[float, float] | None = None,
    mask: ArrayLike | None = None,
    polarity: Polarity | None = None,
    margin_px: float = MARGIN_PX,
    rotation_step_deg: float | None = None,
) -> Shape:
    """Teach a shape from a grey image.

    Parameters
    ----------
    pixels : ndarray of uint8 or uint16, shape (H, W)
        Grey image.
    name : str
        Name of the shape.
    at_px : (float, float), optional
        x, y of a place on it. The shape is the connected region around it that stands out most
        from a ring of background, over all thresholds; its border is where the grey value is
        half-way.
    mask : array_like of bool, shape (H, W), optional
        The shape's pixels themselves, instead of a place.
    polarity : str, optional
        ``bright`` or ``dark``; by default the one that stands out more.
    margin_px : float, optional
        Half-width of the band that does not matter.
    rotation_step_deg : float, optional
        Find it at other rolls too, in steps of so many degrees.

    Returns
    -------
    Shape
        Cropped to its pixels.

    Raises
    ------
    InputError
        If neither or both of place and mask are given, or they are not in the image.
    DetectionError
        If no region stands out there, or it does not end within the image.

    Warns
    -----
    CloseRangeWarning
        If its faintest border is weak, or a roll between two steps moves the shape's rim by
        more than the margin.
    """
    _check_lesson(name, pixels, margin_px)
    if (at_px is None) == (mask is None):
        raise InputError("a shape is taught by a place or by a mask", remedy="give one of them")
    grey = without_specks(pixels).astype(np.float32)
    found: list[tuple[float, BoolArray, Polarity]] = []
    for kind in (polarity,) if polarity else POLARITIES:
        bright = grey if kind == "bright" else -grey
        region = (
            _region(bright, _seed(at_px, pixels.shape), margin_px)
            if mask is None
            else _of_size(np.asarray(mask, dtype=bool), pixels.shape)
        )
        contrast = 0.0 if region is None else _contrast(bright, region, margin_px)
        if region is not None and contrast > 0:
            found.append((contrast, region, kind))
    if not found:
        raise DetectionError(
            f"shape {name!r}: no region there is brighter or darker than all around it",
            remedy="point at the middle of a part that ends within the image and lies free, or "
            "choose a smaller margin",
        )
    contrast, region, kind = max(found, key=lambda item: item[0])
    shape = Shape(
        name,
        region,
        kind,
        contrast,
        contrast / _median_step(grey if kind == "bright" else -grey, region, margin_px),
        margin_px,
        rotation_step_deg=rotation_step_deg,
    )
    _warn_of_weakness(shape)
    return shape


def _check_lesson(name: str, pixels: NDArray[Any], margin_px: float) -> None:
    """Refuse an image or a margin that no shape can be taught with."""
    if pixels.ndim != 2 or pixels.dtype not in (np.uint8, np.uint16):
        raise InputError(
            f"an image of {pixels.dtype} and shape {pixels.shape} cannot teach a shape",
            remedy="give a two-dimensional image of uint8 or uint16",
        )
    if not 0.0 <= margin_px <= MAX_MARGIN_PX:
        raise InputError(
            f"shape {name!r}: a margin of {margin_px:g} px; possible are 0 to {MAX_MARGIN_PX:g} px",
            remedy="leave it out: 2 px suit a sharp image",
        )


def _seed(at_px: tuple[float, float] | None, size: tuple[int, ...]) -> tuple[int, int]:
    x, y = at_px if at_px is not None else (np.nan, np.nan)
    if not (0 <= x <= size[1] - 1 and 0 <= y <= size[0] - 1):
        raise InputError(
            f"the place ({x:g}, {y:g}) is not in the image of {size[1]} x {size[0]} px",
            remedy="give x and y of a pixel on the part, counted from 0",
        )
    return round(x), round(y)


def _of_size(mask: BoolArray, size: tuple[int, ...]) -> BoolArray:
    if mask.shape != size:
        raise InputError(
            f"the mask has the shape {mask.shape}, the image {size}",
            remedy="give a mask of the image's size",
        )
    return mask


def _region(bright: NDArray[Any], seed: tuple[int, int], margin_px: float) -> BoolArray | None:
    """Return the region around a place that stands out most from its background."""
    start = float(bright[seed[1], seed[0]])
    best, chosen = 0.0, None
    for level in np.linspace(start, float(bright.min()), _LEVELS, endpoint=False)[1:]:
        mask = _flooded(bright, seed, float(level))
        if mask[0].any() or mask[-1].any() or mask[:, 0].any() or mask[:, -1].any():
            break  # and at lower levels the more so
        contrast = _contrast(bright, mask, margin_px)
        if contrast > best:
            best, chosen = contrast, mask
    if chosen is None:
        return None
    inner, around = _values(bright, chosen, margin_px)
    halfway = _flooded(bright, seed, float(inner.min() + around.max()) / 2)
    return halfway if _contrast(bright, halfway, margin_px) > 0 else chosen


def _flooded(bright: NDArray[Any], seed: tuple[int, int], level: float) -> BoolArray:
    """Return the 8-connected region of pixels above a level that holds a place."""
    mask = np.zeros((bright.shape[0] + 2, bright.shape[1] + 2), np.uint8)
    above = (bright > level).astype(np.uint8)
    flags = 8 | cv2.FLOODFILL_MASK_ONLY | cv2.FLOODFILL_FIXED_RANGE | (1 << 8)
    if above[seed[1], seed[0]]:
        cv2.floodFill(above, mask, seed, 1, 0, 0, flags)
    return mask[1:-1, 1:-1] > 0


def _values(
    bright: NDArray[Any], mask: BoolArray, margin_px: float
) -> tuple[NDArray[Any], NDArray[Any]]:
    """Return the grey values under A and under W - A, as far as they are in the image."""
    rows, columns = np.flatnonzero(mask.any(axis=1)), np.flatnonzero(mask.any(axis=0))
    if not len(rows):
        return bright[:0, 0], bright[:0, 0]
    first = np.array([rows[0], columns[0]])
    part = mask[rows[0] : rows[-1] + 1, columns[0] : columns[-1] + 1]
    inner, around = (offsets + first for offsets in elements(part, margin_px, RING_PX))
    around = around[((around >= 0) & (around < bright.shape)).all(axis=1)]
    return bright[inner[:, 0], inner[:, 1]], bright[around[:, 0], around[:, 1]]


def _contrast(bright: NDArray[Any], mask: BoolArray, margin_px: float) -> float:
    """Return darkest of A less brightest of W - A; 0 or less if it does not stand out."""
    inner, around = _values(bright, mask, margin_px)
    return float(inner.min() - around.max()) if len(inner) and len(around) else 0.0


def _median_step(bright: NDArray[Any], mask: BoolArray, margin_px: float) -> float:
    inner, around = _values(bright, mask, margin_px)
    return float(np.median(inner) - np.median(around))


def _warn_of_weakness(shape: Shape) -> None:
    notes = []
    if shape.sharpness < WEAK_SHARPNESS:
        notes.append(
            f"its faintest border has a contrast of {shape.contrast:g} grey levels, "
            f"{100 * shape.sharpness:.0f} % of the whole (weak below "
            f"{100 * WEAK_SHARPNESS:.0f} %): other shapes may be taken for it, and it may be "
            "missed; teach a face that is evenly lit, or give another place"
        )
    reach = float(np.linalg.norm(np.argwhere(shape.mask) - shape.centroid, axis=1).max())
    moved = reach * math.radians(shape.rotation_step_deg or 0.0) / 2
    if moved > shape.margin_px:
        finest = math.degrees(2 * shape.margin_px / reach)
        notes.append(
            f"half-way between two rolls its rim is {moved:.1f} px away, the margin is "
            f"{shape.margin_px:g} px: it may be missed there; take steps of {finest:.1f} degrees"
        )
    for note in notes:
        warnings.warn(f"shape {shape.name!r}: {note}", CloseRangeWarning, stacklevel=3)
