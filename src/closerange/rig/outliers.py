"""Blunders: found by data snooping, left out of the fit, kept in the residuals and explained.

A point is tested with the residual it has when it takes no part in the fit, against the noise of
the other points (Baarda's data snooping, 1968, with the variance estimated).
Many blunders at once inflate that noise and hide each other, and a far one bends the lens until
no residual is left. A fit that hints at blunders is therefore not asked which they are: it is done
again from the points that most others agree with, and takes back those that these foretell.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TypeAlias

import numpy as np

from closerange.errors import GeometryError
from closerange.geometry.arrays import BoolArray, FloatArray
from closerange.rig.camera import Camera
from closerange.rig.camera_fit import CameraFit, fit_camera
from closerange.rig.fit import Fit, inner_variance
from closerange.rig.view import View, whiten

FALSE_ALARM = 0.01
"""Chance that a calibration of clean Gaussian data loses any point; shared by all its points."""

HIDDEN = 1.3
"""Noise of the fit over noise of its better half that calls for a robust fit. One
in seventy clean views of 27 points exceeds it; a wrong alarm costs time only, the test decides."""

ROBUST_LIMIT = 13.8
"""Squared residual over variance (two coordinates) beyond which the robust fit sets a point aside
for the test: chance 1 in 1000, -2 ln 0.001."""

MAX_SHARE = 0.5
"""More than half of a camera's points cannot be blunders: nothing says which half is right."""

ROUNDING_PX = 1e-6
"""Smallest noise that is told from rounding: exact data have no blunders below it."""

REWEIGHTINGS = 10
STEPS_PER_REWEIGHTING = 4  # the weights change again before more would pay
SETTLED = 0.01  # relative change of the variance; the limit above is no finer
EXCHANGES = 50

SUBSET, SUBSETS = 8, 256
"""Points of a subset (six would do, and be worse) and how many are drawn: with one point in ten
wrong, one subset in two is clean; with four in ten, one in sixty."""

FORETOLD = 100.0
"""Standard deviations of the noise to which a point must be predicted to be taken back. A corner of
the block whose neighbours are out is foretold to ten or twenty; what is not to a hundred lies so
far away that the lens could be bent to any residual, even that of a lost decimal point."""

FAR = 10.0
"""Times the median miss of the best subset beyond which a point has no part in the start: lens
distortion, which the linear solution lacks, is no reason to lose a point."""

Fitter: TypeAlias = Callable[[View, Camera | None], CameraFit]
"""Estimate a camera from a view, from a start if there is one."""


@dataclass(frozen=True, slots=True, eq=False)
class CleanFit:
    """A fit without the points that contradict it.

    Attributes
    ----------
    fit : CameraFit
        Of the points kept.
    kept : ndarray of bool, shape (N,)
        Points that took part.
    plain_px : float
        Noise of the fit of all points; infinite if there is none.
    """

    fit: CameraFit
    kept: BoolArray
    plain_px: float


def fit_without_blunders(
    view: View, fitter: Fitter, *, robust_free: tuple[str, ...], trials: int
) -> CleanFit:
    """Fit a camera and leave out the points that contradict the others.

    Parameters
    ----------
    view : View
        All points of the camera.
    fitter : callable
        The estimator.
    robust_free : tuple of str
        Parameters of the least-squares fit that sorts the points when the plain fit is suspect.
    trials : int
        Points tested in the whole calibration, over which the false alarm is shared.

    Returns
    -------
    CleanFit
        All points are kept where no blunder is found, or where more than half would be left out.

    Raises
    ------
    GeometryError
        If the points cannot be fitted, with or without blunders.
    """
    everything = np.ones(len(view), dtype=bool)
    plain: CameraFit | None = None
    refusal: GeometryError | None = None
    try:
        plain = fitter(view, None)
        if not _suspect(plain, trials):
            return CleanFit(plain, everything, _plain_px(plain))
    except GeometryError as error:
        refusal = error
    plain_px = np.inf if plain is None else _plain_px(plain)
    try:
        fit, kept = _exchange(view, fitter, _sorted_robustly(view, robust_free), trials)
        few = np.count_nonzero(~kept) <= MAX_SHARE * len(view)
        if few and not (plain is not None and _folded_by_noise(plain, view, kept, trials)):
            return CleanFit(fit, kept, plain_px)
    except GeometryError as error:  # too little is left to carry the parameters
        refusal = refusal or error
    if plain is None:
        raise refusal or GeometryError(f"camera {view.name!r}: no fit was found")
    return CleanFit(plain, everything, plain_px)


def _suspect(fit: CameraFit, trials: int) -> bool:
    """Whether a fit of all points hints at blunders.

    A residual does; so do many that hide each other in a large noise; and so does a far point
    that drags the fit along until none is left, for it takes a lens that no lens is.
    """
    return not fit.converged or _contradicted(fit, trials)


def _contradicted(fit: CameraFit, trials: int) -> bool:
    """Whether residuals hint at blunders: one by itself, or many in a large noise."""
    hidden = _noise(fit) > HIDDEN * _inner_noise(fit.whitened, fit.dof)
    return hidden or bool((snoop(fit) > limit(fit.dof - 2, trials)).any())


