"""Windows of a whole image compared with the other view through families of parallel planes."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from closerange.geometry.arrays import FloatArray
from closerange.matching.pencil import Pencil
from closerange.matching.window_planes import SeedRays
from closerange.matching.window_smooth import UNIT

WINDOW = 5
"""Side of the windows, samples: small ones keep the borders of surfaces, and neighbours help."""

NODE = 8
"""Pixels of the level between those whose way through a plane is computed."""

STEP = 1.0
"""Longest way in the second view from one plane to the next, samples."""

FAR = -1e6
"""Place of what is behind the camera: in no image."""

MOST_PLANES = 4096
"""Planes: more than a segment has samples on any level that is swept."""


@dataclass(frozen=True, slots=True, eq=False)
class Block:
    """Rows of a level of the first view whose windows are compared at once.

    Attributes
    ----------
    scale : int
        How many times the level is smaller than the image.
    corner : tuple of int
        First column and row.
    size : tuple of int
        Columns and rows.
    """

    scale: int
    corner: tuple[int, int]
    size: tuple[int, int]

    def nodes(self) -> tuple[FloatArray, tuple[int, int]]:
        """Return places in image px, shape (n, 2), and how many columns and rows there are.

        They lie so that OpenCV's enlarging by `NODE` brings them to the pixels; a further one on
        each side leaves no pixel at the border of the enlarged image.
        """
        counts = [-(-length // NODE) + 2 for length in self.size]
        x, y = (
            self.scale * (first + NODE * (np.arange(count) - 0.5) - 0.5)
            for first, count in zip(self.corner, counts, strict=True)
        )
        grid_x, grid_y = np.meshgrid(x, y)
        return np.column_stack([grid_x.ravel(), grid_y.ravel()]), (counts[0], counts[1])

    def enlarged(self, values: NDArray[np.float32]) -> NDArray[np.float32]:
        """Interpolate values at the nodes, shape (rows, columns[, channels]), at all pixels."""
        rows, columns = values.shape[:2]
        whole = cv2.resize(values, (columns * NODE, rows * NODE), interpolation=cv2.INTER_LINEAR)
        width, height = self.size
        return np.ascontiguousarray(whole[NODE : NODE + height, NODE : NODE + width])


@dataclass(frozen=True, slots=True, eq=False)
class Moments:
    """Mean and variance, with noise, of the windows of an image."""

    grey: NDArray[np.float32]
    mean: NDArray[np.float32]
    spread: NDArray[np.float32]

    @classmethod
    def of(cls, grey: NDArray[np.float32], noise: NDArray[np.float32] | float) -> Moments:
        """Take the moments of all windows."""
        mean = cv2.blur(grey, (WINDOW, WINDOW))
        variance = cv2.blur(grey * grey, (WINDOW, WINDOW)) - mean * mean
        # what noise alone makes is no texture: windows without any then correlate with nothing
        return cls(grey, mean, np.maximum(variance, 0.0) + noise)

    def rows(self, rows: slice) -> Moments:
        """Keep some rows."""
        return Moments(self.grey[rows], self.mean[rows], self.spread[rows])


def plane_omegas(rays: SeedRays, low: float, high: float, scale: int) -> FloatArray:
    """Return evenly spaced inverse depths that are nowhere further apart than `STEP` samples.

    Parameters
    ----------
    rays : SeedRays
        Some pixels that stand for all.
    low, high : float
        Limits of the inverse depth.
    scale : int
        Of the level.
    """
    fastest = 0.0
    for omega in np.linspace(low, high, 9):
        pace = np.linalg.norm(rays.pace(np.full(len(rays), omega)), axis=1)
        if np.isfinite(pace).any():
            fastest = max(fastest, float(np.quantile(pace[np.isfinite(pace)], 0.9)))
    count = int(np.ceil((high - low) * fastest / (STEP * scale))) + 1
    return np.linspace(low, high, int(np.clip(count, 2, MOST_PLANES)))


def cost_volume(
    pencil: Pencil,
    levels: tuple[NDArray[np.float32], NDArray[np.float32]],
    noise: tuple[NDArray[np.float32], NDArray[np.float32]],
    block: Block,
    omegas: FloatArray,
    tilts: FloatArray,
) -> NDArray[np.uint8]:
    """Compare the windows of all pixels of a block at all inverse depths.

    All pixels share the work: the second view is carried through one plane after the other, and
    box filters compare every window with it at once. A tilted plane meets each pixel's ray at
    another inverse depth, and counts there; of all tilts the best is kept.

    Parameters
    ----------
    pencil : Pencil
        Of the two cameras.
    levels : tuple of two ndarrays
        Both views on the level of the block.
    noise : tuple of two ndarrays
        Standard deviations of their noise, on the same level.
    block : Block
        Part of the first view.
    omegas : ndarray, shape (K,)
        Evenly spaced inverse depths.
    tilts : ndarray, shape (H, 2)
        Hypotheses of the surface's tilt.

    Returns
    -------
    ndarray of uint8, shape (rows, columns, K)
        One less the correlation, times `UNIT`; `UNIT` where there is nothing to compare.
    """
    x, y = block.corner
    width, height = block.size
    middle = np.float32(levels[0].mean())
    part = slice(y, y + height), slice(x, x + width)
    first = Moments.of(levels[0][part] - middle, noise[0][part] ** 2)
    second = levels[1] - middle
    other_noise = float(np.median(noise[1])) ** 2
    pixels, (columns, rows) = block.nodes()
    rays = SeedRays.of(pencil, pixels)
    volume = np.full((height, width, len(omegas)), UNIT, dtype=np.uint8)
    values = volume.reshape(-1)
    own = (np.arange(height * width) * len(omegas)).reshape(height, width)
    step = float(omegas[1] - omegas[0])
    for tilt in tilts:
        ratio = rays.along_plane(tilt)
        shared = block.enlarged(ratio.reshape(rows, columns).astype(np.float32))
        for omega in _family(omegas, shared, step):
            place = shared * np.float32(omega / step) - np.float32(omegas[0] / step - 0.5)
            band = _rows_between(place, len(omegas))
            if band.stop == band.start:
                continue
            seen = pencil.second.project(rays.at(omega * ratio)) / block.scale
            seen = np.nan_to_num(seen, nan=FAR, posinf=FAR, neginf=FAR)
            there = block.enlarged(seen.reshape(rows, columns, 2).astype(np.float32))[band]
            cost, shown = _unlike(first.rows(band), second, other_noise, there)
            column = place[band].astype(np.int32)
            good = shown & (place[band] >= 0) & (column < len(omegas))
            flat = (own[band] + column)[good]
            values[flat] = np.minimum(values[flat], cost[good])
    return volume


def _rows_between(place: NDArray[np.float32], planes: int) -> slice:
    """Return the rows that hold any pixel whose plane is one of those asked for, and a window."""
    inside = np.flatnonzero((place.max(axis=1) >= 0) & (place.min(axis=1) < planes))
    if not inside.size:
        return slice(0, 0)
    return slice(max(int(inside[0]) - WINDOW // 2, 0), int(inside[-1]) + WINDOW // 2 + 1)


def _family(omegas: FloatArray, ratio: NDArray[np.float32], step: float) -> FloatArray:
    """Return inverse depths on the middle ray of parallel planes that leave no pixel out."""
    low, high = float(ratio.min()), float(ratio.max())
    if not (np.isfinite(low) and low > 0):
        return np.empty(0)  # a plane that some ray of the block never meets
    first, last = float(omegas[0]) / high, float(omegas[-1]) / low
    return np.linspace(first, last, int(np.ceil((last - first) * high / step)) + 1)


def _unlike(
    first: Moments, second: NDArray[np.float32], noise: float, there: NDArray[np.float32]
) -> tuple[NDArray[np.uint8], NDArray[np.bool_]]:
    """Return the cost of all windows on one plane, and which of them the second view shows."""
    height, width = second.shape
    x, y = there[..., 0], there[..., 1]
    shown = (x >= 0) & (x <= width - 1) & (y >= 0) & (y <= height - 1)
    grey = cv2.remap(second, there, None, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    other = Moments.of(grey, noise)
    shared = cv2.blur(first.grey * grey, (WINDOW, WINDOW)) - first.mean * other.mean
    rho = shared / np.sqrt(first.spread * other.spread + np.float32(1e-6))
    cost = np.float32(UNIT + 0.5) - np.float32(UNIT) * np.clip(rho, np.float32(0), np.float32(1))
    return cost.astype(np.uint8), shown
