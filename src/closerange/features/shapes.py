"""Taught shapes: their pixels, the band that does not matter, and the window around them."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any, Literal

import cv2
import numpy as np
from numpy.typing import NDArray

from closerange.errors import InputError
from closerange.geometry.arrays import BoolArray, FloatArray, IntArray

MARGIN_PX = 2.0
"""Half-width of the band around the border that is not looked at: pixels of the shape up to so far
from the nearest background pixel, and the other way round. The border lies half a pixel before
that pixel on average; half a pixel goes for a part that lies between pixels, and a pixel for the
blur of lens and sensor. Shapes whose borders lie so far apart somewhere are told apart."""

RING_PX = 3.0
"""Width of the background beyond the band that must be seen. Three pixels are the least that no
blurred border fills; more would ask for emptier surroundings without telling more."""

MAX_SIDE_PX = 2048
"""Longest side of a taught shape."""

MAX_MARGIN_PX = 64.0
"""Widest half-width of the band: more would leave nothing of most shapes."""

MAX_ROLLS = 720
"""Most elements in the stack of one shape: steps of half a degree."""

Polarity = Literal["bright", "dark"]
POLARITIES: tuple[Polarity, ...] = ("bright", "dark")


@dataclass(frozen=True, slots=True, eq=False)
class Shape:
    """A taught shape: set A, the band that does not matter and the window W around it.

    Attributes
    ----------
    name : str
        Its name, not empty.
    mask : ndarray of bool, shape (h, w)
        The taught pixels, cropped to them.
    polarity : str
        ``bright`` or ``dark`` against its background.
    contrast : float
        Grey levels between its darkest pixel and the brightest of its background (for a dark
        shape the other way round) when it was taught, without the band.
    sharpness : float
        The same as a share of the difference of the medians of shape and background: near 1
        for an even face on an even ground, small where both vary.
    margin_px : float
        Pixels nearer than this to the border, on either side, do not matter.
    ring_px : float
        Width of the background beyond the band.
    rotation_step_deg : float or None
        Step of a stack of rolled elements all around; None for the taught roll only.

    Raises
    ------
    InputError
        If nothing is left of the shape within the band, it is larger than 2048 px, or a number
        is out of range.
    """

    name: str
    mask: BoolArray
    polarity: Polarity
    contrast: float
    sharpness: float
    margin_px: float = MARGIN_PX
    ring_px: float = RING_PX
    rotation_step_deg: float | None = None

    def __post_init__(self) -> None:
        mask = np.array(self.mask, dtype=bool)
        if not self.name.strip():
            raise InputError("a shape has no name", remedy="give it one")
        if self.polarity not in POLARITIES:
            raise InputError(
                f"shape {self.name!r}: polarity {self.polarity!r}", remedy="write bright or dark"
            )
        if mask.ndim != 2 or not mask.any():
            raise InputError(f"shape {self.name!r} has no pixel", remedy="teach it from its mask")
        rows, columns = np.flatnonzero(mask.any(axis=1)), np.flatnonzero(mask.any(axis=0))
        mask = mask[rows[0] : rows[-1] + 1, columns[0] : columns[-1] + 1].copy()
        if max(mask.shape) > MAX_SIDE_PX:
            raise InputError(
                f"shape {self.name!r} is {mask.shape[1]} x {mask.shape[0]} px, the limit is "
                f"{MAX_SIDE_PX}",
                remedy="teach it from a smaller image",
            )
        mask.flags.writeable = False
        object.__setattr__(self, "mask", mask)
        self._check_numbers()
        if not without_band(mask, self.margin_px).any():
            raise InputError(
                f"shape {self.name!r}: nothing of it is farther than {self.margin_px:g} px from "
                "its border",
                remedy="choose a smaller margin, or an image in which it is larger",
            )

    def _check_numbers(self) -> None:
        limits = {
            "contrast": (self.contrast, 0.0, 65535.0),
            "sharpness": (self.sharpness, 0.0, 10.0),
            "margin_px": (self.margin_px, 0.0, MAX_MARGIN_PX),
            "ring_px": (self.ring_px, 1.0, 64.0),
        }
        if self.rotation_step_deg is not None:
            limits["rotation_step_deg"] = (self.rotation_step_deg, 360 / MAX_ROLLS, 180.0)
        for name, (value, least, most) in limits.items():
            if not least <= value <= most:
                raise InputError(
                    f"shape {self.name!r}: {name} is {value}",
                    remedy=f"choose {least:g} to {most:g}",
                )

    @property
    def bright(self) -> bool:
        """Whether it is brighter than its background."""
        return self.polarity == "bright"

    @property
    def centroid(self) -> FloatArray:
        """Row and column of the taught pixels' centroid in the mask."""
        return np.asarray(np.argwhere(self.mask).mean(axis=0))

    @property
    def centroid_offset(self) -> FloatArray:
        """Centroid less the whole pixel that is the elements' origin, row and column."""
        return np.asarray(self.centroid - np.rint(self.centroid))

    def stack(self) -> Iterator[tuple[float, IntArray, IntArray]]:
        """Yield the elements of each roll.

        Yields
        ------
        roll_rad : float
            From +x towards +y; 0 first.
        inner : ndarray of int, shape (K, 2)
            Offsets (row, column) of A without the band.
        around : ndarray of int, shape (L, 2)
            Offsets of W - A without the band.
        """
        step = self.rotation_step_deg
        count = 1 if step is None else max(1, round(360 / step))
        for number in range(count):
            roll = 2 * math.pi * number / count
            mask, origin = self._turned(roll)
            inner, around = elements(mask, self.margin_px, self.ring_px)
            if len(inner):
                yield roll, inner - origin, around - origin

    def _turned(self, roll: float) -> tuple[BoolArray, IntArray]:
        """Return the mask turned about its centroid, and the origin in it."""
        if roll == 0:
            return self.mask, np.rint(self.centroid).astype(np.int64)
        half = math.ceil(math.hypot(*self.mask.shape)) + 1
        row, column = self.centroid
        cos, sin = math.cos(roll), math.sin(roll)
        # x to the right, y downwards: a positive roll turns +x towards +y
        matrix = np.array(
            [
                [cos, -sin, half - cos * column + sin * row],
                [sin, cos, half - sin * column - cos * row],
            ]
        )
        share = cv2.warpAffine(self.mask.astype(np.float32), matrix, (2 * half + 1, 2 * half + 1))
        return share > 0.5, np.array([half, half])