def _folded_by_noise(plain: CameraFit, view: View, kept: BoolArray, trials: int) -> bool:
    """Whether noise, not a far point, made the lens of the plain fit one that no lens is.

    Where that lens was the only alarm, a blunder hides behind it only if it lies far from what most
    points agree on.
    """
    if _contradicted(plain, trials):
        return False
    return bool(consensus(view)[~kept].all())


def consensus(view: View) -> BoolArray:
    """Find the points that most others agree with, by linear solutions of small subsets.

    Parameters
    ----------
    view : View
        Points of one camera; a minority may be wrong by any amount.

    Returns
    -------
    ndarray of bool, shape (N,)
        Points near the subset's camera whose median miss is the least (Rousseeuw 1984,
        doi:10.1080/01621459.1984.10477105).

    Raises
    ------
    GeometryError
        If no subset gives a camera.
    """
    world, image = _unit(view.xyz_mm), _unit(view.xy_px)
    world = np.column_stack([world, np.ones(len(view))])
    square = _subset_misses(world, image)
    median = np.median(square, axis=1)
    best = int(np.argmin(median))
    if not np.isfinite(median[best]):
        raise GeometryError(f"camera {view.name!r}: the points do not belong to one view")
    return np.asarray(square[best] <= FAR**2 * max(median[best], np.finfo(float).eps))


def _subset_misses(world: FloatArray, image: FloatArray) -> FloatArray:
    """Squared misses (S, N) of all points by the cameras of subsets; infinite by no camera.

    The linear equations of `solve_dlt`, for all subsets at once.
    """
    count = len(world)
    rows = np.zeros((count, 2, 12))
    rows[:, 0, :4] = rows[:, 1, 4:8] = world
    rows[:, :, 8:] = -image[:, :, None] * world[:, None]
    order = np.tile(np.arange(count), (SUBSETS, 1))
    draws = np.random.default_rng(0).permuted(order, axis=1)[:, :SUBSET]
    equations = rows[draws].reshape(SUBSETS, -1, 12)
    vectors = np.linalg.eigh(np.swapaxes(equations, 1, 2) @ equations)[1]
    matrices = vectors[:, :, 0].reshape(SUBSETS, 3, 4)
    # a camera has its points in front; a mirror image has them behind
    matrices *= np.sign(np.linalg.det(matrices[:, :, :3]))[:, None, None]
    seen = matrices @ world.T
    with np.errstate(divide="ignore", invalid="ignore"):
        square: FloatArray = np.sum((seen[:, :2] / seen[:, 2:] - image.T) ** 2, axis=1)
    square[~(seen[:, 2] > 0)] = np.inf
    square[~np.isfinite(np.take_along_axis(square, draws, axis=1)).all(axis=1)] = np.inf
    return square


def _unit(points: FloatArray) -> FloatArray:
    """Move points to the origin and scale them to unit size, by medians."""
    moved = points - np.median(points, axis=0)
    size = np.median(np.linalg.norm(moved, axis=1))
    unit: FloatArray = moved / max(float(size), np.finfo(float).tiny)
    return unit


def snoop(fit: Fit) -> FloatArray:
    """Test each fitted point against the others.

    Parameters
    ----------
    fit : Fit
        With at least three degrees of freedom.

    Returns
    -------
    ndarray, shape (N,)
        Externally studentised squared residual, F-distributed with 2 and dof - 2 degrees of
        freedom; 0 for a point that the fit leans on so much that nothing tests it.
    """
    q = fit.orthonormal
    rest = np.eye(2) - np.einsum("nip,njp->nij", q, q)
    determinant = rest[:, 0, 0] * rest[:, 1, 1] - rest[:, 0, 1] ** 2
    testable = determinant > 1e-9  # below, the deleted residual is rounding
    x, y = fit.whitened.T
    drop = rest[:, 1, 1] * x**2 - 2 * rest[:, 0, 1] * x * y + rest[:, 0, 0] * y**2
    drop = np.where(testable, drop / np.where(testable, determinant, 1.0), 0.0)
    dof = fit.dof - 2
    if dof < 1:
        return np.zeros(len(drop))
    others = np.maximum((fit.chi_square - drop) / dof, _floor(fit))
    statistic: FloatArray = drop / 2 / others
    return statistic


def limit(dof: int, trials: int) -> float:
    """Return the critical value of `snoop`.

    Parameters
    ----------
    dof : int
        Second degrees of freedom; infinite below 1.
    trials : int
        Number of points over which `FALSE_ALARM` is shared (Bonferroni).

    Returns
    -------
    float
        Upper quantile of F(2, dof), which has a closed form.
    """
    if dof < 1:
        return float("inf")
    return float(dof / 2 * ((FALSE_ALARM / trials) ** (-2 / dof) - 1))


