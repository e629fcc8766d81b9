"""Grey-level least-squares fit of one disc: its image ellipse and edge blur."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtr

from closerange.features.disc_model import (
    BACKGROUND,
    BLUR,
    CONTRAST,
    CONTRAST_SLOPES,
    LENS_LOG_STD,
    USUAL_LENS_PX,
    blur_px,
    density,
    grey_values,
    has_flat_middle,
    start_vector,
)
from closerange.geometry.arrays import BoolArray, FloatArray
from closerange.geometry.ellipse import Ellipse, axes_of_shape, distance_terms
from closerange.geometry.least_squares import LeastSquaresFit, levenberg_marquardt

# Half-width of the fitted band: within 3 sigma of blur the edge is complete to 0.1 % of the
# contrast; 2.5 px more of flat grey on either side fix the two levels and their slopes (within
# 10 % of the bound that all pixels would allow) and stay a small neighbourhood of the edge.
BAND_BLURS, BAND_FLAT_PX = 3.0, 2.5
# A pixel next to another feature is left out where that feature's own blur reaches it.
NEIGHBOUR_BLURS = 2.0
# Foreground this near to a disc's outline is its own edge.
OWN_EDGE_PX = 2.0
# Rounding to whole grey values: uniform over one of them.
QUANTISATION_DN2 = 1 / 12
# Share of the edge profile below which a pixel is flat, and how many flat pixels give a variance
# of their own (to a quarter of its value).
FLAT_SHARE, FLAT_PIXELS = 0.03, 30
IMAGINED_PIXELS = 2
# Undulations of the outline shorter than this are damped by the blur and the pixels; with fewer
# degrees of freedom than this their variance is known to no better than a half.
ROUGHNESS_WAVE_PX, ROUGHNESS_DOF = 6.0, 8
# What a last step could still gain, as a share of the cost: of a hundred pixels' residuals, 1e-6
# is a hundredth of a standard deviation. The first pass only places the band and the weights.
FIRST_GAIN_LIMIT, GAIN_LIMIT = 1e-4, 1e-6
MAX_PASSES = 4
MAX_ITERATIONS = 30


@dataclass(frozen=True, slots=True, eq=False)
class DiscFit:
    """What the fit of one disc found.

    Attributes
    ----------
    xy_px : ndarray, shape (2,)
        Centre of the image ellipse.
    cov_px2 : ndarray, shape (2, 2)
        Its covariance, scaled by the fit's own residuals.
    ellipse : tuple of float
        Semi-axes a >= b in px, angle of the major axis from +x towards +y in rad.
    blur_px : float
        Standard deviation of the Gaussian edge blur, the pixel's own width included.
    contrast : float
        Grey value inside minus outside; negative for a dark disc.
    noise : float
        Standard deviation of a pixel, root mean square of inside and outside.
    reduced_residual : float
        Residual across the edge, divided by the noise; near 1 where the model holds.
    converged : bool
        Whether the last pass reached its minimum.
    """

    xy_px: FloatArray
    cov_px2: FloatArray
    ellipse: tuple[float, float, float]
    blur_px: float
    contrast: float
    noise: float
    reduced_residual: float
    converged: bool


def fit_disc(
    pixels: NDArray[Any],
    start: Ellipse,
    *,
    full_scale: float = np.inf,
    foreground: BoolArray | None = None,
) -> DiscFit:
    """Fit the grey values of a disc with a blurred ellipse.

    Parameters
    ----------
    pixels : ndarray, shape (H, W)
        Grey values.
    start : Ellipse
        Approximate outline in px, good to about a pixel.
    full_scale : float, optional
        Grey value at which the sensor clips.
    foreground : ndarray of bool, shape (H, W), optional
        Pixels of this and other features. What lies within two pixels of the start's outline is
        the disc's own; from the rest the band stays away by its blur, but never by more than
        half of the gap.

    Returns
    -------
    DiscFit
        All values NaN and `converged` False if there are not enough pixels.

    Notes
    -----
    Model: ``background plane + contrast * Phi(-d / blur)`` with the signed distance d of
    `Ellipse.signed_distance`; large discs have a contrast with slopes of its own, for light
    that varies across them. Clipping is modelled as the sensor does it: a pixel's expected
    value is that of min(value + noise, full scale), so that clipped pixels neither pull nor
    bias, and they do not count in the residual variance. Weights come from the variances that
    the previous pass left inside and outside (shot noise differs); quantisation is their floor.
    """
    crop = _Crop.around(pixels, start, foreground)
    x = start_vector(start)
    variances: tuple[float, float] | None = None
    result = NOT_MEASURED
    for _ in range(MAX_PASSES):
        band = crop.band(x, variances, full_scale)
        if band is None:
            return NOT_MEASURED
        if variances is None:
            x[BACKGROUND], x[CONTRAST] = band.levels()
        free = x if has_flat_middle(x) else x[:CONTRAST_SLOPES]
        limit = FIRST_GAIN_LIMIT if variances is None else GAIN_LIMIT
        fit = levenberg_marquardt(
            band.residuals, free, max_iterations=MAX_ITERATIONS, gain_limit=limit
        )
        if not np.isfinite(fit.cost):
            return NOT_MEASURED
        # Settled: with weights from residuals, on a band that lies where the disc really is.
        settled = variances is not None and not _moved(x, fit.x)
        result = _result(fit, band, crop.origin, settled=settled)
        if settled or not (fit.converged or variances is None):
            break
        x = np.append(fit.x, np.zeros(x.size - fit.x.size))
        variances = band.variances_after(fit)
    return result


@dataclass(frozen=True, slots=True, eq=False)
class _Crop:
    """The surroundings of a disc, wide enough for any band that makes sense."""

    origin: FloatArray
    xy: FloatArray
    values: FloatArray
    to_other: FloatArray

    @classmethod
    def around(cls, pixels: NDArray[Any], start: Ellipse, foreground: BoolArray | None) -> _Crop:
        """Cut out the disc and as much again around it, eight pixels at least."""
        a, _, _ = start.axes
        reach = a + max(a, 8.0)
        first = np.maximum(np.floor(start.centre - reach), 0).astype(int)
        last = np.maximum(np.ceil(start.centre + reach) + 1, first).astype(int)
        window = (slice(first[1], last[1]), slice(first[0], last[0]))
        values = pixels[window].astype(np.float64)
        rows, columns = np.indices(values.shape)
        xy = np.stack([columns + first[0], rows + first[1]], axis=-1) - start.centre
        to_other = np.full(values.size, np.inf)
        if foreground is not None:
            own = start.signed_distance(xy + start.centre) < OWN_EDGE_PX
            free = (~foreground[window] | own).astype(np.uint8)
            if not free.all():
                distances = cv2.distanceTransform(free, cv2.DIST_L2, cv2.DIST_MASK_5)
                to_other = distances.astype(np.float64).ravel()
        return cls(np.asarray(start.centre), xy.reshape(-1, 2), values.ravel(), to_other)

    def band(
        self, x: FloatArray, variances: tuple[float, float] | None, full_scale: float
    ) -> _Band | None:
        """Choose the pixels along the edge; None if they cannot carry the parameters."""
        distance = distance_terms(x[:5], self.xy)[0]
        blur = blur_px(x)
        at_edge = np.abs(distance) < 1
        gap = float(self.to_other[at_edge].min()) if at_edge.any() else 0.0
        chosen = np.abs(distance) <= BAND_BLURS * blur + BAND_FLAT_PX
        chosen &= self.to_other > min(NEIGHBOUR_BLURS * blur, gap / 2)
        if np.count_nonzero(chosen) <= x.size:
            return None
        xy, values, distance = self.xy[chosen], self.values[chosen], distance[chosen]
        inside = ndtr(-distance / blur)
        if variances is None:
            variances = _first_variances(values, inside)
        variance = variances[0] + (variances[1] - variances[0]) * inside
        clips = bool((values >= full_scale).any())
        return _Band(xy, values, inside, np.sqrt(variance), full_scale if clips else np.inf)


@dataclass(frozen=True, slots=True, eq=False)
class _Band:
    """Pixels of one pass, with the share of the disc in each and their standard deviations."""

    xy: FloatArray
    values: FloatArray
    inside: FloatArray
    std: FloatArray
    full_scale: float

    def levels(self) -> tuple[float, float]:
        """Guess background and contrast from the pixels that are most outside and inside."""
        low, high = np.quantile(self.inside, (0.25, 0.75))
        background = float(np.median(self.values[self.inside <= low]))
        return background, float(np.median(self.values[self.inside >= high])) - background

    def residuals(self, x: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Weighted residuals and Jacobian; the last row is the lens' usual blur."""
        model, jacobian = grey_values(x, self.xy)
        if np.isfinite(self.full_scale):
            # E[min(value + noise, full scale)] and its slope
            excess = (model - self.full_scale) / self.std
            unclipped = ndtr(-excess)
            model = model - self.std * (excess * (1 - unclipped) + density(excess))
            jacobian = jacobian * unclipped[:, None]
        rows = np.zeros((x.size, len(model) + 1))
        rows[:, :-1] = jacobian.T / self.std
        rows[BLUR, -1] = 1 / LENS_LOG_STD
        usual = (x[BLUR] - np.log(USUAL_LENS_PX)) / LENS_LOG_STD
        return np.append((model - self.values) / self.std, usual), rows.T

    def counted(self, fit: LeastSquaresFit) -> tuple[BoolArray, float]:
        """Return which pixels tell about noise, and the factor for the fitted parameters."""
        kept = np.ones(len(self.values), dtype=bool)
        if np.isfinite(self.full_scale):
            kept = grey_values(fit.x, self.xy)[0] < self.full_scale - 2 * self.std
        number = int(np.count_nonzero(kept))
        return kept, number / max(number + 1 - fit.x.size, 1)

    def variances_after(self, fit: LeastSquaresFit) -> tuple[float, float]:
        """Grey-value variance outside and inside, from the residuals where the disc is flat."""
        kept, factor = self.counted(fit)
        squares = factor * (fit.residuals[:-1] * self.std) ** 2
        mixed: FloatArray | None = None
        found = []
        for side, flat in enumerate((self.inside < FLAT_SHARE, self.inside > 1 - FLAT_SHARE)):
            chosen = squares[flat & kept]
            if chosen.size >= FLAT_PIXELS:
                found.append(float(chosen.mean()))
                continue
            if mixed is None:
                mixed = self._mixed_variances(squares, kept)
            found.append(float(mixed[side]))
        return max(found[0], QUANTISATION_DN2), max(found[1], QUANTISATION_DN2)

    def _mixed_variances(self, squares: FloatArray, kept: BoolArray) -> FloatArray:
        """Variances outside and inside of a small disc, from all pixels by their share of it."""
        weight = 1 / self.std[kept] ** 2
        shares = np.column_stack([1 - self.inside[kept], self.inside[kept]]) * weight[:, None]
        # A dozen pixels can drive one variance to zero or below; a few imagined pixels of the
        # mean variance on either side keep the weights sane.
        mean = float(squares[kept].mean()) if kept.any() else QUANTISATION_DN2
        imagined = np.sqrt(IMAGINED_PIXELS) / mean
        rows = np.vstack([shares, imagined * np.eye(2)])
        right = np.append(squares[kept] * weight, [imagined * mean] * 2)
        variances = np.linalg.lstsq(rows, right, rcond=None)[0]
        return np.asarray(np.maximum(variances, 0.1 * mean))


