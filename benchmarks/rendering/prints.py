"""Prints on surfaces: square tiles of albedo that repeat."""

from __future__ import annotations

from collections.abc import Callable, Mapping

import numpy as np
from scipy.ndimage import gaussian_filter, gaussian_filter1d

from rendering.cameras import FloatArray

TILE_MM = 64.0
TILE_PX = 768  # 12 per mm: three times finer than the images


def speckle() -> FloatArray:
    """Return black blots of about 1.5 mm on white."""
    rng = np.random.default_rng(11)
    field = gaussian_filter(rng.normal(size=(TILE_PX, TILE_PX)), 7, mode="wrap")
    return np.where(field > np.quantile(field, 0.6), 0.12, 0.75)


def wood() -> FloatArray:
    """Return soft streaks with a few dark rings, without any sharp line."""
    rng = np.random.default_rng(12)
    _, across = np.mgrid[0:TILE_PX, 0:TILE_PX] / TILE_PX
    warp = gaussian_filter(rng.normal(size=(TILE_PX, TILE_PX)), (120, 30), mode="wrap")
    warp *= 0.03 / warp.std()
    rings = 0.5 + 0.5 * np.cos(2 * np.pi * 9 * (across + warp))
    fibre = gaussian_filter1d(rng.normal(size=(TILE_PX, TILE_PX)), 60, axis=0, mode="wrap")
    fibre = gaussian_filter1d(fibre, 2, axis=1, mode="wrap")
    return np.asarray(np.clip(0.5 - 0.2 * rings**3 + 0.05 * fibre / fibre.std(), 0.08, 0.8))


def label() -> FloatArray:
    """Return print in lines: bars of different lengths like words, frames and a bar code."""
    rng = np.random.default_rng(13)
    paper = np.full((TILE_PX, TILE_PX), 0.72)
    ink = 0.08
    for line in range(7):
        top, left = 40 + 56 * line, 40
        while left < TILE_PX - 120:
            word = int(rng.integers(20, 110))
            paper[top : top + 26, left : left + word] = ink
            left += word + int(rng.integers(14, 30))
    left = 60
    while left < TILE_PX - 90:
        bar = int(rng.integers(6, 22))
        paper[470:620, left : left + bar] = ink
        left += bar + int(rng.integers(8, 24))
    paper[660:668, 40:-40] = paper[720:728, 40:-40] = ink
    return paper


def stripes() -> FloatArray:
    """Return four equal dark stripes."""
    phase = (np.arange(TILE_PX) * 4 / TILE_PX) % 1.0
    return np.broadcast_to(np.where(phase < 0.5, 0.16, 0.38), (TILE_PX, TILE_PX)).copy()


def cloth() -> FloatArray:
    """Return a mottled grey without lines."""
    rng = np.random.default_rng(14)
    shape = (TILE_PX, TILE_PX)
    field = sum(
        weight * gaussian_filter(rng.normal(size=shape), sigma, mode="wrap") * sigma
        for weight, sigma in ((1.0, 5.0), (1.0, 12.0), (0.7, 30.0))
    )
    return np.asarray(np.clip(0.26 + 0.09 * field / np.std(field), 0.05, 0.6))


PRINTS: Mapping[str, Callable[[], FloatArray]] = {
    "speckle": speckle,
    "wood": wood,
    "label": label,
    "stripes": stripes,
    "cloth": cloth,
}
