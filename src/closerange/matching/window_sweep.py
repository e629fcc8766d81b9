"""Where many textured windows may lie in the other view: one sweep of the image for all of them."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from closerange.geometry.arrays import BoolArray, FloatArray, IntArray
from closerange.matching.pencil import Pencil
from closerange.matching.window_images import ImagePair
from closerange.matching.window_planes import SeedRays, tilt_hypotheses
from closerange.matching.window_smooth import UNIT, smoothed
from closerange.matching.window_volume import WINDOW, Block, cost_volume, plane_omegas

MOST_CELLS = 12_000_000
"""Pixels times planes that are held at once: 12 MB of costs and 24 MB of sums."""

MARGIN = 16
"""Rows beyond a block that have a say in it: a difference of the sums has faded after as many."""

WORTH = 40.0
"""Windows that the sweep of an image compares in the time in which one is compared alone."""

BESIDE = 2
"""Samples to the neighbours whose surfaces are tried too: half a window and a bit."""

TYPICAL = 200
"""Points that are enough to know how a segment's planes lie."""

APART = 1
"""Planes next to a place that are the same place."""

OWN = 2
"""Places that the sums at the point itself name."""

NATS = 4.0
"""Logarithm of the likelihood ratio that a window is worth which fits against one that explains
nothing. Of the 25 samples of a window a quarter are independent, and half their number times the
logarithm of the unexplained share, at a correlation of 0.85, is 4."""


@dataclass(frozen=True, slots=True, eq=False)
class Sweep:
    """Likely places of all pixels of a level.

    Attributes
    ----------
    scale : int
        How many times the level is smaller than the image.
    omega : ndarray of float32, shape (H, W)
        Inverse depth of the surface at each pixel; NaN where nothing was compared.
    step : float
        From one plane to the next.
    place : ndarray, shape (N, C)
        Inverse depths that N points may have; NaN fills up.
    prior : ndarray, shape (N, C)
        What the neighbours say about them: logarithms of a likelihood, the best being 0.
    """

    scale: int
    omega: NDArray[np.float32]
    step: float
    place: FloatArray
    prior: FloatArray

    def select(self, rows: slice | IntArray) -> tuple[FloatArray, FloatArray]:
        """Return places and priors of some points."""
        return self.place[rows], self.prior[rows]

    def near(self, xy_px: FloatArray) -> FloatArray:
        """Return the inverse depths at the four pixels around points, shape (N, 4)."""
        height, width = self.omega.shape
        low = np.floor(np.nan_to_num(xy_px) / self.scale).astype(np.int64)
        columns = np.clip(low[:, :1] + [0, 1, 0, 1], 0, width - 1)
        rows = np.clip(low[:, 1:] + [0, 0, 1, 1], 0, height - 1)
        return np.asarray(self.omega[rows, columns], dtype=np.float64)


def worth_sweeping(
    points: int, windows_each: int, planes: int, pair: ImagePair, level: int
) -> bool:
    """Tell whether sweeping both images costs less than sweeping so many segments one by one.

    Parameters
    ----------
    points : int
        That are asked for.
    windows_each : int
        That would be compared for each of them alone.
    planes : int
        Of the image's sweep, all tilts together.
    pair : ImagePair
        Images.
    level : int
        On which they would be swept.
    """
    pixels = sum(grey.size for grey in pair.greys) >> 2 * level
    return points * windows_each * WORTH > pixels * planes


