"""One camera fitted to known points: least squares in the image."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from closerange.errors import GeometryError
from closerange.geometry.arrays import FloatArray
from closerange.geometry.least_squares import GAIN_LIMIT, levenberg_marquardt
from closerange.geometry.transform import RigidTransform, cross_matrix, rotation_from_vector
from closerange.rig.camera import POSE, Camera
from closerange.rig.camera_start import affine_starts, square_pixels
from closerange.rig.distortion import BrownIdeal
from closerange.rig.dlt import require_spatial, solve_dlt
from closerange.rig.fit import MAX_CONDITION, Factors, Fit, take_apart
from closerange.rig.projector import LENS, PARAMETERS, Projector, Values, left_jacobian
from closerange.rig.view import View, whiten

START_RATIO = 2.0
"""A fit may leave at most this many times the RMS of the DLT, which has one parameter (skew) more
than a pinhole and none of the lens: more means that the search ended in the wrong valley."""


MIRROR_RATIO = 4.0
"""A mirrored world must halve the residuals before it is believed: blunders spoil both alike."""

MAX_ITERATIONS = 200
"""A usual rig needs ten steps, a nearly affine view with a full lens model up to a hundred."""

ROUNDING_PX = 1e-6
"""Residuals below this are rounding of exact data, not worth another start."""

Stages = list[tuple[str, ...]]
Plan = tuple[Camera, Stages]
"""A start and the sets of parameters to free one after another."""


@dataclass(frozen=True, slots=True, eq=False)
class CameraFit(Fit):
    """A fitted camera and what the fit knows of itself.

    Attributes
    ----------
    camera : Camera
        The estimate.
    free : tuple of str
        Names of the estimated parameters.
    """

    camera: Camera
    free: tuple[str, ...]


def fit_camera(
    view: View,
    free: tuple[str, ...],
    start: Camera | None = None,
    *,
    max_iterations: int = MAX_ITERATIONS,
    gain_limit: float = GAIN_LIMIT,
) -> CameraFit:
    """Estimate a camera by least squares of its (whitened) image residuals.

    Parameters
    ----------
    view : View
        Points; more numbers than parameters.
    free : tuple of str
        Parameters to estimate, of `PARAMETERS`; lens terms and skew that are not free are zero.
    start : Camera, optional
        Where to begin; found from the points without it.
    max_iterations : int, optional
        Largest number of steps from a given start.
    gain_limit : float, optional
        Share of the cost below which a step from a given start is not worth while.

    Returns
    -------
    CameraFit
        The estimate; not converged if the search gave up.

    Raises
    ------
    GeometryError
        If the points are too few or cannot tell the parameters apart.

    Notes
    -----
    The world's origin is moved into the middle of the points, so that neither a far frame nor the
    correlation of rotation and translation costs digits; the covariance is moved back.
    """
    if view.xy_px.size <= len(free):
        raise GeometryError(
            f"camera {view.name!r}: {len(view)} points give {view.xy_px.size} numbers for "
            f"{len(free)} parameters",
            remedy="add control points, or choose a model with fewer parameters",
        )
    if start is not None:
        return _descend(
            view, free, [free], start, max_iterations=max_iterations, gain_limit=gain_limit
        )
    return _from_scratch(view, free)


def analyse(
    view: View,
    camera: Camera,
    free: tuple[str, ...],
    *,
    iterations: int = 0,
    converged: bool = True,
) -> CameraFit:
    """Describe a camera that is already there as if it had been fitted.

    Parameters
    ----------
    view : View
        Points.
    camera : Camera
        The estimate; its lens must be a `BrownIdeal`.
    free : tuple of str
        Parameters that were estimated.
    iterations, converged
        As in `CameraFit`.

    Returns
    -------
    CameraFit
        Residuals, leverages and covariance at the camera, by its geometric Jacobian.

    Raises
    ------
    GeometryError
        If the points cannot tell the parameters apart.
    """
    if isinstance(camera.distortion, BrownIdeal):
        projector = Projector(view, camera)
        residual, columns = projector.evaluate(*projector.values())
        columns = columns[[PARAMETERS.index(name) for name in free]]
    else:
        residual, columns = _evaluate_any(view, camera, free)
    if not (np.isfinite(residual).all() and np.isfinite(columns).all()):
        raise GeometryError(
            f"camera {view.name!r}: some control points cannot be projected by the fitted camera",
            remedy="check the pairing of points, or choose a model with fewer lens terms",
        )
    white, jacobian = whiten(view.whitener, residual, columns)
    factors = take_apart(jacobian)
    if len(factors.indistinct):
        raise _indistinct(view, free, factors)
    return CameraFit(
        camera=camera,
        free=free,
        residual_px=residual.T,
        whitened=white.T,
        orthonormal=factors.orthonormal,
        root=_about_origin(factors.root, free, camera, view),
        condition=factors.condition,
        iterations=iterations,
        converged=converged,
    )


def _evaluate_any(
    view: View, camera: Camera, free: tuple[str, ...]
) -> tuple[FloatArray, FloatArray]:
    """Return residuals (2, N) and d calculated / d free (p, 2, N) of any lens, about the middle."""
    middle, pose = view.xyz_mm.mean(axis=0), camera.camera_from_world
    near = RigidTransform(pose.rotation, pose.apply(middle))
    centred = replace(camera, camera_from_world=near)
    xyz = view.xyz_mm - middle
    jacobian = centred.parameter_jacobian(xyz, free)
    return (view.xy_px - centred.project(xyz)).T, np.moveaxis(jacobian, 0, 2).swapaxes(0, 1)


def _about_origin(
    root: FloatArray, free: tuple[str, ...], camera: Camera, view: View
) -> FloatArray:
    """Carry parameter errors from the middle of the points to the world's origin."""
    turned = camera.camera_from_world.rotation @ view.xyz_mm.mean(axis=0)
    moved = root.copy()
    turn, shift = free.index("rx"), free.index("tx")
    # R' (X - c) + t' = R' X + t with t = t' - R' c, hence dt = dt' - w x (R c)
    moved[shift : shift + 3] += cross_matrix(turned) @ root[turn : turn + 3]
    return moved