def _first_variances(values: FloatArray, inside: FloatArray) -> tuple[float, float]:
    """Robust variances of the flat sides: weights for the first pass only."""
    found = []
    for flat in (inside < FLAT_SHARE, inside > 1 - FLAT_SHARE):
        chosen = values[flat]
        if chosen.size < FLAT_PIXELS:
            continue
        deviation = float(np.median(np.abs(chosen - np.median(chosen))))
        found.append(max((1.4826 * deviation) ** 2, QUANTISATION_DN2))
    return (found[0], found[-1]) if found else (1.0, 1.0)


def _moved(before: FloatArray, after: FloatArray) -> bool:
    """Whether the band of `before` was misplaced by half a pixel, or its width by 15 %."""
    size = [np.array(axes_of_shape(*x[2:5])[:2]) for x in (before, after)]
    shifts = np.append(after[:2] - before[:2], size[1] - size[0])
    return bool((np.abs(shifts) > 0.5).any() or abs(blur_px(after) / blur_px(before) - 1) > 0.15)


def _result(fit: LeastSquaresFit, band: _Band, origin: FloatArray, *, settled: bool) -> DiscFit:
    """Turn the last pass into named results."""
    kept, factor = band.counted(fit)
    squares = fit.residuals[:-1][kept] ** 2
    edge = np.abs(band.inside[kept] - 0.5) < 0.5 - FLAT_SHARE
    variances = band.variances_after(fit)
    # The weights' variances were floored by quantisation; the residuals may not undercut it.
    floor = QUANTISATION_DN2 / min(variances)
    reduced = max(
        factor * _at_leverage(fit, squares, kept),
        factor * float(squares.mean()) if squares.size else 1.0,
        floor,
    )
    return DiscFit(
        xy_px=origin + fit.x[:2],
        cov_px2=_centre_covariance(fit, band, reduced, floor),
        ellipse=axes_of_shape(*fit.x[2:5]),
        blur_px=blur_px(fit.x),
        contrast=float(fit.x[CONTRAST]),
        noise=float(np.sqrt(np.mean(variances))),
        reduced_residual=float(np.sqrt(factor * squares[edge].mean())) if edge.any() else 1.0,
        converged=fit.converged and settled,
    )