def without_specks(pixels: NDArray[Any]) -> NDArray[Any]:
    """Return the median of 3 x 3 px, which single hot and dead pixels do not survive."""
    median = cv2.medianBlur(np.ascontiguousarray(pixels), 3)
    return np.asarray(median).reshape(pixels.shape)


def elements(mask: BoolArray, margin_px: float, ring_px: float) -> tuple[IntArray, IntArray]:
    """Return A and W - A of a mask without the band, as rows and columns in the mask.

    Parameters
    ----------
    mask : ndarray of bool, shape (h, w)
        The shape's pixels.
    margin_px, ring_px : float
        Half-width of the band and width of the background beyond it.

    Returns
    -------
    inner, around : ndarray of int, shape (K, 2) and (L, 2)
        Pixels of the shape farther than the margin from its nearest background pixel, and
        pixels of the background between margin and margin + ring from the shape's nearest
        (holes included).
    """
    reach = math.ceil(margin_px + ring_px) + 1
    padded = np.pad(mask, reach)
    away = _distance(~padded)  # of background pixels from the shape
    around = (away > margin_px) & (away <= margin_px + ring_px)
    return np.argwhere(without_band(mask, margin_px)), np.argwhere(around) - reach


def without_band(mask: BoolArray, margin_px: float) -> BoolArray:
    """Return the pixels of a mask that are farther than the margin from its background."""
    return np.asarray((_distance(np.pad(mask, 1)) > margin_px)[1:-1, 1:-1])


def _distance(mask: BoolArray) -> NDArray[Any]:
    """Exact distance of the pixels of a mask from the nearest one outside of it."""
    return np.asarray(
        cv2.distanceTransform(mask.astype(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_PRECISE)
    )
