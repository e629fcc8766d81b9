"""All cameras of a rig fitted with one model: weights and blunders settled together."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from closerange.errors import GeometryError
from closerange.geometry.arrays import BoolArray, FloatArray
from closerange.rig.camera import Camera
from closerange.rig.camera_fit import CameraFit, analyse, fit_camera
from closerange.rig.decompose import camera_from_matrix
from closerange.rig.distortion import BrownIdeal
from closerange.rig.dlt import solve_dlt
from closerange.rig.models import FREE, LINEAR, Model
from closerange.rig.observations import Observations
from closerange.rig.outliers import ROUNDING_PX, CleanFit, fit_without_blunders
from closerange.rig.thesis_distortion import fit_thesis_distortion
from closerange.rig.thesis_dlt import camera_from_thesis, centred_from_pixels, solve_thesis_dlt
from closerange.rig.view import View
from closerange.rig.weights import (
    Stated,
    common_variance,
    parameter_covariance,
    whitener_of,
)

ROUNDS = 5
"""Rounds of fit and common variance; two are usual."""

SETTLED = 0.02
"""Relative change of tau^2 below which weights are settled: it is known to sqrt(2/dof) only,
15 % at 100 degrees of freedom."""


class CameraRefusedError(GeometryError):
    """A `GeometryError` of one camera.

    Parameters
    ----------
    camera : int
        Its index.
    name : str
        Its name, for the message.
    error : GeometryError
        What was wrong.
    """

    def __init__(self, camera: int, name: str, error: GeometryError) -> None:
        prefix = f"camera {name!r}: "
        message = error.message if error.message.startswith(prefix) else prefix + error.message
        super().__init__(message, remedy=error.remedy)
        self.camera = camera


@dataclass(frozen=True, slots=True, eq=False)
class Solution:
    """Fits of all cameras; C cameras.

    Attributes
    ----------
    model : Model
        The model.
    clean : tuple of CleanFit
        Fit and kept points of each camera.
    views : tuple of View
        Points that were fitted, with their weights.
    stated : tuple of Stated
        What was known of them.
    tau_px : float
        Common part of the points' standard deviation.
    weighted : bool
        Whether residuals were weighed by covariances.
    """

    model: Model
    clean: tuple[CleanFit, ...]
    views: tuple[View, ...]
    stated: tuple[Stated, ...]
    tau_px: float
    weighted: bool

    @property
    def fits(self) -> tuple[CameraFit, ...]:
        """The fit of each camera."""
        return tuple(clean.fit for clean in self.clean)

    @property
    def cameras(self) -> tuple[Camera, ...]:
        """The estimates."""
        return tuple(fit.camera for fit in self.fits)

    @property
    def dof(self) -> int:
        """Numbers minus parameters, over all cameras."""
        return sum(fit.dof for fit in self.fits)

    @property
    def noise_px(self) -> float:
        """S with s^2 = RSS / (n - p); of exact data what rounding could hide, never 0."""
        variance = sum(fit.rss_px2 for fit in self.fits) / self.dof
        return max(float(np.sqrt(variance)), ROUNDING_PX)

    @property
    def chi_square(self) -> float:
        """Sum of squared whitened residuals; in px^2 at unit weights."""
        return sum(fit.chi_square for fit in self.fits)

    def covariance(self) -> FloatArray:
        """Return the covariance of all free parameters, camera by camera, shape (P, P)."""
        variance = 1.0 if self.weighted else self.noise_px**2
        return parameter_covariance(
            self.fits, self.views, self.stated, variance=variance, tau_px=self.tau_px
        )


def solve(
    observations: Observations,
    xy_px: FloatArray,
    model: Model,
    *,
    reject: bool = True,
    like: Solution | None = None,
) -> Solution:
    """Fit all cameras with one model.

    Parameters
    ----------
    observations : Observations
        Points.
    xy_px : ndarray, shape (N, 2)
        Their image positions, bias-corrected or not.
    model : Model
        What to estimate.
    reject : bool, optional
        Leave out blunders.
    like : Solution, optional
        Another solution of the same points: where to begin. If it is of another model, the points
        that it left out stay out, and no others.

    Returns
    -------
    Solution
        Fits with settled weights.

    Raises
    ------
    CameraRefusedError
        If a camera cannot be fitted.
    """
    count = len(observations.cameras)
    views = [observations.view(i, xy_px) for i in range(count)]
    stated = [_stated(observations, i, model) for i in range(count)]
    weighted = any(part.any for part in stated)
    cameras: list[Camera | None] = [None] * count if like is None else list(like.cameras)
    kept: list[BoolArray | None] = [None] * count
    if not reject:
        kept = [np.ones(len(view), dtype=bool) for view in views]
    elif like is not None and like.model.name != model.name:
        kept = [clean.kept for clean in like.clean]
    tau2 = -1.0
    for _ in range(ROUNDS):
        clean = [
            _fit_one(i, view, model, cameras[i], kept=kept[i], trials=len(observations))
            for i, view in enumerate(views)
        ]
        if any(rows is None for rows in kept):
            clean = _without_wrong_rows(views, model, stated, clean)
        cameras = [result.fit.camera for result in clean]
        last, tau2 = tau2, _common_variance(clean, views, stated)
        if not weighted or (last >= 0 and abs(tau2 - last) <= SETTLED * last):
            break
        views = [
            view.weighted(whitener_of(_total(part, result, view, tau2)))
            for view, part, result in zip(views, stated, clean, strict=True)
        ]
    return Solution(
        model=model,
        clean=tuple(clean),
        views=tuple(v.select(r.kept) for v, r in zip(views, clean, strict=True)),
        stated=tuple(s.select(r.kept) for s, r in zip(stated, clean, strict=True)),
        tau_px=float(np.sqrt(tau2)),
        weighted=weighted,
    )


def _without_wrong_rows(
    views: Sequence[View], model: Model, stated: Sequence[Stated], clean: list[CleanFit]
) -> list[CleanFit]:
    """Leave out in all cameras the control rows that two of them contradict.

    Two cameras do not both misplace one point by chance: its position is wrong. Another camera
    that lies in the direction of the error sees little of it, and would keep the point.
    """
    contradicted = [
        np.setdiff1d(part.control_row, part.control_row[result.kept])
        for part, result in zip(stated, clean, strict=True)
    ]
    rows, votes = np.unique(np.concatenate(contradicted), return_counts=True)
    wrong = rows[votes > 1]
    found: list[CleanFit] = []
    for index, (view, part, result) in enumerate(zip(views, stated, clean, strict=True)):
        kept = result.kept & ~np.isin(part.control_row, wrong)
        if (kept == result.kept).all():
            found.append(result)
            continue
        try:
            again = _fit_one(index, view, model, result.fit.camera, kept=kept, trials=len(view))
        except CameraRefusedError:  # too few points to do without them
            again = result
        found.append(replace(again, plain_px=result.plain_px))
    return found


def _stated(observations: Observations, camera: int, model: Model) -> Stated:
    """Collect what is known; the linear methods know no weights."""
    rows = observations.rows(camera)
    linear = model.name in LINEAR
    cov = np.zeros((len(rows), 2, 2)) if linear else observations.stated_cov(camera)
    std = np.zeros(len(rows)) if linear else observations.std_mm[rows]
    return Stated(cov, std, observations.control_row[rows])


def _total(stated: Stated, result: CleanFit, view: View, tau2: float) -> FloatArray:
    stated_part = stated.in_image(result.fit.camera, view.xyz_mm)
    total: FloatArray = stated_part + max(tau2, ROUNDING_PX**2) * np.eye(2)
    return total


def _common_variance(
    clean: Sequence[CleanFit], views: Sequence[View], stated: Sequence[Stated]
) -> float:
    residual = np.concatenate([result.fit.residual_px for result in clean])
    cov = np.concatenate(
        [
            part.in_image(result.fit.camera, view.xyz_mm)[result.kept]
            for part, result, view in zip(stated, clean, views, strict=True)
        ]
    )
    return common_variance(residual, cov, sum(result.fit.dof for result in clean))


def _fit_one(
    camera: int,
    view: View,
    model: Model,
    start: Camera | None,
    *,
    kept: BoolArray | None,
    trials: int,
) -> CleanFit:
    """Fit one camera to the points that are kept, or find out which these are."""

    def fitter(points: View, begin: Camera | None) -> CameraFit:
        return _fit(points, model, begin or start)

    # the thesis' lens is of another kind; the search for blunders takes the usual one
    free = FREE["brown-skew"] if model.name == "thesis-distortion" else model.free
    try:
        if kept is None:
            return fit_without_blunders(view, fitter, robust_free=free, trials=trials)
        fit = fitter(view.select(kept), None)
        return CleanFit(fit, kept, float(np.sqrt(fit.rss_px2 / fit.dof)))
    except GeometryError as error:
        raise CameraRefusedError(camera, view.name, error) from error


def _fit(view: View, model: Model, start: Camera | None) -> CameraFit:
    """Estimate by the model's own method."""
    if model.name in FREE:
        usable = start is not None and isinstance(start.distortion, BrownIdeal)
        return fit_camera(view, model.free, start if usable else None)
    if view.xy_px.size <= len(model.free):
        raise GeometryError(
            f"{len(view)} points give {view.xy_px.size} numbers for {len(model.free)} parameters",
            remedy="add control points, or choose a model with fewer parameters",
        )
    if model.name == "dlt":
        matrix = solve_dlt(view.xyz_mm, view.xy_px).matrix
        return analyse(view, camera_from_matrix(matrix, view.name, view.size_px), model.free)
    centred = centred_from_pixels(view.xy_px, view.size_px)
    if model.name == "thesis-dlt":
        parameters = solve_thesis_dlt(view.xyz_mm, centred)
        return analyse(view, camera_from_thesis(parameters, view.name, view.size_px), model.free)
    fit = fit_thesis_distortion(view.xyz_mm, centred)
    return analyse(
        view,
        fit.camera(view.name, view.size_px),
        model.free,
        iterations=fit.iterations,
        converged=fit.converged,
    )