def _indistinct(view: View, free: tuple[str, ...], factors: Factors) -> GeometryError:
    share = np.linalg.norm(factors.indistinct, axis=0)
    names = [free[i] for i in np.argsort(-share) if share[i] > 0.2 * share.max()]
    return GeometryError(
        f"camera {view.name!r}: the points cannot tell {', '.join(names)} apart (condition number "
        f"{factors.condition:.1e}, the limit is {MAX_CONDITION:.1e})",
        remedy="add control points at other depths and nearer to the image's edges, or choose a "
        "model with fewer parameters",
    )


def _descend(
    view: View,
    free: tuple[str, ...],
    stages: Stages,
    start: Camera,
    *,
    max_iterations: int = MAX_ITERATIONS,
    gain_limit: float = GAIN_LIMIT,
) -> CameraFit:
    """Run Levenberg-Marquardt through stages that free more and more parameters."""
    projector = Projector(view, start)
    lens, rotation, shift = projector.lens, projector.rotation, projector.shift
    lens[[i for i, name in enumerate(LENS) if name not in free]] = 0.0
    seen, _ = whiten(view.whitener, view.xy_px.T, np.zeros((0, 2, len(view))))
    iterations, converged = 0, False
    for stage in stages:
        function, unpack = _problem(projector, stage, (lens, rotation, shift))
        last = stage is stages[-1]
        fit = levenberg_marquardt(
            function,
            np.zeros(len(stage)),
            max_iterations=max_iterations if last else 30,
            step_limit=1e-10 if last else 1e-4,
            gain_limit=gain_limit,
            # weaker than the weakest direction of a usual rig: less would only slow it down
            damping=1e-5,
            terms=float(np.sum(seen**2)),
        )
        iterations += fit.iterations
        converged = fit.converged
        lens, rotation, shift = unpack(fit.x)
    camera = projector.camera(lens, rotation, shift)
    # a lens polynomial that turns back within the points is no lens, however well it fits
    converged = converged and bool(np.isfinite(camera.project(view.xyz_mm)).all())
    return analyse(view, camera, free, iterations=iterations, converged=converged)


