"""Where a textured window may lie in the other view: a sweep along its segment, coarse to fine."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace

import numpy as np
from numpy.typing import NDArray

from closerange.geometry.arrays import FloatArray, IntArray
from closerange.matching.window_planes import SeedRays
from closerange.matching.window_scores import SHAPES, scores
from closerange.rig.camera import Camera

Pyramid = list[NDArray[np.float32]]

OTHER_LEVEL = 1
"""Level on which further views are looked at: a place good to a pixel in the second view may be two
or three off in one that stands further away."""

KEPT = 8
"""Places that are looked at more finely: the best of each shape, and the best others."""

HOPELESS = 10.0
"""Logarithm of the likelihood, a mean over all shapes, by which a place may be behind the best one
on the levels seen so far: one of twenty thousand comes back."""

NEAR = 2
"""Samples on each side of such a place that are tried on the next finer level: one of the coarser
level."""

WINDOWS = 400
"""Windows that are compared for a seed on the coarsest level, about; more than that start on a
coarser one. The same number is compared on each finer level."""

COARSEST = 4
"""Levels above the image itself: on the uppermost, eleven samples are 176 px wide."""

TELLING = 1.0
"""Gain in likelihood, as a logarithm and a mean over all shapes, from which on a finer level moves
a place: blank windows differ by half of it by chance."""

APART_PX = 2.0
"""Two places along the curve that are further apart are different answers."""

TOGETHER = 3
"""Levels, from the finest, whose likelihoods may be added."""


@dataclass(frozen=True, slots=True, eq=False)
class Places:
    """The best and the second-best place of N windows; columns of two in that order.

    Attributes
    ----------
    omega : ndarray, shape (N, 2)
        Inverse depths; NaN without one.
    tilt : ndarray, shape (N, 2, 2)
        Tangents of the surface's tilts.
    shape : ndarray of int, shape (N,)
        The shape of the structuring element that tells the two places apart best.
    evidence : ndarray, shape (N,)
        Logarithm of the likelihood ratio of the two places for that shape.
    """

    omega: FloatArray
    tilt: FloatArray
    shape: IntArray
    evidence: FloatArray

    @classmethod
    def empty(cls, count: int) -> Places:
        """Return no places; arrays may be filled in."""
        return cls(
            np.full((count, 2), np.nan),
            np.zeros((count, 2, 2)),
            np.zeros(count, dtype=np.int64),
            np.full(count, -np.inf),
        )

    def put(self, rows: IntArray, part: Places) -> None:
        """Fill in rows."""
        for item in fields(self):
            getattr(self, item.name)[rows] = getattr(part, item.name)


def start_level(samples: int, hypotheses: int, size_px: tuple[int, int]) -> int:
    """Return the level on which whole segments are swept; at least the first.

    Parameters
    ----------
    samples : int
        Length of a long segment, px.
    hypotheses : int
        Tilts that are tried.
    size_px : tuple of int
        Of the smaller image.
    """
    level = 1
    while (
        level < COARSEST and samples * hypotheses > WINDOWS << level and min(size_px) >= 64 << level
    ):
        level += 1
    return level


def find_places(
    rays: SeedRays,
    omega: FloatArray,
    images: tuple[Pyramid, Pyramid],
    tilts: FloatArray,
    others: Sequence[tuple[Camera, Pyramid]] = (),
) -> Places:
    """Find the best and the second-best place of each window on its epipolar segment.

    The structuring element is chosen for each point: of all shapes and sizes (a size being the
    sum over some of the finest levels) the one whose best place is the most likely against its own
    second-best. A window too small or too plain fits everywhere, one that straddles two surfaces
    fits badly everywhere: both have little evidence, and no truth is needed to see it.

    Parameters
    ----------
    rays : SeedRays
        N seeds.
    omega : ndarray, shape (N, K)
        Inverse depths of samples a px apart along the segments; NaN after the last.
    images : tuple of two lists of ndarrays
        Pyramids of both views, with as many levels as are to be swept.
    tilts : ndarray, shape (H, 2)
        Hypotheses of the surface's tilt.
    others : sequence of (Camera, pyramid), optional
        Further views: what a place explains there too speaks for it.

    Returns
    -------
    Places
        One row for each seed.
    """
    top = len(images[0]) - 1
    first = omega[:, :: 1 << top]
    likely, tilt = scores(rays, first, (images[0][top], images[1][top]), 1 << top, tilts)
    column = _outstanding(likely)
    rows = np.arange(len(rays))[:, None]
    place = np.where(column >= 0, first[rows, column], np.nan)
    hypothesis = tilt[rows, column]
    levels = [np.where((column >= 0)[:, :, None], likely[rows, column], -np.inf)]
    for level in range(top - 1, -1, -1):
        place = _hopeful(place, levels)
        pair = (images[0][level], images[1][level])
        place, hypothesis, value = _refined(rays, place, pair, 1 << level, tilts, hypothesis)
        levels.append(value)
    told = _elsewhere(rays, place, images[0], tilts, others)
    prior = np.zeros(told.shape)
    return _decided(rays, place, tilts[hypothesis], levels[::-1][:TOGETHER], (prior, told))


def choose_places(
    rays: SeedRays,
    place: FloatArray,
    prior: FloatArray,
    images: tuple[Pyramid, Pyramid],
    tilts: FloatArray,
    others: Sequence[tuple[Camera, Pyramid]] = (),
) -> Places:
    """Choose the best and the second-best of places that are known beforehand.

    Parameters
    ----------
    rays : SeedRays
        N seeds.
    place : ndarray, shape (N, C)
        Inverse depths, good to a sample of the uppermost level; NaN fills up at the end.
    prior : ndarray, shape (N, C)
        Logarithms of the likelihood that they have by other evidence.
    images : tuple of two lists of ndarrays
        Pyramids of both views.
    tilts : ndarray, shape (H, 2)
        Hypotheses of the surface's tilt.
    others : sequence of (Camera, pyramid), optional
        Further views.

    Returns
    -------
    Places
        One row for each seed.
    """
    top = len(images[0]) - 1
    pairs = list(zip(*images, strict=True))
    # tilts show best on the uppermost level
    place, hypothesis, value = _refined(rays, place, pairs[top], 1 << top, tilts, reach=0)
    for level in range(top - 1, -1, -1):
        place, hypothesis, value = _refined(
            rays, place, pairs[level], 1 << level, tilts, hypothesis
        )
    levels = [value]
    # places half a plane off must not count less than those that happen to lie on one
    for level in range(1, min(top + 1, TOGETHER)):
        _, _, value = _refined(rays, place, pairs[level], 1 << level, tilts, hypothesis, reach=0)
        levels.append(value)
    told = _elsewhere(rays, place, images[0], tilts, others)
    prior = prior[:, : place.shape[1]]
    return _decided(rays, place, tilts[hypothesis], levels, (prior, told))


def _elsewhere(
    rays: SeedRays,
    place: FloatArray,
    first: Pyramid,
    tilts: FloatArray,
    others: Sequence[tuple[Camera, Pyramid]],
) -> FloatArray:
    """Return what further views say for places: a reward, as they may be hidden there."""
    told = np.zeros(place.shape)
    for camera, pyramid in others:
        level = min(OTHER_LEVEL, len(pyramid) - 1, len(first) - 1)
        pair = (first[level], pyramid[level])
        towards = replace(rays, second=camera)
        _, _, value = _refined(towards, place, pair, 1 << level, tilts, reach=1)
        told[:, : value.shape[1]] += np.maximum(value.mean(axis=2), 0.0)
    return told


def _hopeful(place: FloatArray, levels: list[FloatArray]) -> FloatArray:
    """Drop places that are far less likely than the best of their seed."""
    used = place.shape[1]
    total = np.sum([level[:, :used].mean(axis=2) for level in levels], axis=0)
    best = total.max(axis=1, initial=-np.inf, keepdims=True)
    with np.errstate(invalid="ignore"):
        return np.where(best - total <= HOPELESS, place, np.nan)


def _outstanding(likely: FloatArray) -> IntArray:
    """Return the columns of up to `KEPT` places, shape (N, KEPT); -1 fills up."""
    total = likely.sum(axis=2)
    padded = np.pad(total, ((0, 0), (1, 1)), constant_values=-np.inf)
    peak = (total >= padded[:, :-2]) & (total > padded[:, 2:]) & np.isfinite(total)
    order = np.argsort(np.where(peak, -total, np.inf), axis=1, kind="stable")[:, :KEPT]
    ranked = np.where(np.take_along_axis(peak, order, axis=1), order, -1)
    best = np.where(np.isfinite(likely).any(axis=1), likely.argmax(axis=1), -1)
    # the best two of all shapes together, then the best of each shape, then the others
    listed = np.concatenate([ranked[:, :2], best, ranked[:, 2:]], axis=1)
    near = np.abs(listed[:, :, None] - listed[:, None, :]) <= 1
    again = (near & np.tri(listed.shape[1], k=-1, dtype=bool)).any(axis=2)
    listed = np.where(again, -1, listed)
    order = np.argsort(listed < 0, axis=1, kind="stable")[:, :KEPT]
    return np.asarray(np.take_along_axis(listed, order, axis=1))


def _refined(
    rays: SeedRays,
    place: FloatArray,
    images: tuple[NDArray[np.float32], NDArray[np.float32]],
    scale: int,
    tilts: FloatArray,
    hypothesis: IntArray | None = None,
    *,
    reach: int = NEAR,
) -> tuple[FloatArray, IntArray, FloatArray]:
    """Look around places on a finer level; return places, tilts and the likelihood of shapes.

    Of the tilts only that of the coarser level is tried again, and none: a window that straddled
    two surfaces lies on one of them when it is half as wide.
    """
    known = np.isfinite(place)
    used = int(np.flatnonzero(known.any(axis=0)).max(initial=0)) + 1
    place, known = place[:, :used], known[:, :used]
    point, column = np.nonzero(known)
    step = np.full(place.shape, np.nan)
    pace = rays.select(point).pace(place[known])
    step[known] = scale / np.linalg.norm(pace, axis=1)
    near = place[:, :, None] + step[:, :, None] * np.arange(-reach, reach + 1)
    near = np.where(near > 0, near, place[:, :, None])[point, column]
    single = rays.select(point)
    if hypothesis is None:
        value, tilt = scores(single, near, images, scale, tilts)
    else:
        given = hypothesis[:, :used][known]
        value, tilt = _scores_of(single, near, images, scale, tilts, given)
    mean = value.mean(axis=2)
    best = mean.argmax(axis=1)
    pick = np.arange(len(point))
    # where a level shows nothing, chance must not move what a coarser one has found
    best = np.where(mean[pick, best] > mean[:, reach] + TELLING, best, reach)
    place, found = place.copy(), np.zeros(place.shape, dtype=np.int64)
    place[known] = near[pick, best]
    found[known] = tilt[pick, best]
    likely = np.full((*place.shape, value.shape[2]), -np.inf)
    likely[known] = value.max(axis=1)
    return place, found, likely


def _scores_of(
    rays: SeedRays,
    omega: FloatArray,
    images: tuple[NDArray[np.float32], NDArray[np.float32]],
    scale: int,
    tilts: FloatArray,
    hypothesis: IntArray,
) -> tuple[FloatArray, IntArray]:
    """Compare windows under no tilt and under one that is given for each."""
    value = np.full((*omega.shape, SHAPES), -np.inf)
    tilt = np.zeros(omega.shape, dtype=np.int64)
    for number in np.unique(hypothesis):
        rows = np.flatnonzero(hypothesis == number)
        tried = np.unique([0, number])
        value[rows], best = scores(rays.select(rows), omega[rows], images, scale, tilts[tried])
        tilt[rows] = tried[best]
    return value, tilt


def _decided(
    rays: SeedRays,
    place: FloatArray,
    tilt: FloatArray,
    levels: list[FloatArray],
    more: tuple[FloatArray, FloatArray],
) -> Places:
    """Choose size and shape by the evidence, and with them the best two places.

    What neighbours say beforehand (`more`, first) has a say in the choice, but is no evidence: on a
    pattern that repeats they all repeat the same guess. What further views show (second) is both.
    """
    used = place.shape[1]
    known = np.isfinite(place)
    point, _ = np.nonzero(known)
    seen = np.full((*place.shape, 2), np.nan)
    seen[known] = rays.second.project(rays.select(point).at(place[known]))
    sums = np.cumsum([level[:, :used] for level in levels], axis=0)
    sums = np.concatenate(list(sums), axis=2)  # (N, C, sizes x shapes)
    sums += more[1][:, :used, None]
    best = (sums + more[0][:, :used, None]).argmax(axis=1)
    rows = np.arange(len(place))[:, None]
    away = np.linalg.norm(seen[:, :, None, :] - seen[rows, best][:, None, :, :], axis=3) > APART_PX
    others = np.where(away, sums, -np.inf)
    second = others.argmax(axis=1)
    last = np.take_along_axis(others, second[:, None], axis=1)[:, 0]
    top = np.take_along_axis(sums, best[:, None], axis=1)[:, 0]
    # a window that explains nothing is what any other place must be compared with
    with np.errstate(invalid="ignore"):
        evidence = top - np.maximum(last, 0.0)
    evidence = np.where(np.isfinite(top), evidence, -np.inf)
    chosen = evidence.argmax(axis=1)
    row = np.arange(len(place))
    pair = np.stack([best[row, chosen], second[row, chosen]], axis=1)
    there = np.stack([np.isfinite(top[row, chosen]), np.isfinite(last[row, chosen])], axis=1)
    return Places(
        np.where(there, place[rows, pair], np.nan),
        tilt[rows, pair],
        chosen % levels[0].shape[2],
        evidence[row, chosen],
    )
