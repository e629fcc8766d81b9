"""Sub-pixel match of windows: Gauss-Newton over place, tilt, gain and offset."""

from __future__ import annotations

from dataclasses import dataclass, fields, replace

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import map_coordinates

from closerange.geometry.arrays import BoolArray, FloatArray, IntArray
from closerange.matching.window_images import Level
from closerange.matching.window_information import SIGMA_SHARE
from closerange.matching.window_mapping import WindowMapping
from closerange.matching.window_planes import TILT, SeedRays
from closerange.matching.window_scores import INDEPENDENT, LEAST_MISFIT, shape_weights
from closerange.matching.window_system import (
    GREY_VARIANCE,
    Samples,
    System,
    gain_and_offset,
    inverse_covariance,
    noise_part,
    right_side,
    shift_std,
    spread,
    squares,
)

GROSS = 2.5
"""Residual, in standard deviations, at which a pixel has a quarter of its weight left."""

ROUNDS = 12
"""Steps of Gauss-Newton; six are enough from half a pixel away."""

LONGEST_PX = 0.8
"""Longest step, px of the level: the grey values are linear no further."""

SETTLED_PX = 0.1
"""A step below it shows that the match is near."""

LEAST_SHIFT_PX = 0.1
"""Residuals that a shift of so many px makes are not gross: what the lens and the surface do to an
edge differs by as much from view to view."""

STILL_PX = 0.01
"""A step below it ends the iteration; the next one is shorter by far."""

STILL_SHARE = 0.1
"""So does a step of this share of the standard deviation, where the texture is weak."""

DONE_PX = 0.05
"""A last step longer than that is no end."""


MODEL_PX = 0.005
"""Standard deviation that interpolation leaves in each match, px of the level: measured on
noiseless textures with grains of one to three pixels, 0.0025 to 0.008."""


CORE_PX = 2
"""Pixels on each side that are the point itself: five by five are enough for a mean."""

PLAIN = 4.0
"""Squared derivatives per squared noise below which these cannot tell: noise alone makes 1."""

LEAST_SEEN = 0.3
"""Share of a window that both images must show for any fit."""

MOST_PIXELS = 1_000_000
"""Pixels of all windows that are worked on at once."""


@dataclass(frozen=True, slots=True, eq=False)
class Refined:
    """Refined matches of N windows.

    Attributes
    ----------
    omega : ndarray, shape (N,)
        Inverse depth at the seed; NaN where the fit failed.
    std_px : ndarray, shape (N,)
        Standard deviation along the epipolar curve.
    across_px : ndarray, shape (N,)
        How far beside the epipolar curve the window was found, to its right with y down.
    misfit_px : ndarray, shape (N,)
        Residual beyond the noise, as a shift of each pixel that would cause as much.
    likely : ndarray, shape (N,)
        Logarithm of the likelihood against a window that explains nothing.
    converged : ndarray of bool, shape (N,)
        Whether the last step was short.
    inside : ndarray, shape (N,)
        Share of the window that both images show.
    support : ndarray, shape (N,)
        Share of the window's information that was not let go as gross, or of the weight of the
        pixels next to the point, whichever is less.
    """

    omega: FloatArray
    std_px: FloatArray
    across_px: FloatArray
    misfit_px: FloatArray
    likely: FloatArray
    converged: BoolArray
    inside: FloatArray
    support: FloatArray

    @classmethod
    def empty(cls, count: int) -> Refined:
        """Return so many failed fits; arrays may be filled in."""
        values = {item.name: np.full(count, np.nan) for item in fields(cls)}
        values["converged"] = np.zeros(count, dtype=bool)
        return cls(**values)

    def put(self, rows: IntArray, part: Refined) -> None:
        """Fill in rows."""
        for item in fields(self):
            getattr(self, item.name)[rows] = getattr(part, item.name)


@dataclass(slots=True, eq=False)
class _State:
    """What the iteration changes; one row for each window."""

    omega: FloatArray
    slope: FloatArray
    turned: FloatArray
    gain: FloatArray
    offset: FloatArray
    across: FloatArray
    last: FloatArray
    still: FloatArray


