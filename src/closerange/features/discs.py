"""Discs in an image: centres, covariances and what may be wrong with them."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from closerange.errors import InputError
from closerange.features.blobs import Candidate
from closerange.features.borders import border_centroid, border_centroid_covariance
from closerange.features.disc_candidates import (
    DiscCandidates,
    find_candidates,
)
from closerange.features.disc_fit import DiscFit, fit_disc
from closerange.features.threshold import ThresholdReport
from closerange.flags import Flag
from closerange.geometry.arrays import FloatArray, IntArray, frozen_array, frozen_ints
from closerange.geometry.ellipse import Ellipse
from closerange.images.frame import Frame

ESTIMATORS = ("least-squares", "border-centroid")

# More than one pixel in a hundred at full scale: the exposure, not a hot pixel.
SATURATED_SHARE = 0.01
# An edge blur of half the disc's radius leaves no flat middle: size and contrast can no longer
# be told apart, and the ellipse becomes a guess (the centre stays good).
BLURRED_SHARE = 0.5
# Below five times the noise a pixel of the disc can be mistaken for background.
LOW_CONTRAST_SIGMAS = 5.0
# Residuals beyond twice the pixel-to-pixel noise AND 3 % of the contrast. Correlated noise (of
# demosaicing or compression) reaches 1.5. A grey level that is wrong by that share on one side
# moves the edge there by share x blur x sqrt(2 pi), the centre by half of it: 0.03 px in a lens in
# focus. An image of little noise shows what a Gaussian edge is not, up to 2 %: gamma, the square
# pixel under a sharp lens, the flat disc of a defocused one. That is the same on both sides of the
# disc and leaves the centre alone; a ghost, a stain or another shape leaves 5 % and more.
POOR_FIT_SIGMAS, POOR_FIT_SHARE = 2.0, 0.03
# A centre that ran away from its blob by half its radius (a pixel at least) is another thing's.
LOST_SHARE, LOST_PX = 0.5, 1.0
# The fit needs this much background between disc and image border.
BORDER_PX = 2.0


@dataclass(frozen=True, slots=True, eq=False)
class Discs:
    """The discs of one image, N rows from its top to its bottom.

    Attributes
    ----------
    xy_px : ndarray, shape (N, 2)
        Centres in px; where the fit failed (`not_converged` and `poor_fit`), the centroid of the
        blob's pixels.
    cov_px2 : ndarray, shape (N, 2, 2)
        Their covariance in px^2.
    noise_cov_px2 : ndarray, shape (N, 2, 2)
        The part of it that pixel noise alone makes: the scatter between images of a still scene;
        NaN from "border-centroid" and where the fit failed.
    ellipse : ndarray, shape (N, 3)
        Semi-axes a >= b in px, angle of the major axis from +x towards +y in rad, in
        (-pi/2, pi/2].
    blur_px : ndarray, shape (N,)
        Standard deviation of the edge blur; NaN from "border-centroid".
    contrast : ndarray, shape (N,)
        Grey values inside minus outside; negative for dark discs.
    noise : ndarray, shape (N,)
        Standard deviation of a pixel, grey values.
    residual : ndarray, shape (N,)
        Residual over the noise, near 1 where the model holds; infinite where the fit failed,
        NaN from "border-centroid".
    flags : ndarray of int, shape (N,)
        `Flag` bits.
    thresholds : ThresholdReport
        How the discs were separated from the background.
    strategy : str
        "global" or "local".
    """

    xy_px: FloatArray
    cov_px2: FloatArray
    noise_cov_px2: FloatArray
    ellipse: FloatArray
    blur_px: FloatArray
    contrast: FloatArray
    noise: FloatArray
    residual: FloatArray
    flags: IntArray
    thresholds: ThresholdReport
    strategy: str

    def __post_init__(self) -> None:
        count = len(self.flags)
        shapes: dict[str, tuple[int, ...]] = {
            "xy_px": (count, 2),
            "cov_px2": (count, 2, 2),
            "noise_cov_px2": (count, 2, 2),
            "ellipse": (count, 3),
            "blur_px": (count,),
            "contrast": (count,),
            "noise": (count,),
            "residual": (count,),
        }
        for name, shape in shapes.items():
            object.__setattr__(self, name, frozen_array(getattr(self, name), shape, name))
        object.__setattr__(self, "flags", frozen_ints(self.flags, (count,), "flags"))

    def __len__(self) -> int:
        return len(self.flags)


def find_discs(
    frame: Frame,
    *,
    polarity: str,
    estimator: str = "least-squares",
    strategy: str = "auto",
) -> Discs:
    """Find discs and measure their centres.

    Parameters
    ----------
    frame : Frame
        Image.
    polarity : {"white-on-dark", "dark-on-white"}
        Discs brighter or darker than their surroundings.
    estimator : {"least-squares", "border-centroid"}, optional
        "least-squares" fits the grey values around the edge, near the Cramer-Rao bound.
        "border-centroid" is the thesis' mean of border points (equation 2.7), which keeps the
        rounding to whole pixels: some 0.08 px.
    strategy : {"auto", "global", "local"}, optional
        How candidates are found; see `find_candidates`.

    Returns
    -------
    Discs
        One row per candidate. Doubtful ones are flagged, not left out.

    Raises
    ------
    InputError
        If an option is unknown.

    Notes
    -----
    The centre is that of the image ellipse as seen, neither lens nor perspective corrected.
    """
    if estimator not in ESTIMATORS:
        raise InputError(f"estimator {estimator!r}", remedy=f"use one of {', '.join(ESTIMATORS)}")
    found = find_candidates(frame, polarity=polarity, strategy=strategy)
    full_scale = saturation_level(frame)
    sign = 1.0 if polarity == "white-on-dark" else -1.0
    if estimator == "least-squares":
        fits = [_least_squares(frame, found, c, full_scale, sign) for c in found.candidates]
    else:
        fits = [_border_centroid(found, c, sign) for c in found.candidates]
    flags = [
        _flags(frame, candidate, fit, full_scale)
        for candidate, fit in zip(found.candidates, fits, strict=True)
    ]
    return Discs(
        xy_px=np.array([fit.xy_px for fit in fits]),
        cov_px2=np.array([fit.cov_px2 for fit in fits]).reshape(-1, 2, 2),
        noise_cov_px2=np.array([fit.noise_cov_px2 for fit in fits]).reshape(-1, 2, 2),
        ellipse=np.array([fit.ellipse for fit in fits]),
        blur_px=np.array([fit.blur_px for fit in fits]),
        contrast=np.array([fit.contrast for fit in fits]),
        noise=np.array([fit.noise for fit in fits]),
        residual=np.array([fit.reduced_residual for fit in fits]),
        flags=np.array(flags, dtype=np.int64),
        thresholds=found.thresholds,
        strategy=found.strategy,
    )


def saturation_level(frame: Frame) -> float:
    """Return the grey value at which the sensor clips.

    Parameters
    ----------
    frame : Frame
        Image.

    Returns
    -------
    float
        Full scale of the pixel type; in 16-bit images whose largest value is that of a 10-, 12-
        or 14-bit sensor (4095, or 65520 where its bits are shifted up), that value.
    """
    largest = int(frame.pixels.max()) if frame.pixels.size else 0
    if frame.pixels.dtype == np.uint16:
        for bits in (10, 12, 14):
            if largest in (2**bits - 1, (2**bits - 1) << (16 - bits)):
                return float(largest)
    return float(frame.full_scale)


def _least_squares(
    frame: Frame, found: DiscCandidates, candidate: Candidate, full_scale: float, sign: float
) -> DiscFit:
    """Fit the grey values; where that ends nowhere, fall back on the blob's centroid."""
    start = candidate.outline
    fit = fit_disc(frame.pixels, start, full_scale=full_scale, foreground=found.foreground)
    limit = max(LOST_PX, LOST_SHARE * start.axes[1])
    stayed = np.hypot(*(fit.xy_px - start.centre)) <= limit
    known = np.isfinite(fit.cov_px2).all() and fit.ellipse[0] <= start.axes[0] + 2 * limit
    if stayed and known and fit.converged:
        return fit
    # rounding moves a border more than an area: its covariance is on the safe side
    rough = _border_centroid(found, candidate, sign)
    return replace(
        rough, xy_px=start.centre, reduced_residual=np.inf, misfit=np.inf, converged=False
    )


