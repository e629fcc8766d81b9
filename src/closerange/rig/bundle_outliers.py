"""Blunders in a bundle: the tests of `outliers`, for all cameras and placements at once."""

from __future__ import annotations

import numpy as np

from closerange.geometry.arrays import BoolArray, FloatArray, IntArray
from closerange.rig.bundle import Bundle, BundleFit, Sightings, descend, fit_bundle, whitened
from closerange.rig.fit import inner_variance
from closerange.rig.outliers import HIDDEN, ROBUST_LIMIT, ROUNDING_PX, foretold, limit, snoop
from closerange.rig.view import whiten

EXCHANGES = 50
REWEIGHTINGS, STEPS_PER_REWEIGHTING, SETTLED = 15, 4, 0.01  # as for single cameras


def fit_bundle_without_blunders(
    seen: Sightings, start: Bundle, *, trials: int
) -> tuple[BundleFit, BoolArray]:
    """Adjust a bundle and leave out the points that contradict the others.

    In each round the worst point of each image is left out if its test fails, and points are
    taken back that the others foretell after all. One image's blunders hardly touch another's
    residuals, within an image they do: only its worst point is surely wrong.

    Parameters
    ----------
    seen : Sightings
        All points.
    start : Bundle
        Where to begin.
    trials : int
        Points tested in the whole calibration, over which the false alarm is shared.

    Returns
    -------
    BundleFit
        Of the points kept.
    ndarray of bool, shape (N,)
        The points that took part.

    Raises
    ------
    GeometryError
        If what is left cannot carry the parameters.
    """
    image = seen.camera * (int(seen.placement.max()) + 1) + seen.placement
    kept, fit = np.ones(len(seen), dtype=bool), fit_bundle(seen, start)
    square = np.sum(fit.whitened**2, axis=1)
    if fit.chi_square > HIDDEN**2 * fit.dof * inner_variance(square, fit.dof):
        kept = _sorted_robustly(seen, start)
        fit = fit_bundle(seen.select(kept), start)
    tried: set[bytes] = set()
    for _ in range(EXCHANGES):
        changed = _changed(seen, fit, kept, image, trials)
        if (changed == kept).all() or changed.tobytes() in tried:
            break
        tried.add(kept.tobytes())
        kept = changed
        fit = fit_bundle(seen.select(kept), fit.bundle)
    return fit, kept


def _changed(
    seen: Sightings, fit: BundleFit, kept: BoolArray, image: IntArray, trials: int
) -> BoolArray:
    """Take back what fits and leave out each image's worst point that does not."""
    changed = kept.copy()
    if not kept.all():
        test = foretold(fit, *whitened(fit.bundle, seen.select(~kept)))
        changed[np.flatnonzero(~kept)[test <= limit(fit.dof, trials)]] = True
    statistic = np.zeros(len(seen))
    statistic[kept] = snoop(fit)
    for number in np.unique(image[statistic > limit(fit.dof - 2, trials)]):
        own = np.flatnonzero(image == number)
        changed[own[np.argmax(statistic[own])]] = False
    return changed


def _sorted_robustly(seen: Sightings, start: Bundle) -> BoolArray:
    """Keep the points that a fit by reweighting (Geman-McClure) explains."""
    bundle, dof, last = start, seen.xy_px.size - start.count, 0.0
    unit = np.array([1.0, 0.0, 1.0]) if seen.whitener is None else seen.whitener
    square = _squares(seen, bundle)
    for _ in range(REWEIGHTINGS):
        variance = max(inner_variance(square, dof), ROUNDING_PX**2)
        if not np.isfinite(variance) or abs(variance - last) <= SETTLED * last:
            break
        last = variance
        # four variances: a Gaussian residual keeps most of its weight
        root = 1 / (1 + square / (4 * variance))
        again = seen.weighted(unit * root[:, None]).select(np.isfinite(square))
        bundle, _ = descend(again, bundle, max_iterations=STEPS_PER_REWEIGHTING)
        square = _squares(seen, bundle)
    variance = max(inner_variance(square, dof), ROUNDING_PX**2)
    return np.asarray(square <= ROBUST_LIMIT * variance)


def _squares(seen: Sightings, bundle: Bundle) -> FloatArray:
    """Squared whitened residuals; infinite where the bundle cannot project a point."""
    residual = bundle.residuals(seen).T
    white, _ = whiten(seen.whitener, residual, np.zeros((0, 2, len(seen))))
    square = np.sum(white**2, axis=0)
    return np.where(np.isfinite(square), square, np.inf)
