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

        residual = self.seen.copy()
        residual[0] -= fx * xd + skew * yd + cx
        residual[1] -= fy * yd + cy
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
