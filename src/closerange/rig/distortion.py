"""Lens distortion: a warp of the image plane between ideal and observed pixels.

*Ideal* pixels are where a distortion-free camera with the same matrix would see a point;
*observed* pixels are where it is seen. Two models state the warp in opposite directions:

- `BrownIdeal` adds displacements to ideal normalised coordinates (OpenCV's model);
- `BrownObserved` adds corrections to observed coordinates (photogrammetry of the 1970s, the
  thesis' chapter 6, OpenPTV).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from closerange.geometry.arrays import FloatArray, frozen_array

COEFFICIENTS = ("k1", "k2", "k3", "p1", "p2")
INTRINSICS = ("fx", "fy", "cx", "cy", "skew")

_NEWTON_STEPS = 30
_NEWTON_LIMIT = 1e-13  # in units of the polynomial's coordinate; far below 1e-9 px


class Distortion(Protocol):
    """A lens: a smooth warp between ideal and observed pixels.

    All pixel arguments have shape (N, 2); `matrix_px` is the camera matrix (3, 3) with skew.
    Points outside of the range in which the warp is one-to-one become NaN.
    """

    def distort(self, ideal_px: FloatArray, matrix_px: FloatArray) -> FloatArray:
        """Return observed px, shape (N, 2)."""
        ...

    def undistort(self, observed_px: FloatArray, matrix_px: FloatArray) -> FloatArray:
        """Return ideal px, shape (N, 2)."""
        ...

    def jacobian(self, ideal_px: FloatArray, matrix_px: FloatArray) -> FloatArray:
        """Return d observed / d ideal, shape (N, 2, 2)."""
        ...

    def parameter_jacobian(
        self, ideal_px: FloatArray, matrix_px: FloatArray, names: Sequence[str]
    ) -> FloatArray:
        """Return d observed / d parameters at fixed directions, shape (N, 2, P).

        `names` are of `INTRINSICS` and `COEFFICIENTS`.
        """
        ...

    def moved(self, **changes: float) -> Distortion:
        """Return the lens with changes added to coefficients."""
        ...


@dataclass(frozen=True, slots=True)
class BrownIdeal:
    """Radial and decentring distortion of ideal normalised coordinates (OpenCV's order).

    ``x_d = x g + 2 p1 x y + p2 (r^2 + 2 x^2)``, ``y_d = y g + p1 (r^2 + 2 y^2) + 2 p2 x y`` with
    ``g = 1 + k1 r^2 + k2 r^4 + k3 r^6``. D. C. Brown, "Decentering distortion of lenses",
    Photogrammetric Engineering 32 (1966) 444-462.

    Attributes
    ----------
    k1, k2, p1, p2, k3 : float
        Coefficients, dimensionless.
    """

    k1: float = 0.0
    k2: float = 0.0
    p1: float = 0.0
    p2: float = 0.0
    k3: float = 0.0

    def distort(self, ideal_px: FloatArray, matrix_px: FloatArray) -> FloatArray:
        """Return observed px; NaN beyond the radius where the radial polynomial turns back."""
        xy = _normalised(ideal_px, matrix_px)
        shift, _, _ = _brown(xy, self._terms(), order=0)
        distorted = xy + shift
        distorted[np.sum(xy**2, axis=1) > self.fold_radius**2] = np.nan
        return _pixels(distorted, matrix_px)

    def undistort(self, observed_px: FloatArray, matrix_px: FloatArray) -> FloatArray:
        """Return ideal px; NaN where no ideal point maps to the observed one."""
        target = _normalised(observed_px, matrix_px)
        xy = _solve_plus_brown(target, self._terms())
        xy[np.sum(xy**2, axis=1) > self.fold_radius**2] = np.nan
        return _pixels(xy, matrix_px)

    def jacobian(self, ideal_px: FloatArray, matrix_px: FloatArray) -> FloatArray:
        """Return d observed / d ideal, shape (N, 2, 2)."""
        _, by_xy, _ = _brown(_normalised(ideal_px, matrix_px), self._terms(), order=1)
        k = matrix_px[:2, :2]
        result: FloatArray = k @ (np.eye(2) + by_xy) @ np.linalg.inv(k)
        return result

    def parameter_jacobian(
        self, ideal_px: FloatArray, matrix_px: FloatArray, names: Sequence[str]
    ) -> FloatArray:
        """Return d observed / d parameters at fixed directions, shape (N, 2, P)."""
        xy = _normalised(ideal_px, matrix_px)
        shift, _, by_term = _brown(xy, self._terms(), order=2)
        columns = _intrinsic_columns(xy + shift)
        # column order of _brown: k1 k2 k3, then the term along x (p2) and along y (p1)
        by_coefficient = matrix_px[:2, :2] @ by_term
        columns.update(
            zip(("k1", "k2", "k3", "p2", "p1"), np.moveaxis(by_coefficient, 2, 0), strict=True)
        )
        return np.stack([columns[name] for name in names], axis=2)

    def moved(self, **changes: float) -> BrownIdeal:
        """Return the lens with changes added to coefficients."""
        return BrownIdeal(
            **{name: getattr(self, name) + changes.get(name, 0.0) for name in COEFFICIENTS}
        )

    @property
    def fold_radius(self) -> float:
        """Normalised radius beyond which the radial polynomial is no longer one-to-one."""
        if not self.k3:
            return _first_root(5 * self.k2, 3 * self.k1)
        roots = np.roots([7 * self.k3, 5 * self.k2, 3 * self.k1, 1.0])
        squares = [
            root.real for root in roots if abs(root.imag) < 1e-12 * abs(root) and root.real > 0
        ]
        return float(np.sqrt(min(squares))) if squares else np.inf

    def radial_curve(self, radius: FloatArray) -> FloatArray:
        """Return the outward displacement delta_r at ideal normalised radii (section 6.2)."""
        square = radius**2
        return radius * square * (self.k1 + square * (self.k2 + square * self.k3))

    def _terms(self) -> tuple[float, float, float, float, float]:
        return self.k1, self.k2, self.k3, self.p2, self.p1


@dataclass(frozen=True, slots=True, eq=False)
class BrownObserved:
    """Corrections added to observed coordinates (eq. 6.5): ideal = observed + correction.

    With x, y = (observed - centre_px) / unit_px:
    ``dx = x (k1 r^2 + k2 r^4 + k3 r^6) + p1 (r^2 + 2 x^2) + 2 p2 x y`` and
    ``dy = y (k1 r^2 + k2 r^4 + k3 r^6) + 2 p1 x y + p2 (r^2 + 2 y^2)``, in the same unit.
    Note that p1 and p2 change places against `BrownIdeal`.

    Attributes
    ----------
    k1, k2, k3, p1, p2 : float
        Coefficients in powers of 1/unit.
    centre_px : ndarray, shape (2,)
        Centre of the polynomial (the thesis: the image centre).
    unit_px : ndarray, shape (2,)
        Length of the unit along x and y, in px (the thesis: 1; OpenPTV: 1 / pixel size in mm).
    """

    k1: float = 0.0
    k2: float = 0.0
    k3: float = 0.0
    p1: float = 0.0
    p2: float = 0.0
    centre_px: FloatArray = (0.0, 0.0)  # type: ignore[assignment]  # frozen below
    unit_px: FloatArray = (1.0, 1.0)  # type: ignore[assignment]

    def __post_init__(self) -> None:
        object.__setattr__(self, "centre_px", frozen_array(self.centre_px, (2,), "centre_px"))
        object.__setattr__(self, "unit_px", frozen_array(self.unit_px, (2,), "unit_px"))

    def distort(self, ideal_px: FloatArray, matrix_px: FloatArray) -> FloatArray:  # noqa: ARG002
        """Return observed px; NaN where no observed point maps to the ideal one."""
        target = (np.asarray(ideal_px) - self.centre_px) / self.unit_px
        return _solve_plus_brown(target, self._terms()) * self.unit_px + self.centre_px

    def undistort(self, observed_px: FloatArray, matrix_px: FloatArray) -> FloatArray:  # noqa: ARG002
        """Return ideal px (the direction in which the model is explicit)."""
        xy = (np.asarray(observed_px) - self.centre_px) / self.unit_px
        shift, _, _ = _brown(xy, self._terms(), order=0)
        return (xy + shift) * self.unit_px + self.centre_px

    def jacobian(self, ideal_px: FloatArray, matrix_px: FloatArray) -> FloatArray:
        """Return d observed / d ideal, shape (N, 2, 2)."""
        return self._inverse_jacobian(self.distort(ideal_px, matrix_px))

    def parameter_jacobian(
        self, ideal_px: FloatArray, matrix_px: FloatArray, names: Sequence[str]
    ) -> FloatArray:
        """Return d observed / d parameters at fixed directions, shape (N, 2, P)."""
        observed = self.distort(ideal_px, matrix_px)
        inverse = self._inverse_jacobian(observed)
        xy = (observed - self.centre_px) / self.unit_px
        _, _, by_term = _brown(xy, self._terms(), order=2)
        # observed + correction(observed; c) = ideal, hence d observed/dc = -J^-1 d correction/dc
        by_coefficient = -inverse @ (by_term * self.unit_px[:, None])
        columns = {
            name: np.einsum("nij,nj->ni", inverse, column)
            for name, column in _intrinsic_columns(_normalised(ideal_px, matrix_px)).items()
        }
        columns.update(
            zip(("k1", "k2", "k3", "p1", "p2"), np.moveaxis(by_coefficient, 2, 0), strict=True)
        )
        return np.stack([columns[name] for name in names], axis=2)

    def moved(self, **changes: float) -> BrownObserved:
        """Return the lens with changes added to coefficients."""
        values = {name: getattr(self, name) + changes.get(name, 0.0) for name in COEFFICIENTS}
        return BrownObserved(**values, centre_px=self.centre_px, unit_px=self.unit_px)

    def radial_curve(self, radius: FloatArray) -> FloatArray:
        """Return delta_r of section 6.2 at observed radii, in units of the polynomial.

        Section 6.2 subtracts delta_r from the observed radius where (6.5) adds a correction:
        the signs are opposite.
        """
        square = radius**2
        return -radius * square * (self.k1 + square * (self.k2 + square * self.k3))

    def _terms(self) -> tuple[float, float, float, float, float]:
        return self.k1, self.k2, self.k3, self.p1, self.p2

    def _inverse_jacobian(self, observed_px: FloatArray) -> FloatArray:
        xy = (observed_px - self.centre_px) / self.unit_px
        _, by_xy, _ = _brown(xy, self._terms(), order=1)
        forward = np.eye(2) + by_xy * (self.unit_px[:, None] / self.unit_px)
        forward[~np.isfinite(forward).all(axis=(1, 2))] = np.nan
        inverse: FloatArray = np.linalg.inv(forward)
        return inverse


def _first_root(a: float, b: float) -> float:
    """Return the root of the least s > 0 with a s^2 + b s + 1 = 0; infinite if there is none."""
    discriminant = b * b - 4 * a
    if discriminant < 0:
        return np.inf
    # Citardauq's form: no difference of nearly equal numbers, and no division by a = 0
    both = [-b + sign * math.sqrt(discriminant) for sign in (1, -1)]
    squares = [2 / value for value in both if value > 0]
    return math.sqrt(min(squares)) if squares else np.inf


def _normalised(pixels: FloatArray, matrix_px: FloatArray) -> FloatArray:
    y = (pixels[:, 1] - matrix_px[1, 2]) / matrix_px[1, 1]
    x = (pixels[:, 0] - matrix_px[0, 2] - matrix_px[0, 1] * y) / matrix_px[0, 0]
    return np.stack([x, y], axis=1)


def _pixels(xy: FloatArray, matrix_px: FloatArray) -> FloatArray:
    pixels: FloatArray = xy @ matrix_px[:2, :2].T + matrix_px[:2, 2]
    return pixels


def _intrinsic_columns(xy: FloatArray) -> dict[str, FloatArray]:
    """Differentiate ``K @ (x, y, 1)`` by the entries of K; each column is (N, 2)."""
    zero, one = np.zeros(len(xy)), np.ones(len(xy))
    x, y = xy.T
    pairs = ((x, zero), (zero, y), (one, zero), (zero, one), (y, zero))
    return {name: np.stack(pair, axis=1) for name, pair in zip(INTRINSICS, pairs, strict=True)}


def _brown(
    xy: FloatArray, terms: tuple[float, float, float, float, float], *, order: int
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Evaluate Brown's polynomial.

    Parameters
    ----------
    xy : ndarray, shape (N, 2)
        Where.
    terms : tuple
        k1, k2, k3, px, py; px multiplies (r^2 + 2x^2, 2xy), py multiplies (2xy, r^2 + 2y^2).
    order : int
        0: displacement only; 1: and its Jacobian by (x, y); 2: and by the five terms.

    Returns
    -------
    displacement, by_xy, by_term : ndarrays, shapes (N, 2), (N, 2, 2), (N, 2, 5)
        Those not asked for are empty.
    """
    k1, k2, k3, px, py = terms
    x, y = xy[:, 0], xy[:, 1]
    r2 = x * x + y * y
    radial = r2 * (k1 + r2 * (k2 + r2 * k3))
    along_x = np.stack([r2 + 2 * x * x, 2 * x * y], axis=1)
    along_y = np.stack([2 * x * y, r2 + 2 * y * y], axis=1)
    displacement = xy * radial[:, None] + px * along_x + py * along_y
    by_xy = by_term = np.empty(0)
    if order >= 1:
        slope = 2 * (k1 + r2 * (2 * k2 + 3 * k3 * r2))  # d radial / d r2, times two
        cross = slope * x * y + 2 * (px * y + py * x)
        dxx = radial + slope * x * x + 6 * px * x + 2 * py * y
        dyy = radial + slope * y * y + 2 * px * x + 6 * py * y
        by_xy = np.stack([np.stack([dxx, cross], 1), np.stack([cross, dyy], 1)], axis=1)
    if order >= 2:
        powers = np.stack([r2, r2**2, r2**3], axis=1)
        by_term = np.concatenate(
            [xy[:, :, None] * powers[:, None, :], along_x[:, :, None], along_y[:, :, None]], axis=2
        )
    return displacement, by_xy, by_term


def _solve_plus_brown(
    target: FloatArray, terms: tuple[float, float, float, float, float]
) -> FloatArray:
    """Solve ``xy + brown(xy) = target`` by Newton's method; NaN where it does not converge."""
    xy = np.array(target, dtype=np.float64)
    if not any(terms):
        return xy
    scale = 1.0 + np.abs(target).max(axis=1, initial=0.0)
    settled = np.zeros(len(xy), dtype=bool)
    with np.errstate(invalid="ignore", over="ignore", divide="ignore"):
        for _ in range(_NEWTON_STEPS):
            shift, by_xy, _ = _brown(xy, terms, order=1)
            miss = xy + shift - target
            a, b, d = 1 + by_xy[:, 0, 0], by_xy[:, 0, 1], 1 + by_xy[:, 1, 1]
            determinant = a * d - b * b
            step = np.stack([d * miss[:, 0] - b * miss[:, 1], a * miss[:, 1] - b * miss[:, 0]], 1)
            step /= determinant[:, None]
            xy = xy - step
            settled = np.abs(step).max(axis=1, initial=0.0) < _NEWTON_LIMIT * scale
            if settled[np.isfinite(target).all(axis=1)].all():
                break
    xy[~settled] = np.nan
    return xy