def predicted(fit: CameraFit, view: View) -> FloatArray:
    """Test points that took no part in a fit; see `snoop`.

    Parameters
    ----------
    fit : CameraFit
        Of other points.
    view : View
        The points to be tested.

    Returns
    -------
    ndarray, shape (N,)
        F-distributed with 2 and dof degrees of freedom; infinite for points that the others
        cannot foretell, so far away that any residual would be excused.
    """
    camera = fit.camera
    residual = view.xy_px - camera.project(view.xyz_mm)
    jacobian = np.moveaxis(camera.parameter_jacobian(view.xyz_mm, fit.free), 0, 2)
    return foretold(fit, *whiten(view.whitener, residual.T, np.swapaxes(jacobian, 0, 1)))


def foretold(fit: Fit, white: FloatArray, columns: FloatArray) -> FloatArray:
    """Test whitened residuals (2, N) with Jacobian (p, 2, N) of no part in a fit: `predicted`."""
    spread = np.einsum("pin,pq->nqi", columns, fit.root)
    cov = np.eye(2) + np.einsum("nqi,nqj->nij", spread, spread)
    usable = np.isfinite(cov).all(axis=(1, 2)) & np.isfinite(white).all(axis=0)
    usable &= np.einsum("nii->n", np.where(usable[:, None, None], cov, 0.0)) < FORETOLD**2
    cov[~usable] = np.eye(2)
    white = np.where(usable, white, 0.0)
    square = np.einsum("in,ni->n", white, np.linalg.solve(cov, white.T[..., None])[..., 0])
    variance = max(fit.chi_square / max(fit.dof, 1), _floor(fit))
    statistic: FloatArray = np.where(usable, square / 2 / variance, np.inf)
    return statistic


def _exchange(
    view: View, fitter: Fitter, kept: BoolArray, trials: int
) -> tuple[CameraFit, BoolArray]:
    """Take back what fits, leave out the worst that does not, until neither is there."""
    seen: set[bytes] = set()
    start: Camera | None = None
    for _ in range(EXCHANGES):
        fit = fitter(view.select(kept), start)
        start = fit.camera
        left = np.flatnonzero(~kept)
        back = left[predicted(fit, view.select(~kept)) <= limit(fit.dof, trials)]
        statistic = np.zeros(len(view))
        statistic[kept] = snoop(fit)
        worst = int(np.argmax(statistic))
        changed = kept.copy()
        changed[back] = True
        if statistic[worst] > limit(fit.dof - 2, trials):
            changed[worst] = False
        if (changed == kept).all() or changed.tobytes() in seen:
            break
        seen.add(kept.tobytes())
        kept = changed
    return fit, kept


def _sorted_robustly(view: View, free: tuple[str, ...]) -> BoolArray:
    """Keep the points that a robust fit explains, from a start that blunders have no part in."""
    start = fit_camera(view.select(consensus(view)), free).camera
    square = _robust_squares(view, free, start)
    variance = max(inner_variance(square, view.xy_px.size - len(free)), ROUNDING_PX**2)
    return np.asarray(square <= ROBUST_LIMIT * variance)


def _robust_squares(view: View, free: tuple[str, ...], start: Camera) -> FloatArray:
    """Squared whitened residuals of a fit by reweighting, which forgets blunders.

    The weights are those of Geman and McClure; a point behind the camera has none.
    """
    camera, square, last = start, _squares(view, start), 0.0
    for _ in range(REWEIGHTINGS):
        variance = max(inner_variance(square, view.xy_px.size - len(free)), ROUNDING_PX**2)
        if not np.isfinite(variance) or abs(variance - last) <= SETTLED * last:
            break
        last = variance
        # four variances: a Gaussian residual keeps most of its weight
        weight = 1 / (1 + square / (4 * variance)) ** 2
        points = _reweighted(view, weight).select(np.isfinite(square))
        camera = fit_camera(points, free, camera, max_iterations=STEPS_PER_REWEIGHTING).camera
        square = _squares(view, camera)
    return square


def _squares(view: View, camera: Camera) -> FloatArray:
    residual = view.xy_px - camera.project(view.xyz_mm)
    white, _ = whiten(view.whitener, residual.T, np.zeros((0, 2, len(view))))
    square = np.sum(white**2, axis=0)
    return np.where(np.isfinite(square), square, np.inf)


def _reweighted(view: View, weight: FloatArray) -> View:
    root = np.sqrt(weight)[:, None]
    unit = np.array([1.0, 0.0, 1.0]) if view.whitener is None else view.whitener
    return view.weighted(unit * root)


def _noise(fit: Fit) -> float:
    return float(np.sqrt(fit.chi_square / fit.dof))


def _plain_px(fit: CameraFit) -> float:
    return float(np.sqrt(fit.rss_px2 / fit.dof))


def _inner_noise(whitened: FloatArray, dof: int) -> float:
    return float(np.sqrt(inner_variance(np.sum(whitened**2, axis=1), dof)))


def _floor(fit: Fit) -> float:
    """Variance of rounding in whitened units."""
    scale = np.sum(fit.whitened**2) / max(np.sum(fit.residual_px**2), np.finfo(float).tiny)
    return float(ROUNDING_PX**2 * (scale if scale > 0 else 1.0))