def refine_windows(
    rays: SeedRays,
    start: tuple[FloatArray, FloatArray],
    shape: IntArray,
    size: tuple[int, int],
    level: Level,
    epipolar_px: float,
) -> Refined:
    """Refine matches of windows of one size.

    Minimises the weighted squared difference between the second image, sampled through a plane of
    the world, and the first one after a change of gain and offset. Unknown are the place on the
    ray, the tilt of the plane and a shift beside the epipolar curve. The tilt is held near its
    start as loosely as surfaces may be tilted, the shift near zero as the calibration is good: both
    have a say only where the window tells them, and what it does not tell counts in the
    uncertainty. Pixels that do not belong to the plane lose their weight.

    Parameters
    ----------
    rays : SeedRays
        N seeds.
    start : tuple of two ndarrays
        Inverse depths, shape (N,), and tangents of the tilts, shape (N, 2).
    shape : ndarray of int, shape (N,)
        Number of the weights in `shape_weights`.
    size : tuple of int
        Half-width in pixels of the level, and how many times the level is smaller.
    level : Level
        Images.
    epipolar_px : float
        Standard deviation of the epipolar curves, which the calibration leaves.

    Returns
    -------
    Refined
        One row for each seed.
    """
    result = Refined.empty(len(rays))
    half_width, scale = size
    step = max(MOST_PIXELS // (2 * half_width + 1) ** 2, 1)
    usable = np.flatnonzero(np.isfinite(start[0]) & (start[0] > 0))
    for first in range(0, len(usable), step):
        rows = usable[first : first + step]
        mapping = WindowMapping.of(rays.select(rows), half_width, scale)
        weights = shape_weights(mapping.offset.astype(np.float64), SIGMA_SHARE * half_width)
        begun = start[0][rows], start[1][rows]
        result.put(rows, _Fit(mapping, weights[shape[rows]], level, begun, epipolar_px).run())
    return result


class _Fit:
    """One chunk of windows of one size."""

    def __init__(
        self,
        mapping: WindowMapping,
        weight: FloatArray,
        level: Level,
        start: tuple[FloatArray, FloatArray],
        epipolar_px: float,
    ) -> None:
        omega, tilt = start
        self.beside_precision = epipolar_px**-2
        x, y = (mapping.offset * float(mapping.scale)).T
        self.place = np.stack([np.ones_like(x), x, y, x * x, x * y, y * y], 1).astype(np.float32)
        self.mapping, self.level, self.weight = mapping, level, weight.astype(np.float32)
        rays = mapping.rays
        pace = rays.pace(omega)
        self.pace = np.linalg.norm(pace, axis=1)
        along = pace / self.pace[:, None]
        self.beside = np.column_stack([-along[:, 1], along[:, 0]])
        base = rays.slope(omega, tilt)
        unit = [rays.slope(omega, tilt + TILT * one) - base for one in np.eye(2)]
        tilts = np.stack(unit, axis=2) * self.pace[:, None, None]  # px per px, per hypothesis
        self.loose = tilts @ tilts.transpose(0, 2, 1)
        height, width = level.grey.shape
        pixel = mapping.corner[:, None, :] + mapping.offset
        self.inside = np.asarray(((pixel >= 0) & (pixel < [width, height])).all(axis=2))
        x, y = np.clip(pixel, 0, [width - 1, height - 1]).transpose(2, 0, 1)
        grey = level.grey[y, x]
        # in the middle of its window, so that float32 is fine enough for 16 bits
        self.grey = grey - grey.mean(axis=1, keepdims=True)
        self.slopes = level.slope_x[y, x], level.slope_y[y, x]
        self.steepness = np.hypot(*self.slopes)
        count = len(omega)
        self.state = _State(
            omega=omega.copy(),
            slope=base,
            turned=np.zeros((count, 2)),
            gain=np.ones(count),
            offset=np.zeros(count),
            across=np.zeros(count),
            last=np.full(count, np.inf),
            still=np.zeros(count),
        )

    def run(self) -> Refined:
        """Iterate, then judge."""
        state = self.state
        active = np.arange(len(state.omega))
        for turn in range(ROUNDS):
            self._step(active, with_gain=turn == 0)
            still = np.maximum(STILL_PX * self.mapping.scale, state.still[active])
            active = active[state.last[active] > still]
            if not active.size:
                break
        return self._judged()

    def _sampled(self, rows: IntArray) -> Samples:
        """Sample the second image, and how it changes with shifts along and across the curve."""
        mapping, state = self.mapping.select(rows), self.state
        beside = self.beside[rows]
        place, back, side = mapping.apply(
            state.omega[rows], state.slope[rows], self.pace[rows], beside
        )
        moved = state.across[rows, None] * beside / mapping.scale
        x, y = (place[:, k] + moved[:, k, None].astype(np.float32) for k in (0, 1))
        height, width = self.level.spline.shape
        good = (x >= 1) & (x <= width - 2) & (y >= 1) & (y <= height - 2) & self.inside[rows]
        good &= np.isfinite(back[:, 0])
        x, y = np.where(good, x, np.float32(0.0)), np.where(good, y, np.float32(0.0))
        values = map_coordinates(
            self.level.spline, (y, x), order=3, mode="mirror", prefilter=False, output=np.float32
        )
        slope_x, slope_y = self.slopes[0][rows], self.slopes[1][rows]
        along, across = (
            np.where(good, slope_x * step[:, 0] + slope_y * step[:, 1], np.float32(0.0))
            for step in (back, side)
        )
        middle = back.shape[2] // 2
        steps = np.stack([back[:, :, middle], side[:, :, middle]], axis=2)
        weight = np.where(good, self.weight[rows], np.float32(0.0))
        return Samples(values, along, across, weight, np.nan_to_num(steps.astype(np.float64)))

    def _step(self, rows: IntArray, *, with_gain: bool) -> None:
        state = self.state
        sampled = self._sampled(rows)
        if with_gain:
            state.gain[rows], state.offset[rows] = gain_and_offset(
                self.grey[rows], sampled.values, sampled.weight
            )
        system = self._system(rows, sampled)
        inverse = np.linalg.inv(system.normal)
        move = (inverse @ system.right[:, :, None])[:, :, 0]
        limit = LONGEST_PX * self.mapping.scale
        shift = np.clip(move[:, 0], -limit, limit)
        # a limited step keeps its direction
        move *= (np.abs(shift) / np.maximum(np.abs(move[:, 0]), 1e-12))[:, None]
        move[:, 0] = shift
        state.omega[rows] += shift / self.pace[rows]
        state.slope[rows] += move[:, 1:3] / self.pace[rows, None]
        state.turned[rows] += move[:, 1:3]
        state.gain[rows] = np.clip(state.gain[rows] + move[:, 3], 0.05, 20.0)
        state.offset[rows] += move[:, 4]
        state.across[rows] += move[:, 5]
        # a turn of the plane moves the rim of the window, at one sigma, while its middle stays
        rim = SIGMA_SHARE * self.mapping.offset[-1, 0] * self.mapping.scale
        state.last[rows] = np.abs(shift) + rim * np.linalg.norm(move[:, 1:3], axis=1)
        state.still[rows] = STILL_SHARE * system.spread * np.sqrt(np.maximum(inverse[:, 0, 0], 0.0))

    def _system(self, rows: IntArray, sampled: Samples) -> System:
        """Return the normal equations."""
        state, weight = self.state, sampled.weight
        grey, gain = self.grey[rows], state.gain[rows, None].astype(np.float32)
        error = sampled.values - gain * grey - state.offset[rows, None].astype(np.float32)
        usual = spread(error, weight)
        # at a steep edge a small shift makes a large residual, and that is what is to be found
        gross = GROSS * np.hypot(usual[:, None].astype(np.float32), self._shifted(rows) * gain)
        trust = weight / (1 + (error / gross) ** 2) ** 2
        along, across = gain * sampled.along, gain * sampled.across
        normal = squares(trust, along, grey, across, self.place)
        # both images being equally noisy; far from the match the residuals are no noise
        settled = state.last[rows] < SETTLED_PX * self.mapping.scale
        noise = usual**2 * gain[:, 0] ** 2 / (1 + gain[:, 0] ** 2) * settled
        normal -= noise_part(normal, trust, noise, sampled.steps, self.place)
        prior = self._prior(rows) * usual[:, None, None] ** 2
        normal += prior
        normal += 1e-9 * np.eye(6) * np.trace(normal, axis1=1, axis2=2)[:, None, None]
        parts = (along, grey, across, self.place, trust, error, prior, weight, usual, gross)
        system = System(normal, np.empty(0), *parts)
        right = right_side(system)
        right[:, 1:3] -= np.einsum("nij,nj->ni", prior[:, 1:3, 1:3], state.turned[rows])
        right[:, 5] -= prior[:, 5, 5] * state.across[rows]
        return replace(system, right=right)

    def _prior(self, rows: IntArray) -> FloatArray:
        """Return what is known beforehand of tilt and shift beside the curve, shape (N, 6, 6)."""
        prior = np.zeros((len(rows), 6, 6))
        prior[:, 1:3, 1:3] = inverse_covariance(self.loose[rows])
        prior[:, 5, 5] = self.beside_precision
        return prior

    def _shifted(self, rows: IntArray) -> NDArray[np.float32]:
        """Return the residuals that a shift as large as the last step would make."""
        last = np.clip(self.state.last[rows] / self.mapping.scale, LEAST_SHIFT_PX, 1.0)
        slope = self.steepness[rows]
        return np.asarray(slope * last[:, None].astype(np.float32))

    def _judged(self) -> Refined:
        state, scale = self.state, self.mapping.scale
        rows = np.arange(len(state.omega))
        sampled = self._sampled(rows)
        system = self._system(rows, sampled)
        misfit, support = self._fit(system)
        seen = sampled.weight.sum(axis=1) / self.weight.sum(axis=1)
        failed = ~np.isfinite(state.omega) | (state.omega <= 0) | (seen < LEAST_SEEN)
        std = np.hypot(shift_std(system), MODEL_PX * scale)
        return Refined(
            omega=np.where(failed, np.nan, state.omega),
            std_px=np.where(failed, np.nan, std),
            across_px=np.where(failed, np.nan, state.across),
            misfit_px=np.where(failed, np.nan, misfit),
            likely=np.where(failed, 0.0, _likely(sampled, system.error)),
            converged=(state.last < DONE_PX * scale) & ~failed,
            inside=seen,
            support=np.where(failed, 0.0, np.nan_to_num(support)),
        )

    def _fit(self, system: System) -> tuple[FloatArray, FloatArray]:
        """Return misfit, px, and the share of information, or of the core, that supports it."""
        trust = system.trust
        mass = np.maximum(trust.sum(axis=1), 1e-12)
        count = mass**2 / np.maximum((trust**2).sum(axis=1), 1e-12)
        variance = np.einsum("np,np->n", trust, system.error**2) / mass
        variance = np.maximum(variance * count / np.maximum(count - 6, 1.0), GREY_VARIANCE)
        # of a shift in any direction: an edge along the curve is steep only across it
        both = system.along**2 + system.across**2
        steep = np.einsum("np,np->n", trust, both)
        excess = np.maximum(variance - self._noise(np.arange(len(variance))), 0.0)
        # the point itself must lie on the plane too, not only most of what surrounds it
        core = np.flatnonzero(np.abs(self.mapping.offset).max(axis=1) <= CORE_PX)
        plain = both[:, core].mean(axis=1) < PLAIN * system.spread**2
        with np.errstate(divide="ignore", invalid="ignore"):
            misfit = np.sqrt(excess * mass / steep)
            support = steep / np.einsum("np,np->n", system.weight, both)
            own = trust[:, core].sum(axis=1) / system.weight[:, core].sum(axis=1)
        return misfit, np.where(plain, support, np.minimum(support, own))

    def _noise(self, rows: IntArray) -> FloatArray:
        """Return the variance of the difference that the noise of both images causes."""
        x, y = self.mapping.corner.T
        first, second = self.level.noise
        height, width = first.shape
        here = first[np.clip(y, 0, height - 1), np.clip(x, 0, width - 1)]
        mapping, state = self.mapping, self.state
        place = mapping.rays.second.project(mapping.rays.at(state.omega[rows])) / mapping.scale
        height, width = second.shape
        u, v = np.clip(np.nan_to_num(np.rint(place)), 0, [width - 1, height - 1]).astype(int).T
        return np.asarray((state.gain[rows] * here) ** 2 + second[v, u] ** 2)


def _likely(sampled: Samples, error: FloatArray) -> FloatArray:
    """Return the logarithm of the likelihood against a window that explains nothing."""
    weight, values = sampled.weight, sampled.values
    total = np.maximum(weight.sum(axis=1), 1e-12)
    left = np.einsum("np,np->n", weight, error**2) / total
    mean = np.einsum("np,np->n", weight, values) / total
    contrast = np.einsum("np,np->n", weight, (values - mean[:, None]) ** 2) / total
    share = np.clip(left / np.maximum(contrast, 1e-12), LEAST_MISFIT, 1.0)
    independent = INDEPENDENT * total**2 / np.maximum((weight**2).sum(axis=1), 1e-12)
    return np.asarray(-0.5 * independent * np.log(share))
