"""Pairs of images made ready for windows of any size."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import spline_filter

from closerange.geometry.arrays import FloatArray
from closerange.matching.window_information import noise_map

FINER = np.array([[1, -8, 0, 8, -1]], dtype=np.float32) / 12
"""Derivative exact to the fourth order: a plain difference halves that of fine texture."""

FINER_NOISE = 130 / 144
"""Variance that white noise of unit variance has after it."""


@dataclass(frozen=True, slots=True, eq=False)
class Level:
    """Both images on one level of the pyramid, prepared.

    Attributes
    ----------
    grey, slope_x, slope_y : ndarray of float32
        First image and its derivatives.
    spline : ndarray of float32
        Coefficients of the cubic B-spline through the second image (doi:10.1117/1.429926 shows
        that it biases sub-pixel matches ten times less than the interpolating cubics).
    noise : tuple of two ndarrays
        Standard deviation of the noise of both.
    """

    grey: NDArray[np.float32]
    slope_x: NDArray[np.float32]
    slope_y: NDArray[np.float32]
    spline: NDArray[np.float32]
    noise: tuple[NDArray[np.float32], NDArray[np.float32]]

    @classmethod
    def of(
        cls,
        images: tuple[NDArray[np.float32], NDArray[np.float32]],
        noise: tuple[NDArray[np.float32], NDArray[np.float32]],
    ) -> Level:
        """Prepare a pair of images."""
        border = cv2.BORDER_REPLICATE
        first, second = images
        return cls(
            first,
            cv2.filter2D(first, -1, FINER, borderType=border),
            cv2.filter2D(first, -1, FINER.T.copy(), borderType=border),
            spline_filter(second, 3, output=np.float32, mode="mirror"),
            noise,
        )


class ImagePair:
    """Two images and their halvings, each made once.

    Parameters
    ----------
    greys : tuple of two ndarrays, shape (H, W)
        Grey values.
    """

    def __init__(self, greys: tuple[NDArray[Any], NDArray[Any]]) -> None:
        first, second = (np.asarray(grey, np.float32) for grey in greys)
        self.greys = first, second
        self._pyramids = [first], [second]
        self._noise = noise_map(first), noise_map(second)
        self._levels: dict[int, Level] = {}

    def prepare(self, scales: set[int]) -> None:
        """Make levels beforehand: threads then only read."""
        for scale in sorted(scales):
            self.level(scale)

    def pyramids(self, top: int) -> tuple[list[NDArray[np.float32]], list[NDArray[np.float32]]]:
        """Return both images and so many halvings of each."""
        first, second = (pyramid(images, top) for images in self._pyramids)
        return first, second

    def level(self, scale: int) -> Level:
        """Return the images so many times smaller (1, 2, 4, ...), ready for the refinement."""
        if scale not in self._levels:
            number = scale.bit_length() - 1
            first, second = (part[number] for part in self.pyramids(number))
            self._levels[scale] = Level.of((first, second), self.noises(number))
        return self._levels[scale]

    def noises(self, number: int) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """Return the standard deviation of the noise of both images on a level of the pyramid."""
        pair = (part[number] for part in self.pyramids(number))
        # a halving averages over four pixels and more
        first, second = (
            cv2.resize(part, image.shape[::-1], interpolation=cv2.INTER_NEAREST) / (1 << number)
            for part, image in zip(self._noise, pair, strict=True)
        )
        return first, second


def pyramid(images: list[NDArray[np.float32]], levels: int) -> list[NDArray[np.float32]]:
    """Return images and further halvings; pixel x of a level is pixel 2 x of the finer one."""
    grown = list(images)
    while len(grown) <= levels:
        grown.append(np.asarray(cv2.pyrDown(grown[-1]), dtype=np.float32))
    return grown[: levels + 1]


def saturation(grey: NDArray[np.float32]) -> float:
    """Return the grey value at which an image clips; infinite if it does not.

    The largest value of an image is its full scale if it is that of a sensor of 8 to 16 bits.
    """
    largest = float(grey.max()) if grey.size else 0.0
    scales = {float(2**bits - 1) for bits in (8, 10, 12, 14, 16)} | {
        float((2**bits - 1) << (16 - bits)) for bits in (10, 12, 14)
    }
    return largest if largest in scales else np.inf


def clipped_share(
    grey: NDArray[np.float32], xy_px: FloatArray, half_width: FloatArray
) -> FloatArray:
    """Return the share of pixels at full scale in the square around each point, shape (N,)."""
    full = grey >= saturation(grey)
    if not full.any():
        return np.zeros(len(xy_px))
    total = cv2.integral(full.astype(np.uint8))
    height, width = grey.shape
    low = np.rint(xy_px - half_width[:, None]).astype(np.int64)
    high = np.rint(xy_px + half_width[:, None]).astype(np.int64) + 1
    limit = np.array([width, height])
    low, high = np.clip(low, 0, limit), np.clip(high, 0, limit)
    inside = (
        total[high[:, 1], high[:, 0]]
        - total[low[:, 1], high[:, 0]]
        - total[high[:, 1], low[:, 0]]
        + total[low[:, 1], low[:, 0]]
    )
    return np.asarray(inside / np.maximum((high - low).prod(axis=1), 1))