def _border_centroid(found: DiscCandidates, candidate: Candidate, sign: float) -> DiscFit:
    """Mean of border points with the covariance of rounding."""
    return DiscFit(
        xy_px=border_centroid(candidate.border),
        cov_px2=border_centroid_covariance(candidate.border),
        noise_cov_px2=np.full((2, 2), np.nan),
        ellipse=candidate.outline.axes,
        blur_px=np.nan,
        contrast=sign * candidate.contrast,
        noise=found.noise,
        reduced_residual=np.nan,
        misfit=np.nan,
        converged=True,
    )


def _flags(frame: Frame, candidate: Candidate, fit: DiscFit, full_scale: float) -> Flag:
    """Collect what is wrong with one disc; comparisons with NaN are False."""
    contrast, residual = abs(fit.contrast), fit.reduced_residual
    defects = {
        Flag.at_border: candidate.at_border or _near_border(frame, fit),
        Flag.saturated: _saturated_share(frame, fit, full_scale) > SATURATED_SHARE,
        Flag.blurred: fit.blur_px > BLURRED_SHARE * fit.ellipse[1],
        Flag.low_contrast: contrast < LOW_CONTRAST_SIGMAS * fit.noise,
        Flag.poor_fit: residual > POOR_FIT_SIGMAS and fit.misfit > POOR_FIT_SHARE,
        Flag.not_converged: not fit.converged,
    }
    flag = Flag.none
    for name, defect in defects.items():
        flag |= name if defect else Flag.none
    return flag


def _half_sides(fit: DiscFit) -> FloatArray:
    """Half-width and half-height of the upright box around the ellipse."""
    a, b, angle = fit.ellipse
    cos, sin = np.cos(angle), np.sin(angle)
    return np.array([np.hypot(a * cos, b * sin), np.hypot(a * sin, b * cos)])


def _near_border(frame: Frame, fit: DiscFit) -> bool:
    reach = _half_sides(fit) + BORDER_PX
    last = np.array(frame.size_px) - 1
    return bool((fit.xy_px - reach < 0).any() or (fit.xy_px + reach > last).any())


def _saturated_share(frame: Frame, fit: DiscFit, full_scale: float) -> float:
    """Share of pixels at full scale in the disc and a rim of two pixels around it."""
    reach = _half_sides(fit) + BORDER_PX
    x0, y0 = np.maximum(np.floor(fit.xy_px - reach), 0).astype(int)
    x1, y1 = np.maximum(np.ceil(fit.xy_px + reach) + 1, 0).astype(int)
    window = frame.pixels[y0:y1, x0:x1]
    clipped = window >= full_scale
    if not clipped.any():
        return 0.0
    a, b, angle = fit.ellipse
    rows, columns = np.indices(window.shape)
    distance = Ellipse.of(fit.xy_px - (x0, y0), a, b, angle).signed_distance(
        np.stack([columns, rows], axis=-1)
    )
    return float(np.mean(clipped[distance <= BORDER_PX]))
