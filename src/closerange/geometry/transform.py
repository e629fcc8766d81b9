"""Rigid transforms between right-handed frames."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from closerange.geometry.arrays import FloatArray, frozen_array

_IDENTITY = np.eye(3)
_ROUNDED = 1e-6 + 1e-5 * _IDENTITY  # of products whose factors were written with six digits


@dataclass(frozen=True, slots=True, eq=False)
class RigidTransform:
    """A rotation followed by a translation, named ``target_from_source``.

    Attributes
    ----------
    rotation : ndarray, shape (3, 3)
        Proper rotation matrix R.
    translation_mm : ndarray, shape (3,)
        Translation t in mm; ``x_target = R @ x_source + t``.

    Raises
    ------
    ValueError
        If R is not orthonormal to 1e-6 or is a reflection (det R = -1).
    """

    rotation: FloatArray
    translation_mm: FloatArray

    def __post_init__(self) -> None:
        rotation = frozen_array(self.rotation, (3, 3), "rotation")
        if not (np.abs(rotation @ rotation.T - _IDENTITY) <= _ROUNDED).all():  # NaN is not either
            raise ValueError("rotation is not orthonormal (limit 1e-6)")
        if np.linalg.det(rotation) < 0:
            raise ValueError("rotation is a reflection (det R = -1); axes must be right-handed")
        object.__setattr__(self, "rotation", rotation)
        object.__setattr__(
            self, "translation_mm", frozen_array(self.translation_mm, (3,), "translation_mm")
        )

    def apply(self, xyz_mm: ArrayLike) -> FloatArray:
        """Carry points from the source to the target frame.

        Parameters
        ----------
        xyz_mm : array_like, shape (..., 3)
            Points in the source frame, mm.

        Returns
        -------
        ndarray, shape (..., 3)
            The same points in the target frame, mm.
        """
        return np.asarray(xyz_mm, dtype=np.float64) @ self.rotation.T + self.translation_mm

    def inverse(self) -> RigidTransform:
        """Return ``source_from_target``."""
        return RigidTransform(self.rotation.T, -self.rotation.T @ self.translation_mm)

    def after(self, first: RigidTransform) -> RigidTransform:
        """Chain two transforms: ``a_from_b.after(b_from_c)`` is ``a_from_c``."""
        return RigidTransform(
            self.rotation @ first.rotation,
            self.rotation @ first.translation_mm + self.translation_mm,
        )


def rotation_from_vector(vector_rad: ArrayLike) -> FloatArray:
    """Return the rotation matrix of a rotation vector (Rodrigues' formula).

    Parameters
    ----------
    vector_rad : array_like, shape (3,)
        Axis times angle, rad.

    Returns
    -------
    ndarray, shape (3, 3)
        Rotation matrix.
    """
    vector = np.asarray(vector_rad, dtype=np.float64)
    angle = math.sqrt(float(vector @ vector))
    cross = cross_matrix(vector)
    # series near zero: sin(a)/a and (1 - cos a)/a^2 lose all digits there
    first = 1 - angle**2 / 6 if angle < 1e-4 else math.sin(angle) / angle
    second = 0.5 - angle**2 / 24 if angle < 1e-4 else (1 - math.cos(angle)) / angle**2
    rotation: FloatArray = _IDENTITY + first * cross + second * (cross @ cross)
    return rotation


def cross_matrix(vector: ArrayLike) -> FloatArray:
    """Return the matrix [v]x with ``[v]x @ w = v x w``.

    Parameters
    ----------
    vector : array_like, shape (3,)
        The vector v.

    Returns
    -------
    ndarray, shape (3, 3)
        Skew-symmetric.
    """
    x, y, z = np.asarray(vector, dtype=np.float64).tolist()
    return np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