def sweep(
    pencil: Pencil,
    pair: ImagePair,
    rays: SeedRays,
    limits: tuple[FloatArray, FloatArray],
    level: int,
    *,
    backward: bool = False,
) -> Sweep:
    """Compare the windows of a whole image with the other view, and smooth what they say.

    Parameters
    ----------
    pencil : Pencil
        Of the two cameras.
    pair : ImagePair
        Images.
    rays : SeedRays
        N points whose places are wanted; there must be one.
    limits : tuple of two ndarrays, shape (N,)
        Smallest and largest inverse depths on their segments; none may be NaN.
    level : int
        Of the pyramid.
    backward : bool
        Whether the pencil starts from the second image of the pair.
    """
    images, noise = pair.pyramids(level), pair.noises(level)
    if backward:
        images, noise = images[::-1], noise[::-1]
    levels = images[0][level], images[1][level]
    scale = 1 << level
    low, high = float(limits[0].min()), float(limits[1].max())
    some = rays.select(np.arange(0, len(rays), len(rays) // TYPICAL + 1))
    omegas = plane_omegas(some, low, high, scale)
    tilts = tilt_hypotheses(some, np.full(len(some), (low + high) / 2), scale * (WINDOW // 2))
    # small windows need not be tilted both ways at once
    tilts = tilts[(tilts == 0).any(axis=1)]
    height, width = levels[0].shape
    result = Sweep(
        scale,
        np.full((height, width), np.nan, dtype=np.float32),
        float(omegas[1] - omegas[0]),
        np.full((len(rays), OWN + 5), np.nan),
        np.full((len(rays), OWN + 5), -np.inf),
    )
    pixel = np.rint(rays.xy_px / scale)
    for first, last in _bands(height, width * len(omegas)):
        top, bottom = max(first - MARGIN, 0), min(last + MARGIN, height)
        block = Block(scale, (0, top), (width, bottom - top))
        cost = cost_volume(pencil, levels, noise, block, omegas, tilts)
        total = smoothed(cost)
        surface = omegas[total.argmin(axis=2)].astype(np.float32)
        surface[(cost == UNIT).all(axis=2)] = np.nan
        result.omega[first:last] = surface[first - top : last - top]
        mine = np.flatnonzero((pixel[:, 1] >= first) & (pixel[:, 1] < last))
        if mine.size:
            where = pixel[mine].astype(np.int64) - np.array([0, top])
            places = _places(cost, total, where, omegas, (limits[0][mine], limits[1][mine]))
            result.place[mine], result.prior[mine] = places
    return result


def _bands(height: int, row_cells: int) -> list[tuple[int, int]]:
    """Return first and last row of blocks that are no larger than `MOST_CELLS`, if possible."""
    rows = max(MOST_CELLS // max(row_cells, 1) - 2 * MARGIN, MARGIN)
    count = -(-height // rows)
    edges = np.linspace(0, height, count + 1).round().astype(int)
    return [(int(a), int(b)) for a, b in pairwise(edges)]


def _places(
    cost: NDArray[np.uint8],
    total: NDArray[np.uint16],
    where: IntArray,
    omegas: FloatArray,
    limits: tuple[FloatArray, FloatArray],
) -> tuple[FloatArray, FloatArray]:
    """Return the places that points may have, and what their neighbours say of them."""
    height, width, _ = cost.shape
    x, y = np.clip(where[:, 0], 0, width - 1), np.clip(where[:, 1], 0, height - 1)
    sums, own = total[y, x].astype(np.float64), cost[y, x].astype(np.float64)
    step = omegas[1] - omegas[0]
    allowed = omegas >= limits[0][:, None] - step
    allowed &= omegas <= limits[1][:, None] + step
    sums = np.where(allowed, sums, np.inf)
    own = np.where(allowed, own, np.inf)
    listed = [*_minima(sums, OWN), own.argmin(axis=1)]
    for dx, dy in ((-BESIDE, 0), (BESIDE, 0), (0, -BESIDE), (0, BESIDE)):
        u, v = np.clip(x + dx, 0, width - 1), np.clip(y + dy, 0, height - 1)
        listed.append(total[v, u].argmin(axis=1))
    columns = np.stack(listed, axis=1)
    rows = np.arange(len(columns))[:, None]
    # what a place is worth to the neighbours: the windows of the point itself are compared anew
    known = np.isfinite(sums[rows, columns]) & ~_again(columns)
    told = np.where(known, total[y[:, None], x[:, None], columns], np.inf)
    told = told - 4.0 * cost[y[:, None], x[:, None], columns]
    best = told.min(axis=1, keepdims=True)
    with np.errstate(invalid="ignore"):
        prior = np.where(known, (best - told) * NATS / UNIT, -np.inf)
    order = np.argsort(~known, axis=1, kind="stable")
    place = np.where(known, omegas[columns], np.nan)
    return np.take_along_axis(place, order, axis=1), np.take_along_axis(prior, order, axis=1)


def _minima(sums: FloatArray, count: int) -> list[IntArray]:
    """Return the columns of the least sums that are local minima."""
    padded = np.pad(sums, ((0, 0), (1, 1)), constant_values=np.inf)
    low = (sums <= padded[:, :-2]) & (sums < padded[:, 2:])
    left = np.where(low, sums, np.inf)
    found = []
    for _ in range(count):
        column = left.argmin(axis=1)
        found.append(column)
        left[np.arange(len(left)), column] = np.inf
    return found


def _again(columns: IntArray) -> BoolArray:
    """Mark columns that repeat an earlier one of their row."""
    near = np.abs(columns[:, :, None] - columns[:, None, :]) <= APART
    return np.asarray((near & np.tri(columns.shape[1], k=-1, dtype=bool)).any(axis=2))
