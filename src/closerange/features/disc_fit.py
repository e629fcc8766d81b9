"""Grey-level least-squares fit of one disc: its image ellipse and edge blur."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from closerange.features.disc_band import BAND_BLURS, Band, Crop
from closerange.features.disc_model import (
    BACKGROUND,
    CONTRAST,
    CONTRAST_SLOPES,
    blur_px,
    has_flat_middle,
    start_vector,
)
from closerange.features.disc_quality import centre_covariance, noise_and_misfit, noise_covariance
from closerange.geometry.arrays import BoolArray, FloatArray
from closerange.geometry.ellipse import Ellipse, axes_of_shape
from closerange.geometry.least_squares import LeastSquaresFit, levenberg_marquardt

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
    noise_cov_px2 : ndarray, shape (2, 2)
        The part of it that pixel noise alone makes: the scatter between images of a still scene.
    ellipse : tuple of float
        Semi-axes a >= b in px, angle of the major axis from +x towards +y in rad.
    blur_px : float
        Standard deviation of the Gaussian edge blur, the pixel's own width included.
    contrast : float
        Grey value inside minus outside; negative for a dark disc.
    noise : float
        Standard deviation of a pixel from differences of neighbours, root mean square of
        inside and outside.
    reduced_residual : float
        Root mean square residual divided by the noise, of outside, edge or inside where noise
        explains it least; near 1 where the model holds.
    misfit : float
        The same residual as a share of the contrast.
    converged : bool
        Whether the last pass reached its minimum.
    """

    xy_px: FloatArray
    cov_px2: FloatArray
    noise_cov_px2: FloatArray
    ellipse: tuple[float, float, float]
    blur_px: float
    contrast: float
    noise: float
    reduced_residual: float
    misfit: float
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
    crop = Crop.around(pixels, start, foreground)
    x = start_vector(start)
    variances: tuple[float, float] | None = None
    for _ in range(MAX_PASSES):
        chosen = crop.band(x, variances, full_scale)
        if chosen is None:
            return NOT_MEASURED
        band = chosen
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
        if settled or not (fit.converged or variances is None):
            break
        x = np.append(fit.x, np.zeros(x.size - fit.x.size))
        variances = band.variances_after(fit)
    return _result(fit, band, crop.origin, settled=settled)


def _moved(before: FloatArray, after: FloatArray) -> bool:
    """Whether the band of `before` was misplaced by half a pixel, or its width by that and 15 %."""
    size = [np.array(axes_of_shape(*x[2:5])[:2]) for x in (before, after)]
    shifts = np.append(after[:2] - before[:2], size[1] - size[0])
    blurs = blur_px(before), blur_px(after)
    wider = abs(blurs[1] - blurs[0])
    return bool((np.abs(shifts) > 0.5).any() or wider > max(0.15 * blurs[0], 0.5 / BAND_BLURS))


def _result(fit: LeastSquaresFit, band: Band, origin: FloatArray, *, settled: bool) -> DiscFit:
    """Turn the last pass into named results."""
    noise, misfit = noise_and_misfit(fit, band)
    return DiscFit(
        xy_px=origin + fit.x[:2],
        cov_px2=centre_covariance(fit, band),
        noise_cov_px2=noise_covariance(fit, band),
        ellipse=axes_of_shape(*fit.x[2:5]),
        blur_px=blur_px(fit.x),
        contrast=float(fit.x[CONTRAST]),
        noise=noise,
        reduced_residual=misfit.by_noise,
        misfit=misfit.by_contrast,
        converged=fit.converged and settled,
    )


_NAN2 = np.full((2, 2), np.nan)
NOT_MEASURED = DiscFit(
    _NAN2[0], _NAN2, _NAN2, (np.nan,) * 3, np.nan, np.nan, np.nan, np.nan, np.nan, converged=False
)
"""The answer where there is nothing to fit."""
