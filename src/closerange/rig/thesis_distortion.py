"""The calibration with lens distortion of the thesis' chapter 6, as it is printed.

Kept for comparison; its error criterion is algebraic and its polynomial is centred on the image,
which costs accuracy (a strong lens with an offset principal point: tenfold).

Image coordinates as in `thesis_dlt`: px from the image centre, x right, y up. The sixteen
parameters are a1 ... a11 of eq. (2.1), then a12 = K1, a13 = K2, a14 = K3, a15 = P1, a16 = P2 of
the corrections (6.5), which are added to observed coordinates.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from closerange.errors import GeometryError, InputError
from closerange.geometry.arrays import FloatArray, frozen_array
from closerange.rig.camera import Camera
from closerange.rig.distortion import BrownObserved
from closerange.rig.dlt import checked_points
from closerange.rig.thesis_dlt import camera_from_thesis, centre_of, solve_thesis_dlt

THESIS_ASSUMPTIONS: dict[int, tuple[str, tuple[int, ...]]] = {
    11: ("no lens distortion", ()),
    12: ("one radial term", (11,)),
    14: ("one radial term and tangential", (11, 14, 15)),
    16: ("three radial terms and tangential", (11, 12, 13, 14, 15)),
}
"""Section 6.5: number of parameters -> description, indices (from 0) of the lens terms freed."""

FIRST_LAMBDA = 0.01  # the thesis' start
LAMBDA_FACTOR = 10.0  # not stated there; Marquardt's own (1963), doi:10.1137/0111030
STEP_LIMIT = 1e-5
STEP_FLOOR = 1e-3
MAX_ITERATIONS = 100  # six were enough for the thesis
MAX_LAMBDA = 1e30  # above the square of the longest column: no shorter step can be asked for


@dataclass(frozen=True, slots=True, eq=False)
class ThesisFit:
    """A camera calibrated by chapter 6.

    Attributes
    ----------
    parameters : ndarray, shape (16,)
        a1 ... a16 in mm and px; zero where not freed.
    free : tuple of int
        Indices (from 0) of the freed parameters.
    phi : float
        Error criterion (6.13), px^2.
    phi_history : tuple of float
        phi at the start and after each iteration that was accepted.
    iterations : int
        Accepted steps.
    converged : bool
        The stop rule was met.
    jacobian : ndarray, shape (2N, P)
        d (f1, f2 of each point) / d freed parameters at the solution: the matrix P of (6.10).
    """

    parameters: FloatArray
    free: tuple[int, ...]
    phi: float
    phi_history: tuple[float, ...]
    iterations: int
    converged: bool
    jacobian: FloatArray

    def __post_init__(self) -> None:
        object.__setattr__(self, "parameters", frozen_array(self.parameters, (16,), "parameters"))
        object.__setattr__(
            self, "jacobian", frozen_array(self.jacobian, (None, len(self.free)), "jacobian")
        )

    def camera(self, name: str, size_px: tuple[int, int]) -> Camera:
        """Return the calibrated camera.

        Parameters
        ----------
        name : str
            Of the camera.
        size_px : tuple of int
            Image width and height.

        Returns
        -------
        Camera
            With a `BrownObserved` lens about the image centre, unit 1 px. y turns from up to
            down, which turns the sign of P2 alone.
        """
        k1, k2, k3, p1, p2 = (float(value) for value in self.parameters[11:])
        lens = BrownObserved(k1, k2, k3, p1, -p2, centre_px=centre_of(size_px))
        return camera_from_thesis(self.parameters, name, size_px, distortion=lens)


@dataclass(frozen=True, slots=True, eq=False)
class AssumptionRow:
    """One line of the comparison of section 6.5.

    Attributes
    ----------
    assumption : int
        1 ... 4.
    description : str
        Lens terms in words.
    parameters : int
        11, 12, 14 or 16.
    phi : float
        Error criterion, px^2.
    reduction_percent : float
        Of phi against assumption 1.
    fit : ThesisFit
        The solution.
    """

    assumption: int
    description: str
    parameters: int
    phi: float
    reduction_percent: float
    fit: ThesisFit


def thesis_residuals(
    parameters: ArrayLike, xyz_mm: ArrayLike, xy_centred_px: ArrayLike
) -> FloatArray:
    """Evaluate f1 and f2 of eq. (6.7).

    Parameters
    ----------
    parameters : array_like, shape (16,)
        a1 ... a16.
    xyz_mm : array_like, shape (N, 3)
        World points.
    xy_centred_px : array_like, shape (N, 2)
        Observed image points, px from the image centre, y up.

    Returns
    -------
    ndarray, shape (N, 2)
        f1 and f2 in px times w, where w = 1 at the world's origin.
    """
    a = np.asarray(parameters, np.float64)
    xyz, xy = np.asarray(xyz_mm, np.float64), np.asarray(xy_centred_px, np.float64)
    w = xyz @ a[8:11] + 1
    linear = np.stack([xyz @ a[0:3] + a[3], xyz @ a[4:7] + a[7]], axis=1)
    residuals: FloatArray = (xy + _lens_terms(xy) @ a[11:16]) * w[:, None] - linear
    return residuals


def fit_thesis_distortion(
    xyz_mm: ArrayLike, xy_centred_px: ArrayLike, *, parameters: int = 16
) -> ThesisFit:
    """Calibrate one camera with lens terms by Marquardt's method, eq. (6.7)-(6.14).

    The start is the DLT of chapter 2 with all lens terms zero. Each step solves
    (P'P + lambda I) da = -P'f in the units as they are (mm, px), lambda from 0.01, divided by
    ten after a step that lowers phi and multiplied by ten until one does. The stop rule is
    |da_j| / (0.001 + |a_j|) <= 1e-5 for all j. Lens terms in px units are far below 0.001, so in
    effect a1 ... a8 decide.

    One departure, of arithmetic only: with K3 ~ r^6 the condition number of P'P exceeds 1e40, so
    the same minimum is found from the stacked system [P; sqrt(lambda) I] with columns brought to
    one length, never forming P'P.

    Parameters
    ----------
    xyz_mm : array_like, shape (N, 3)
        Known world points, not in one plane; 2N must be at least `parameters`.
    xy_centred_px : array_like, shape (N, 2)
        Their observed images, px from the image centre, y up.
    parameters : {11, 12, 14, 16}, optional
        Which of `THESIS_ASSUMPTIONS`.

    Returns
    -------
    ThesisFit
        Solution and history of phi.

    Raises
    ------
    InputError
        If `parameters` is none of the four.
    GeometryError
        As `solve_thesis_dlt`, and if there are fewer equations than parameters.
    """
    if parameters not in THESIS_ASSUMPTIONS:
        raise InputError(
            f"{parameters} parameters; the thesis has {', '.join(map(str, THESIS_ASSUMPTIONS))}",
            remedy="use one of them",
        )
    xyz, xy = checked_points(xyz_mm, xy_centred_px)
    if 2 * len(xyz) < parameters:
        raise GeometryError(
            f"{len(xyz)} points give {2 * len(xyz)} equations for {parameters} parameters",
            remedy=f"use at least {(parameters + 1) // 2} points or fewer lens terms",
        )
    start = np.concatenate([solve_thesis_dlt(xyz, xy), np.zeros(5)])
    free = (*range(11), *THESIS_ASSUMPTIONS[parameters][1])
    return _marquardt(start, free, xyz, xy)


def compare_assumptions(xyz_mm: ArrayLike, xy_centred_px: ArrayLike) -> tuple[AssumptionRow, ...]:
    """Calibrate one camera under each of the four assumptions of section 6.5.

    Parameters
    ----------
    xyz_mm : array_like, shape (N, 3)
        Known world points, at least eight.
    xy_centred_px : array_like, shape (N, 2)
        Their observed images, px from the image centre, y up.

    Returns
    -------
    tuple of AssumptionRow
        Four, by number of parameters. phi always falls with it; that alone does not make a
        calibration better in space.

    Raises
    ------
    GeometryError
        As `fit_thesis_distortion`.
    """
    fits = [
        fit_thesis_distortion(xyz_mm, xy_centred_px, parameters=count)
        for count in THESIS_ASSUMPTIONS
    ]
    first = fits[0].phi
    return tuple(
        AssumptionRow(
            assumption=number,
            description=description,
            parameters=count,
            phi=fit.phi,
            reduction_percent=100 * (1 - fit.phi / first) if first > 0 else 0.0,
            fit=fit,
        )
        for number, ((count, (description, _)), fit) in enumerate(
            zip(THESIS_ASSUMPTIONS.items(), fits, strict=True), start=1
        )
    )


def _marquardt(
    start: FloatArray, free: tuple[int, ...], xyz: FloatArray, xy: FloatArray
) -> ThesisFit:
    """Iterate eq. (6.10) until the stop rule holds."""
    a, columns = start, list(free)
    f, p = thesis_residuals(a, xyz, xy).reshape(-1), _derivatives(a, xyz, xy)[:, columns]
    history = [float(f @ f)]
    damping, converged = FIRST_LAMBDA, len(free) == 11  # eleven are linear: the start is the answer
    for _ in range(MAX_ITERATIONS):
        if converged or damping > MAX_LAMBDA:
            break
        step = np.zeros(16)
        step[columns] = _step(p, f, damping)
        tried = thesis_residuals(a + step, xyz, xy).reshape(-1)
        converged = bool((np.abs(step) <= STEP_LIMIT * (STEP_FLOOR + np.abs(a))).all())
        if tried @ tried < history[-1]:
            a, f, damping = a + step, tried, damping / LAMBDA_FACTOR
            p = _derivatives(a, xyz, xy)[:, columns]
            history.append(float(f @ f))
        else:
            damping *= LAMBDA_FACTOR
    return ThesisFit(a, free, history[-1], tuple(history), len(history) - 1, converged, p)


def _step(p: FloatArray, f: FloatArray, damping: float) -> FloatArray:
    """Minimise |P da + f|^2 + lambda |da|^2, which is eq. (6.10)."""
    stacked = np.concatenate([p, np.sqrt(damping) * np.eye(p.shape[1])])
    length = np.linalg.norm(stacked, axis=0)
    right = np.concatenate([-f, np.zeros(p.shape[1])])
    solution: FloatArray = np.linalg.lstsq(stacked / length, right, rcond=None)[0] / length
    return solution


def _lens_terms(xy: FloatArray) -> FloatArray:
    """D (corrected x, y) / d (a12 ... a16) of eq. (6.5), shape (N, 2, 5)."""
    x, y = xy[:, 0], xy[:, 1]
    r2 = x * x + y * y
    radial = xy[:, :, None] * np.stack([r2, r2**2, r2**3], axis=1)[:, None, :]
    along_x = np.stack([r2 + 2 * x * x, 2 * x * y], axis=1)
    along_y = np.stack([2 * x * y, r2 + 2 * y * y], axis=1)
    return np.concatenate([radial, along_x[:, :, None], along_y[:, :, None]], axis=2)


def _derivatives(a: FloatArray, xyz: FloatArray, xy: FloatArray) -> FloatArray:
    """First derivatives (6.9) of f1, f2 by a1 ... a16, shape (2N, 16)."""
    lens = _lens_terms(xy)
    w = xyz @ a[8:11] + 1
    rows = np.zeros((len(xyz), 2, 16))
    rows[:, 0, 0:4] = rows[:, 1, 4:8] = -np.column_stack([xyz, np.ones(len(xyz))])
    rows[:, :, 8:11] = (xy + lens @ a[11:16])[:, :, None] * xyz[:, None, :]
    rows[:, :, 11:16] = lens * w[:, None, None]
    return rows.reshape(-1, 16)
