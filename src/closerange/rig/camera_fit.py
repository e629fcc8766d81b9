"""One camera fitted to known points: least squares in the image."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from closerange.errors import GeometryError
from closerange.geometry.arrays import BoolArray, FloatArray
from closerange.geometry.least_squares import levenberg_marquardt
from closerange.geometry.transform import RigidTransform, cross_matrix, rotation_from_vector
from closerange.rig.camera import POSE, Camera
from closerange.rig.decompose import camera_from_matrix
from closerange.rig.distortion import BrownIdeal
from closerange.rig.dlt import require_spatial, solve_dlt

LENS = ("fx", "fy", "cx", "cy", "skew", "k1", "k2", "k3", "p1", "p2")
PARAMETERS = (*LENS, *POSE)

MAX_CONDITION = 1 / np.sqrt(np.finfo(float).eps)
"""Largest condition number of the Jacobian with columns of unit length, 6.7e7. A covariance matrix
carries its square: beyond this limit float64 has no digit left of it."""

START_RATIO = 2.0
"""A fit may leave at most this many times the RMS of the DLT, which has one parameter (skew) more
than a pinhole and none of the lens: more means that the search ended in the wrong valley."""


ROUNDING_PX = 1e-6
"""Residuals below this are rounding of exact data, not worth another start."""

Stages = list[tuple[str, ...]]
Plan = tuple[Camera, Stages]
"""A start and the sets of parameters to free one after another."""


@dataclass(frozen=True, slots=True, eq=False)
class View:
    """What one camera has to explain; N points.

    Attributes
    ----------
    name : str
        Of the camera.
    size_px : tuple of int
        Image width and height.
    xyz_mm : ndarray, shape (N, 3)
        Known world positions.
    xy_px : ndarray, shape (N, 2)
        Where they are seen.
    whitener : ndarray, shape (N, 3), or None
        Lower triangle (l11, l21, l22) of each point's W with W C W' = I; None for unit weights.
    """

    name: str
    size_px: tuple[int, int]
    xyz_mm: FloatArray
    xy_px: FloatArray
    whitener: FloatArray | None = None

    def __len__(self) -> int:
        return len(self.xy_px)

    def select(self, rows: BoolArray) -> View:
        """Keep some points."""
        whitener = None if self.whitener is None else self.whitener[rows]
        return View(self.name, self.size_px, self.xyz_mm[rows], self.xy_px[rows], whitener)

    def weighted(self, whitener: FloatArray | None) -> View:
        """Return the same points with other weights."""
        return View(self.name, self.size_px, self.xyz_mm, self.xy_px, whitener)


@dataclass(frozen=True, slots=True, eq=False)
class CameraFit:
    """A fitted camera and what the fit knows of itself.

    Attributes
    ----------
    camera : Camera
        The estimate.
    free : tuple of str
        Names of the estimated parameters.
    residual_px : ndarray, shape (N, 2)
        Observed minus calculated.
    whitened : ndarray, shape (N, 2)
        The same, divided by the standard deviations; equal to `residual_px` at unit weights.
    orthonormal : ndarray, shape (N, 2, p)
        Orthonormal basis Q of the whitened Jacobian's columns; Q Q' is the hat matrix.
    cofactor : ndarray, shape (p, p)
        inverse(J' W J): covariance of the parameters for residuals of unit variance.
    condition : float
        Condition number of the Jacobian with columns of unit length.
    iterations : int
        Steps of all stages.
    converged : bool
        False if the search gave up.
    """

    camera: Camera
    free: tuple[str, ...]
    residual_px: FloatArray
    whitened: FloatArray
    orthonormal: FloatArray
    cofactor: FloatArray
    condition: float
    iterations: int
    converged: bool

    @property
    def rss_px2(self) -> float:
        """Sum of squared residuals in px^2."""
        return float(np.sum(self.residual_px**2))

    @property
    def chi_square(self) -> float:
        """Sum of squared whitened residuals."""
        return float(np.sum(self.whitened**2))

    @property
    def dof(self) -> int:
        """Numbers minus parameters."""
        return self.residual_px.size - len(self.free)


def fit_camera(view: View, free: tuple[str, ...], start: Camera | None = None) -> CameraFit:
    """Estimate a camera by least squares of its (whitened) image residuals.

    Parameters
    ----------
    view : View
        Points; more numbers than parameters.
    free : tuple of str
        Parameters to estimate, of `PARAMETERS`; lens terms and skew that are not free are zero.
    start : Camera, optional
        Where to begin; found from the points without it.

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
        return _descend(view, free, [free], start)
    return _from_scratch(view, free)


def analyse(
    view: View, camera: Camera, free: tuple[str, ...], *, iterations: int = 0, converged: bool = True
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
    projector = _Projector(view, camera)
    residual, columns = projector.evaluate(projector.lens, projector.rotation, projector.shift)
    used = columns[[PARAMETERS.index(name) for name in free]]
    whitened, jacobian = _whiten(view.whitener, residual, used)
    matrix = jacobian.reshape(len(free), -1).T
    return described(view, camera, free, (residual.T, whitened.T, matrix), (iterations, converged))


def described(
    view: View,
    camera: Camera,
    free: tuple[str, ...],
    at_solution: tuple[FloatArray, FloatArray, FloatArray],
    search: tuple[int, bool],
) -> CameraFit:
    """Turn residuals (px and whitened) and the centred Jacobian into a `CameraFit`."""
    residual, whitened, matrix = at_solution
    scale = np.linalg.norm(matrix, axis=0)
    scale[scale == 0] = 1.0
    orthonormal, upper = np.linalg.qr(matrix / scale)
    singular, vt = np.linalg.svd(upper)[1:]
    condition = float(singular[0] / max(singular[-1], np.finfo(float).tiny))
    if not condition < MAX_CONDITION:
        raise _indistinct(view, free, vt[-1], condition)
    root = (vt.T / singular) / scale[:, None]
    if "rx" in free and "tx" in free:
        root = _about_origin(root, free, camera, view)
    iterations, converged = search
    return CameraFit(
        camera=camera,
        free=free,
        residual_px=residual,
        whitened=whitened,
        # rows are all x, then all y
        orthonormal=np.moveaxis(orthonormal.reshape(2, len(view), -1), 0, 1),
        cofactor=root @ root.T,
        condition=condition,
        iterations=iterations,
        converged=converged,
    )


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


def _indistinct(
    view: View, free: tuple[str, ...], direction: FloatArray, condition: float
) -> GeometryError:
    share = np.abs(direction)
    names = [free[i] for i in np.argsort(-share) if share[i] > 0.2 * share.max()]
    return GeometryError(
        f"camera {view.name!r}: the points cannot tell {', '.join(names)} apart (condition number "
        f"{condition:.1e}, the limit is {MAX_CONDITION:.1e})",
        remedy="add control points at other depths and nearer to the image's edges, or choose a "
        "model with fewer parameters",
    )


class _Projector:
    """Projection of centred points with all derivatives, without detours: the inner loop."""

    def __init__(self, view: View, camera: Camera) -> None:
        pose, matrix, lens = camera.camera_from_world, camera.matrix_px, camera.distortion
        assert isinstance(lens, BrownIdeal)
        self.view = view
        self.middle = view.xyz_mm.mean(axis=0)
        self.centred = np.ascontiguousarray((view.xyz_mm - self.middle).T)
        self.seen = np.ascontiguousarray(view.xy_px.T)
        self.rotation = pose.rotation
        self.shift = pose.rotation @ self.middle + pose.translation_mm
        intrinsics = (matrix[0, 0], matrix[1, 1], matrix[0, 2], matrix[1, 2], matrix[0, 1])
        self.lens = np.array([*intrinsics, lens.k1, lens.k2, lens.k3, lens.p1, lens.p2])

    def camera(self, lens: FloatArray, rotation: FloatArray, shift: FloatArray) -> Camera:
        """Return the camera of given values."""
        fx, fy, cx, cy, skew, k1, k2, k3, p1, p2 = (float(value) for value in lens)
        return Camera(
            name=self.view.name,
            size_px=self.view.size_px,
            matrix_px=np.array([[fx, skew, cx], [0, fy, cy], [0, 0, 1]]),
            camera_from_world=RigidTransform(rotation, shift - rotation @ self.middle),
            distortion=BrownIdeal(k1=k1, k2=k2, k3=k3, p1=p1, p2=p2),
        )

    def evaluate(
        self, lens: FloatArray, rotation: FloatArray, shift: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        """Return residuals (2, N) and d calculated / d `PARAMETERS` (16, 2, N)."""
        fx, fy, cx, cy, skew, k1, k2, k3, p1, p2 = lens
        turned = rotation @ self.centred
        depth = turned[2] + shift[2]
        per_depth = 1.0 / np.where(depth > 0, depth, np.nan)
        x, y = (turned[0] + shift[0]) * per_depth, (turned[1] + shift[1]) * per_depth
        xx, yy, xy2 = x * x, y * y, 2 * x * y
        r2 = xx + yy
        along_x, along_y = r2 + 2 * xx, r2 + 2 * yy
        radial = 1 + r2 * (k1 + r2 * (k2 + r2 * k3))
        xd = x * radial + p1 * xy2 + p2 * along_x
        yd = y * radial + p1 * along_y + p2 * xy2

        jacobian = np.zeros((len(PARAMETERS), 2, x.size))
        jacobian[0, 0], jacobian[1, 1], jacobian[4, 0] = xd, yd, yd
        jacobian[2, 0] = jacobian[3, 1] = 1.0
        power = r2
        for row in (5, 6, 7):
            jacobian[row, 1] = fy * (y * power)
            jacobian[row, 0] = fx * (x * power)
            power = power * r2
        jacobian[8, 0], jacobian[8, 1] = fx * xy2, fy * along_y
        jacobian[9, 0], jacobian[9, 1] = fx * along_x, fy * xy2
        if skew:
            jacobian[5:10, 0] += (skew / fy) * jacobian[5:10, 1]

        slope = 2 * (k1 + r2 * (2 * k2 + 3 * k3 * r2))
        dxx = (radial + slope * xx + 2 * p1 * y + 6 * p2 * x) * per_depth
        dyy = (radial + slope * yy + 6 * p1 * y + 2 * p2 * x) * per_depth
        dxy = (0.5 * slope * xy2 + 2 * p1 * x + 2 * p2 * y) * per_depth
        by_x, by_y, by_z = jacobian[13], jacobian[14], jacobian[15]
        by_x[0], by_x[1] = fx * dxx + skew * dxy, fy * dxy
        by_y[0], by_y[1] = fx * dxy + skew * dyy, fy * dyy
        by_z[:] = -(x * by_x + y * by_y)
        # d(exp(w) R X)/dw = -[R X]x, hence row . d/dw = (R X) x row
        jacobian[10] = turned[1] * by_z - turned[2] * by_y
        jacobian[11] = turned[2] * by_x - turned[0] * by_z
        jacobian[12] = turned[0] * by_y - turned[1] * by_x

        residual = self.seen - np.stack([fx * xd + skew * yd + cx, fy * yd + cy])
        return residual, jacobian


def _whiten(
    whitener: FloatArray | None, residual: FloatArray, columns: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Apply each point's W to residuals (2, N) and columns (p, 2, N)."""
    if whitener is None:
        return residual, columns
    a, b, c = whitener.T
    white = np.stack([a * residual[0], b * residual[0] + c * residual[1]])
    first = columns[:, 0]
    return white, np.stack([a * first, b * first + c * columns[:, 1]], axis=1)


def _descend(
    view: View, free: tuple[str, ...], stages: Stages, start: Camera
) -> CameraFit:
    """Run Levenberg-Marquardt through stages that free more and more parameters."""
    projector = _Projector(view, start)
    lens, rotation, shift = projector.lens, projector.rotation, projector.shift
    lens[[i for i, name in enumerate(LENS) if name not in free]] = 0.0
    iterations, converged = 0, False
    for stage in stages:
        function, unpack = _problem(projector, stage, (lens, rotation, shift))
        last = stage is stages[-1]
        fit = levenberg_marquardt(
            function,
            np.zeros(len(stage)),
            max_iterations=200 if last else 30,
            step_limit=1e-10 if last else 1e-4,
            # weaker than the weakest direction of a usual rig: less would only slow it down
            damping=1e-5,
        )
        iterations += fit.iterations
        converged = fit.converged
        lens, rotation, shift = unpack(fit.x)
    camera = projector.camera(lens, rotation, shift)
    return analyse(view, camera, free, iterations=iterations, converged=converged)


Values = tuple[FloatArray, FloatArray, FloatArray]


def _problem(
    projector: _Projector, stage: tuple[str, ...], at: Values
) -> tuple[
    Callable[[FloatArray], tuple[FloatArray, FloatArray]], Callable[[FloatArray], Values]
]:
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
        white, jacobian = _whiten(whitener, residual, columns[rows])
        matrix = jacobian.reshape(count, -1).T
        matrix[:, turn] = matrix[:, turn] @ _left_jacobian(x[turn])
        return white.ravel(), -matrix

    return function, unpack


def _left_jacobian(vector: FloatArray) -> FloatArray:
    """D exp(w + dw) = exp(J dw) exp(w): what a change of the rotation vector turns by."""
    angle = float(np.linalg.norm(vector))
    cross = cross_matrix(vector)
    # series near zero, where the closed forms lose all digits
    first = 0.5 - angle**2 / 24 if angle < 1e-3 else (1 - np.cos(angle)) / angle**2
    second = 1 / 6 - angle**2 / 120 if angle < 1e-3 else (angle - np.sin(angle)) / angle**3
    jacobian: FloatArray = np.eye(3) + first * cross + second * (cross @ cross)
    return jacobian


def _from_scratch(view: View, free: tuple[str, ...]) -> CameraFit:
    """Fit from a start found in the points themselves."""
    require_spatial(view.xyz_mm)
    try:
        solution = solve_dlt(view.xyz_mm, view.xy_px)
    except GeometryError as refusal:
        return _unless_mirrored(view, free, refusal)
    linear = _square_pixels(view, solution.matrix)
    plans = [(linear, [free]), *_staged(free, [linear, *affine_starts(view)])]
    return _best_of(view, free, plans, START_RATIO * solution.rms_px + ROUNDING_PX)


def _unless_mirrored(view: View, free: tuple[str, ...], refusal: GeometryError) -> CameraFit:
    """Fit what the DLT refused, unless the mirrored world fits better: then it was right.

    A few gross blunders can turn the DLT inside out where the points themselves are sound.
    """
    fit = _best_of(view, free, _staged(free, affine_starts(view)), np.inf)
    turned = View(view.name, view.size_px, view.xyz_mm * [1, 1, -1], view.xy_px, view.whitener)
    mirrored = _best_of(turned, free, _staged(free, affine_starts(turned)), np.inf)
    if mirrored.chi_square < fit.chi_square:
        raise refusal
    return fit


def _best_of(
    view: View, free: tuple[str, ...], plans: list[Plan], enough_px: float
) -> CameraFit:
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
        assert refusal is not None
        raise refusal
    return best


def _staged(free: tuple[str, ...], starts: list[Camera]) -> list[Plan]:
    """Free the strong parameters first: a wide lens may send all of them at once astray."""
    first = tuple(name for name in free if name in ("fx", "fy", "k1", *POSE))
    return [(start, [first, free]) for start in starts]


def _square_pixels(view: View, matrix: FloatArray) -> Camera:
    """Turn a projection matrix into a start: no skew, no lens."""
    camera = camera_from_matrix(matrix, view.name, view.size_px)
    k = camera.matrix_px.copy()
    k[0, 1] = 0.0
    return replace(camera, matrix_px=k)


def affine_starts(view: View) -> list[Camera]:
    """Return cameras with a centred principal point, the most fitting one first.

    Parameters
    ----------
    view : View
        Points, not in one plane.

    Returns
    -------
    list of Camera
        Scaled orthography gives attitude and scale f/depth; the focal length itself is taken from
        a ladder that spans fish-eyes to telephoto lenses.
    """
    middle = view.xyz_mm.mean(axis=0)
    centred = np.column_stack([view.xyz_mm - middle, np.ones(len(view))])
    affine = np.linalg.lstsq(centred, view.xy_px, rcond=None)[0].T
    u, scales, vt = np.linalg.svd(affine[:, :3], full_matrices=False)
    rows = u @ vt
    rotation = np.stack([*rows, np.cross(rows[0], rows[1])])
    centre = (np.array(view.size_px) - 1) / 2
    found = []
    for focal in max(view.size_px) * np.array([0.5, 1, 2, 4, 8, 16]):
        depth = focal / max(scales.mean(), np.finfo(float).tiny)
        shift = depth * np.append((affine[:, 3] - centre) / focal, 1.0)
        k = np.array([[focal, 0, centre[0]], [0, focal, centre[1]], [0, 0, 1]])
        pose = RigidTransform(rotation, shift - rotation @ middle)
        camera = Camera(view.name, view.size_px, k, pose)
        miss = np.nan_to_num(view.xy_px - camera.project(view.xyz_mm), nan=1e6)
        found.append((float(np.sum(miss**2)), camera))
    return [camera for _, camera in sorted(found, key=lambda pair: pair[0])][:2]