def _problem(
    projector: Projector, stage: tuple[str, ...], at: Values
) -> tuple[Callable[[FloatArray], tuple[FloatArray, FloatArray]], Callable[[FloatArray], Values]]:
    """Return the residual function of changes from `at`, and how to apply changes."""
    lens0, rotation0, shift0 = at
    rows = [PARAMETERS.index(name) for name in stage]
    lens_rows = [row for row in rows if row < len(LENS)]
    turn, count = slice(len(lens_rows), len(lens_rows) + 3), len(rows)
    whitener = projector.view.whitener

    def unpack(x: FloatArray) -> Values:
        lens = lens0.copy()
        lens[lens_rows] += x[: len(lens_rows)]
        return lens, rotation_from_vector(x[turn]) @ rotation0, shift0 + x[turn.stop :]

    def function(x: FloatArray) -> tuple[FloatArray, FloatArray]:
        lens, rotation, shift = unpack(x)
        residual, columns = projector.evaluate(lens, rotation, shift)
        white, jacobian = whiten(whitener, residual, columns[rows])
        matrix = jacobian.reshape(count, -1).T
        matrix[:, turn] = matrix[:, turn] @ left_jacobian(x[turn])
        return white.ravel(), -matrix

    return function, unpack


def _from_scratch(view: View, free: tuple[str, ...]) -> CameraFit:
    """Fit from a start found in the points themselves."""
    require_spatial(view.xyz_mm)
    try:
        solution = solve_dlt(view.xyz_mm, view.xy_px)
    except GeometryError as refusal:
        return _unless_mirrored(view, free, refusal)
    linear = square_pixels(view, solution.matrix)
    plans = [(linear, [free]), *_staged(free, [linear, *affine_starts(view)])]
    return _best_of(view, free, plans, START_RATIO * solution.rms_px + ROUNDING_PX)


def _unless_mirrored(view: View, free: tuple[str, ...], refusal: GeometryError) -> CameraFit:
    """Fit what the DLT refused, unless the mirrored world fits better: then it was right.

    A few gross blunders can turn the DLT inside out where the points themselves are sound.
    """
    fit = _best_of(view, free, _staged(free, affine_starts(view)), np.inf)
    turned = View(view.name, view.size_px, view.xyz_mm * [1, 1, -1], view.xy_px, view.whitener)
    mirrored = _best_of(turned, free, _staged(free, affine_starts(turned)), np.inf)
    if mirrored.chi_square * MIRROR_RATIO < fit.chi_square:
        raise refusal
    return fit


def _best_of(view: View, free: tuple[str, ...], plans: list[Plan], enough_px: float) -> CameraFit:
    """Return the first fit that leaves little enough, else the best."""
    best: CameraFit | None = None
    refusal: GeometryError | None = None
    for start, stages in plans:
        try:
            fit = _descend(view, free, stages, start)
        except GeometryError as error:
            refusal = refusal or error
            continue
        if best is None or fit.chi_square < best.chi_square:
            best = fit
        if best.converged and best.rss_px2 <= best.residual_px.size * enough_px**2:
            break
    if best is None:
        raise refusal or GeometryError(f"camera {view.name!r}: no fit was found")
    return best


def strong_parameters(free: tuple[str, ...]) -> tuple[str, ...]:
    """Return those of the free parameters that any start must get right: focal length and pose."""
    return tuple(name for name in free if name in ("fx", "fy", "k1", *POSE))


def _staged(free: tuple[str, ...], starts: list[Camera]) -> list[Plan]:
    """Free the strong parameters first: a wide lens may send all of them at once astray."""
    return [(start, [strong_parameters(free), free]) for start in starts]
