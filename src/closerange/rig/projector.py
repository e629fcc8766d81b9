"""Projection with all derivatives in one go: the inner loop of the least-squares fit."""

from __future__ import annotations

import math

import numpy as np

from closerange.geometry.arrays import FloatArray
from closerange.geometry.transform import RigidTransform, cross_matrix
from closerange.rig.camera import POSE, Camera
from closerange.rig.distortion import BrownIdeal
from closerange.rig.view import View

LENS = ("fx", "fy", "cx", "cy", "skew", "k1", "k2", "k3", "p1", "p2")
PARAMETERS = (*LENS, *POSE)

Values = tuple[FloatArray, FloatArray, FloatArray]
"""The ten values of `LENS`, rotation and translation of the centred points."""


class Projector:
    """Projection of centred points with all derivatives, without detours: the inner loop."""

    def __init__(self, view: View, camera: Camera) -> None:
        pose, matrix, lens = camera.camera_from_world, camera.matrix_px, camera.distortion
        if not isinstance(lens, BrownIdeal):
            raise TypeError(f"the lens is a {type(lens).__name__}, not a BrownIdeal")
        self.view = view
        self.middle = view.xyz_mm.mean(axis=0)
        self.centred = np.ascontiguousarray((view.xyz_mm - self.middle).T)
        self.seen = np.ascontiguousarray(view.xy_px.T)
        self.rotation = pose.rotation
        self.shift = pose.rotation @ self.middle + pose.translation_mm
        intrinsics = (matrix[0, 0], matrix[1, 1], matrix[0, 2], matrix[1, 2], matrix[0, 1])
        self.lens = np.array([*intrinsics, lens.k1, lens.k2, lens.k3, lens.p1, lens.p2])

    def values(self) -> Values:
        """Return lens, rotation and shift of the start."""
        return self.lens, self.rotation, self.shift

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
        fx, fy, cx, cy, skew, k1, k2, k3, p1, p2 = lens.tolist()  # Python's numbers are quicker
        turned = rotation @ self.centred
        depth = turned[2] + shift[2]
        # NaN makes the search step back: points behind the camera, mirrored images
        valid = (depth > 0) & bool(fx > 0 and fy > 0)
        per_depth = 1.0 / np.where(valid, depth, np.nan)
        # x and y stand in two rows: one call of NumPy does for both
        point = (turned[:2] + shift[:2, None]) * per_depth
        x, y = point
        square, twice_xy = point * point, 2 * x * y
        r2 = square[0] + square[1]
        along = r2 + 2 * square
        radial = 1 + r2 * (k1 + r2 * (k2 + r2 * k3))
        seen = point * radial
        seen[0] += p1 * twice_xy + p2 * along[0]
        seen[1] += p1 * along[1] + p2 * twice_xy

        focal = np.array([[fx], [fy]])
        jacobian = np.zeros((len(PARAMETERS), 2, x.size))
        jacobian[0, 0], jacobian[1, 1], jacobian[4, 0] = seen[0], seen[1], seen[1]
        jacobian[2, 0] = jacobian[3, 1] = 1.0
        np.multiply(focal * point, r2, out=jacobian[5])
        np.multiply(jacobian[5], r2, out=jacobian[6])
        np.multiply(jacobian[6], r2, out=jacobian[7])
        jacobian[8, 0], jacobian[8, 1] = fx * twice_xy, fy * along[1]
        jacobian[9, 0], jacobian[9, 1] = fx * along[0], fy * twice_xy

        slope = 2 * (k1 + r2 * (2 * k2 + 3 * k3 * r2))
        bent = np.array([[p2], [p1]]) * point
        straight = (radial + slope * square + 6 * bent + 2 * bent[::-1]) * per_depth
        crossed = (0.5 * slope * twice_xy + 2 * p1 * x + 2 * p2 * y) * per_depth
        by_x, by_y, by_z = jacobian[13], jacobian[14], jacobian[15]
        by_x[0], by_x[1] = fx * straight[0], fy * crossed
        by_y[0], by_y[1] = fx * crossed, fy * straight[1]
        if skew:
            jacobian[5:10, 0] += (skew / fy) * jacobian[5:10, 1]
            by_x[0] += skew * crossed
            by_y[0] += skew * straight[1]
        np.multiply(-x, by_x, out=by_z)
        by_z -= y * by_y
        # d(exp(w) R X)/dw = -[R X]x, hence row . d/dw = (R X) x row
        jacobian[10] = turned[1] * by_z - turned[2] * by_y
        jacobian[11] = turned[2] * by_x - turned[0] * by_z
        jacobian[12] = turned[0] * by_y - turned[1] * by_x

        residual = self.seen - focal * seen
        residual[0] -= skew * seen[1] + cx
        residual[1] -= cy
        return residual, jacobian


def left_jacobian(vector: FloatArray) -> FloatArray:
    """D exp(w + dw) = exp(J dw) exp(w): what a change of the rotation vector turns by."""
    angle = math.sqrt(float(vector @ vector))
    cross = cross_matrix(vector)
    # series near zero, where the closed forms lose all digits
    first = 0.5 - angle**2 / 24 if angle < 1e-3 else (1 - math.cos(angle)) / angle**2
    second = 1 / 6 - angle**2 / 120 if angle < 1e-3 else (angle - math.sin(angle)) / angle**3
    jacobian: FloatArray = np.eye(3) + first * cross + second * (cross @ cross)
    return jacobian
