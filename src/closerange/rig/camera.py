"""One calibrated camera."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import ArrayLike

from closerange.geometry.arrays import FloatArray, frozen_array
from closerange.geometry.transform import RigidTransform, rotation_from_vector
from closerange.rig.distortion import COEFFICIENTS, INTRINSICS, BrownIdeal, Distortion

POSE = ("rx", "ry", "rz", "tx", "ty", "tz")
"""Small rotation (rad, about the camera's axes, applied after R) and translation (mm)."""


@dataclass(frozen=True, slots=True, eq=False)
class Camera:
    """A camera in the world: matrix, lens and pose.

    A point X (mm, world) lies at ``X_cam = R X + t`` in the camera's frame (x right, y down,
    z forward), its ideal pixel is ``K X_cam`` dehomogenised, its observed pixel is the ideal
    one warped by the lens.

    Attributes
    ----------
    name : str
        As in the tables.
    size_px : tuple of int
        Image width and height.
    matrix_px : ndarray, shape (3, 3)
        ``[[fx, skew, cx], [0, fy, cy], [0, 0, 1]]`` in px.
    camera_from_world : RigidTransform
        Pose, mm.
    distortion : Distortion
        Lens.
    """

    name: str
    size_px: tuple[int, int]
    matrix_px: FloatArray
    camera_from_world: RigidTransform
    distortion: Distortion = field(default_factory=BrownIdeal)

    def __post_init__(self) -> None:
        matrix = frozen_array(self.matrix_px, (3, 3), "matrix_px")
        lower = (matrix[1, 0], matrix[2, 0], matrix[2, 1], matrix[2, 2] - 1)
        if any(lower) or matrix[0, 0] <= 0 or matrix[1, 1] <= 0:
            raise ValueError("matrix_px must be upper triangular with fx, fy > 0 and 1 at the end")
        object.__setattr__(self, "matrix_px", matrix)
        object.__setattr__(self, "size_px", (int(self.size_px[0]), int(self.size_px[1])))

    @property
    def projection_matrix(self) -> FloatArray:
        """P = K [R | t], shape (3, 4): world (mm) to homogeneous ideal px."""
        pose = self.camera_from_world
        matrix: FloatArray = self.matrix_px @ np.column_stack([pose.rotation, pose.translation_mm])
        return matrix

    @property
    def centre_mm(self) -> FloatArray:
        """Projection centre in the world, shape (3,)."""
        return self.camera_from_world.inverse().translation_mm

    def depth_mm(self, xyz_mm: ArrayLike) -> FloatArray:
        """Return z in the camera's frame, shape (N,); negative behind the camera."""
        return self.camera_from_world.apply(np.reshape(xyz_mm, (-1, 3)))[:, 2]

    def project(self, xyz_mm: ArrayLike) -> FloatArray:
        """Return where points are seen.

        Parameters
        ----------
        xyz_mm : array_like, shape (N, 3)
            World points in mm.

        Returns
        -------
        ndarray, shape (N, 2)
            Observed px; NaN for points not in front of the camera or beyond the lens model.
        """
        return self.distortion.distort(self._ideal(self._in_camera(xyz_mm)), self.matrix_px)

    def undistort(self, xy_px: ArrayLike) -> FloatArray:
        """Return the ideal px of observed px, shape (N, 2)."""
        return self.distortion.undistort(
            np.reshape(xy_px, (-1, 2)).astype(np.float64), self.matrix_px
        )

    def directions(self, xy_px: ArrayLike) -> FloatArray:
        """Return unit vectors in the world along which px are seen.

        Parameters
        ----------
        xy_px : array_like, shape (N, 2)
            Observed px.

        Returns
        -------
        ndarray, shape (N, 3)
            From `centre_mm` into the scene.
        """
        ideal = self.undistort(xy_px)
        rays = np.column_stack([ideal, np.ones(len(ideal))]) @ np.linalg.inv(self.matrix_px).T
        rays = rays @ self.camera_from_world.rotation
        unit: FloatArray = rays / np.linalg.norm(rays, axis=1, keepdims=True)
        return unit

    def project_jacobian(self, xyz_mm: ArrayLike) -> FloatArray:
        """Return d observed px / d world mm, shape (N, 2, 3)."""
        in_camera = self._in_camera(xyz_mm)
        by_camera = self._by_camera_point(in_camera)
        jacobian: FloatArray = by_camera @ self.camera_from_world.rotation
        return jacobian

    def parameter_jacobian(self, xyz_mm: ArrayLike, names: Sequence[str]) -> FloatArray:
        """Return d observed px / d parameters.

        Parameters
        ----------
        xyz_mm : array_like, shape (N, 3)
            World points in mm.
        names : sequence of str
            Of ``fx fy cx cy skew k1 k2 k3 p1 p2 rx ry rz tx ty tz``.

        Returns
        -------
        ndarray, shape (N, 2, P)
            In px per unit of the parameter.
        """
        in_camera = self._in_camera(xyz_mm)
        jacobian = np.empty((len(in_camera), 2, len(names)))
        lens = [name for name in names if name in INTRINSICS + COEFFICIENTS]
        if lens:
            ideal = self._ideal(in_camera)
            jacobian[:, :, [names.index(name) for name in lens]] = (
                self.distortion.parameter_jacobian(ideal, self.matrix_px, lens)
            )
        pose = [name for name in names if name in POSE]
        if pose:
            by_camera = self._by_camera_point(in_camera)
            rotated = in_camera - self.camera_from_world.translation_mm
            # d(exp(w) R X)/dw = -[R X]x, hence row . d/dw = (R X) x row
            by_rotation = np.cross(rotated[:, None, :], by_camera)
            full = np.concatenate([by_rotation, by_camera], axis=2)
            jacobian[:, :, [names.index(name) for name in pose]] = full[
                :, :, [POSE.index(name) for name in pose]
            ]
        return jacobian

    def moved(self, changes: Mapping[str, float]) -> Camera:
        """Return the camera with changes added to parameters.

        Parameters
        ----------
        changes : mapping of str to float
            Names as in `parameter_jacobian`.

        Returns
        -------
        Camera
            A new camera.
        """
        delta = {name: changes.get(name, 0.0) for name in (*INTRINSICS, *POSE)}
        matrix = self.matrix_px + np.array(
            [[delta["fx"], delta["skew"], delta["cx"]], [0, delta["fy"], delta["cy"]], [0, 0, 0]]
        )
        pose = self.camera_from_world
        turn = rotation_from_vector([delta["rx"], delta["ry"], delta["rz"]])
        return replace(
            self,
            matrix_px=matrix,
            distortion=self.distortion.moved(
                **{name: float(changes[name]) for name in COEFFICIENTS if name in changes}
            ),
            camera_from_world=RigidTransform(
                turn @ pose.rotation,
                pose.translation_mm + np.array([delta[name] for name in POSE[3:]]),
            ),
        )

    def parameter(self, name: str) -> float:
        """Return the value of one parameter; rotations are relative to R, hence 0."""
        k, t = self.matrix_px, self.camera_from_world.translation_mm
        values = {
            **dict(zip(INTRINSICS, (k[0, 0], k[1, 1], k[0, 2], k[1, 2], k[0, 1]), strict=True)),
            **dict(zip(POSE, (0.0, 0.0, 0.0, *t), strict=True)),
            **{term: getattr(self.distortion, term) for term in COEFFICIENTS},
        }
        return float(values[name])

    def _in_camera(self, xyz_mm: ArrayLike) -> FloatArray:
        return self.camera_from_world.apply(np.reshape(np.asarray(xyz_mm, np.float64), (-1, 3)))

    def _ideal(self, in_camera: FloatArray) -> FloatArray:
        depth = np.where(in_camera[:, 2] > 0, in_camera[:, 2], np.nan)
        ideal: FloatArray = (in_camera[:, :2] / depth[:, None]) @ self.matrix_px[:2, :2].T
        return ideal + self.matrix_px[:2, 2]

    def _by_camera_point(self, in_camera: FloatArray) -> FloatArray:
        """D observed px / d point in the camera's frame, shape (N, 2, 3)."""
        ideal = self._ideal(in_camera)
        depth = np.where(in_camera[:, 2] > 0, in_camera[:, 2], np.nan)[:, None, None]
        homogeneous = np.broadcast_to(self.matrix_px[:2, :], (len(in_camera), 2, 3))
        by_camera = homogeneous.copy()
        by_camera[:, :, 2] -= ideal
        warped: FloatArray = self.distortion.jacobian(ideal, self.matrix_px) @ (by_camera / depth)
        return warped