def _centre_covariance(
    fit: LeastSquaresFit, band: _Band, reduced: float, floor: float
) -> FloatArray:
    """Covariance of the centre: what a rough outline moves, and what the levels leave open.

    With all other parameters known the edge alone moves the centre, and does so by the outline's
    roughness; what light and shape add to that comes from flat pixels, with their noise.
    """
    whole = fit.covariance()[:2, :2]
    rough = _outline_roughness(fit, band)
    if rough is None:
        return reduced * whole
    by_centre = fit.jacobian[:, :2]
    information = by_centre.T @ by_centre
    if not (np.isfinite(whole).all() and np.linalg.det(information) > 0):
        return np.full((2, 2), np.inf)  # no contrast: nothing holds the centre
    edge = np.linalg.inv(information)
    return np.asarray(max(rough, floor) * edge + max(1.0, floor) * (whole - edge))


def _outline_roughness(fit: LeastSquaresFit, band: _Band) -> float | None:
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
    x, y = (band.xy - fit.x[:2]).T
    cos, sin = np.cos(angle), np.sin(angle)
    around = np.arctan2((cos * y - sin * x) / b, (cos * x + sin * y) / a)
    distance = distance_terms(fit.x[:5], band.xy)[0]
    edge = density(distance / blur_px(fit.x)) / band.std
    edge = edge * band.counted(fit)[0]  # clipped pixels know nothing
    order = np.arange(3, highest + 1)[:, None]
    waves = edge * np.concatenate([np.cos(order * around), np.sin(order * around)])
    power = (waves @ fit.residuals[:-1]) ** 2 / np.sum(waves**2, axis=1)
    # dof - 2: the inverse of a variance estimate is what weights use, and this is its mean
    return float(power.sum() / (dof - 2))


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


_NAN2 = np.full(2, np.nan)
NOT_MEASURED = DiscFit(
    _NAN2, np.full((2, 2), np.nan), (np.nan,) * 3, np.nan, np.nan, np.nan, np.nan, converged=False
)
"""The answer where there is nothing to fit."""
