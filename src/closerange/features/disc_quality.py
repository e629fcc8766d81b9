"""What a fitted disc may claim: covariances of its centre, noise, and whether the model holds."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from closerange.features.disc_band import (
    FLAT_PIXELS,
    FLAT_SHARE,
    IMAGINED_PIXELS,
    QUANTISATION_DN2,
    Band,
)
from closerange.features.disc_model import CONTRAST, blur_px, density, outline_of
from closerange.geometry.arrays import BoolArray, FloatArray, IntArray
from closerange.geometry.ellipse import axes_of_shape
from closerange.geometry.least_squares import LeastSquaresFit

# Undulations of the outline shorter than this are damped by the blur and the pixels; with fewer
# degrees of freedom than this their variance is known to no better than a half.
ROUGHNESS_WAVE_PX, ROUGHNESS_DOF = 6.0, 8


@dataclass(frozen=True, slots=True)
class Misfit:
    """Root mean square residual where the model holds worst: outside, along the edge or inside."""

    by_noise: float
    by_contrast: float

    @property
    def beyond_noise(self) -> float:
        """What noise does not explain, as a share of the contrast."""
        return self.by_contrast * float(np.sqrt(1 - max(self.by_noise, 1.0) ** -2))


def noise_and_misfit(fit: LeastSquaresFit, band: Band) -> tuple[float, Misfit]:
    """Return the noise of a pixel, and the residuals of the zone that noise explains least.

    The weights learn from residuals, so they take a ghost, a stain or a wrong shape for noise.
    But those change little from pixel to pixel: the differences of neighbours show the noise.
    """
    kept, factor = band.counted(fit)
    outside, inside = band.inside < FLAT_SHARE, band.inside > 1 - FLAT_SHARE
    typical = [_from_neighbours(fit, band, kept & zone) for zone in (outside, inside)]
    scale = typical[0] + (typical[1] - typical[0]) * band.inside
    variances = np.array(band.variances_after(fit)) * np.square(typical)
    noise = np.sqrt(max(float(variances.mean()), QUANTISATION_DN2))
    by_noise = factor * (fit.residuals[:-1] / scale) ** 2
    contrast = max(abs(fit.x[CONTRAST]), float(np.sqrt(QUANTISATION_DN2)))  # flat images have none
    by_contrast = factor * (fit.residuals[:-1] * band.std / contrast) ** 2
    flat = [kept & side for side in (outside, inside) if _enough(kept & side)]
    edge = kept & ~np.any([~kept, *flat], axis=0)  # of a small disc all that is not background
    found = [
        Misfit(float(np.sqrt(by_noise[zone].mean())), float(np.sqrt(by_contrast[zone].mean())))
        for zone in (*flat, edge)
        if _enough(zone)
    ]
    return float(noise), max(found, key=lambda m: m.beyond_noise, default=Misfit(1.0, 0.0))


def _enough(zone: BoolArray) -> bool:
    return bool(np.count_nonzero(zone) >= FLAT_PIXELS)


def _from_neighbours(fit: LeastSquaresFit, band: Band, zone: BoolArray) -> float:
    """Noise from differences of neighbours in a row, in units of the assumed noise."""
    pairs = (np.diff(band.xy, axis=0) == (1, 0)).all(axis=1) & zone[1:] & zone[:-1]
    if np.count_nonzero(pairs) < FLAT_PIXELS:
        return 1.0
    steps = np.abs(np.diff(fit.residuals[:-1])[pairs])
    # The upper quartile (1.15 sigma of a normal) leaves out a ghost's own edge. 0.1: rounding to
    # grey values may leave no steps, and that is no infinite misfit.
    return max(float(np.quantile(steps, 0.75)) / (1.1503 * float(np.sqrt(2))), 0.1)


def centre_covariance(fit: LeastSquaresFit, band: Band) -> FloatArray:
    """Return the covariance of the centre: a rough outline moves it, the levels leave it open.

    With all other parameters known the edge alone moves the centre, and does so by the outline's
    roughness; what light and shape add to that comes from flat pixels, with their noise.
    """
    kept, factor = band.counted(fit)
    squares = fit.residuals[:-1][kept] ** 2
    # The weights' variances were floored by quantisation; the residuals may not undercut it.
    floor = QUANTISATION_DN2 / min(band.variances_after(fit))
    whole = fit.covariance()[:2, :2]
    rough = _outline_roughness(fit, band)
    if rough is None:
        mean = float(squares.mean()) if squares.size else 1.0
        return max(factor * mean, factor * _at_leverage(fit, squares, kept), floor) * whole
    by_centre = fit.jacobian[:, :2]
    information = by_centre.T @ by_centre
    if not (np.isfinite(whole).all() and np.linalg.det(information) > 0):
        return np.full((2, 2), np.inf)  # no contrast: nothing holds the centre
    edge = np.linalg.inv(information)
    return np.asarray(max(rough, floor) * edge + max(1.0, floor) * (whole - edge))


def noise_covariance(fit: LeastSquaresFit, band: Band) -> FloatArray:
    """Return the covariance of the centre from what differs between images of a still scene.

    Roughness of outline, print and light is the same in every image; the noise of pixels is not.
    The weights know both, so the noise of each pixel is carried through them to the centre.
    """
    covariance = fit.covariance()
    if not np.isfinite(covariance).all():
        return np.full((2, 2), np.nan)
    outside, inside = _white_variances(fit, band, covariance)
    std = np.sqrt(outside + (inside - outside) * band.inside) / band.std
    by_pixel = covariance[:2] @ fit.jacobian[:-1].T * std
    return np.asarray(by_pixel @ by_pixel.T)


def _white_variances(
    fit: LeastSquaresFit, band: Band, covariance: FloatArray
) -> tuple[float, float]:
    """Grey-value variance outside and inside, from differences of neighbours on flat ground.

    At the edge itself a rough outline would be taken for noise.
    """
    flat = band.counted(fit)[0] & ((band.inside < FLAT_SHARE) | (band.inside > 1 - FLAT_SHARE))
    first, second = _neighbours(band.xy, flat)
    squares = (np.diff(fit.residuals[:-1][[first, second]], axis=0)[0] * band.std[first]) ** 2
    # The fit has taken a part of the noise with it: residuals scatter by 1 - J (J'J)^-1 J'.
    moved = fit.jacobian[second] - fit.jacobian[first]
    share = 2 - ((moved @ covariance) * moved).sum(axis=1)
    within = band.inside[first] > 0.5
    sums = [(squares[side].sum(), share[side].sum()) for side in (~within, within)]
    if not sums[0][1] > 0:
        return np.nan, np.nan  # crowded: no flat ground around the disc
    # Small discs have few flat pixels inside, tiny ones none: then the noise is that outside.
    outside = sums[0][0] / sums[0][1]
    imagined = 2 * IMAGINED_PIXELS
    inside = (sums[1][0] + imagined * outside) / (sums[1][1] + imagined)
    return max(float(outside), QUANTISATION_DN2), max(float(inside), QUANTISATION_DN2)


def _neighbours(xy: FloatArray, chosen: BoolArray) -> tuple[IntArray, IntArray]:
    """Return the indices of chosen pixels, given row by row, that touch in a row or a column."""
    by_rows = np.flatnonzero(chosen)
    by_columns = by_rows[np.argsort(xy[by_rows, 0], kind="stable")]
    pairs = []
    for order in (by_rows, by_columns):
        touch = np.flatnonzero(np.abs(np.diff(xy[order], axis=0)).sum(axis=1) < 1.5)
        pairs.append((order[touch], order[touch + 1]))
    rows, columns = pairs
    return np.append(rows[0], columns[0]), np.append(rows[1], columns[1])


def _outline_roughness(fit: LeastSquaresFit, band: Band) -> float | None:
    """Variance of the outline's slow undulations, in units of what white noise makes.

    A shift of the centre is an undulation of order 1, which the fit absorbs as it does order 2.
    Neighbouring pixels of real images are correlated (demosaicing, compression, the lens), and
    then the orders that remain tell the variance of order 1 where single pixels tell too little.
    Orders faster than the blur lets through are left out; None if too few are left.
    """
    a, b, angle = axes_of_shape(*fit.x[2:5])
    highest = int(np.pi * (a + b) / ROUGHNESS_WAVE_PX)
    dof = 2 * (highest - 2)
    if dof < ROUGHNESS_DOF:
        return None
    distance = outline_of(fit.x).signed_distance(band.xy) / blur_px(fit.x)
    near = band.counted(fit)[0] & (np.abs(distance) < 3)  # clipped pixels know nothing
    x, y = (band.xy[near] - fit.x[:2]).T
    cos, sin = np.cos(angle), np.sin(angle)
    around = np.arctan2((cos * y - sin * x) / b, (cos * x + sin * y) / a)
    edge = density(distance[near]) / band.std[near]
    turning = np.exp(1j * around)
    wave = edge * turning**2
    power = 0.0
    for _ in range(3, highest + 1):
        wave = wave * turning
        both = wave @ fit.residuals[:-1][near]
        power += both.real**2 / np.sum(wave.real**2) + both.imag**2 / np.sum(wave.imag**2)
    # dof - 2: the inverse of a variance estimate is what weights use, and this is its mean
    return float(power / (dof - 2))


def _at_leverage(fit: LeastSquaresFit, squares: FloatArray, kept: BoolArray) -> float:
    """Mean squared residual, each pixel weighed by its say in the centre.

    On good images this is 1 as over all pixels; where the edge itself is rough, it tells.
    """
    covariance = fit.covariance()
    if not np.isfinite(covariance).all():
        return np.inf
    say = ((fit.jacobian[:-1][kept] @ covariance[:, :2]) ** 2).sum(axis=1)
    total = float(say.sum())
    return float(say @ squares) / total if 0 < total < np.inf else np.inf
