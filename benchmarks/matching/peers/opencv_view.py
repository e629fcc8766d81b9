"""A camera for OpenCV's functions, which know no skew: it is a shear of the finished image."""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]


class OpenCvView:
    """Camera with a Brown lens (attributes ``k1 k2 p1 p2 k3``), pose and skew."""

    def __init__(self, camera: Any) -> None:
        lens = camera.distortion
        self.matrix = np.array(camera.matrix_px, np.float64)
        self._shear = self.matrix[0, 1] / self.matrix[1, 1]
        self.matrix[0, 1] = 0.0
        self.lens = np.array([lens.k1, lens.k2, lens.p1, lens.p2, lens.k3], np.float64)
        self.rotation = np.array(camera.camera_from_world.rotation, np.float64)
        self.shift = np.array(camera.camera_from_world.translation_mm, np.float64)
        self.size = tuple(camera.size_px)

    @property
    def projection(self) -> FloatArray:
        """World to ideal px, shape (3, 4)."""
        return np.asarray(self.matrix @ np.column_stack([self.rotation, self.shift]))

    @property
    def centre(self) -> FloatArray:
        """Projection centre in the world."""
        return np.asarray(-self.rotation.T @ self.shift)

    def project(self, xyz: FloatArray) -> FloatArray:
        """Return observed px, shape (N, 2)."""
        if not len(xyz):
            return np.empty((0, 2))
        turn = cv2.Rodrigues(self.rotation)[0]
        shown = cv2.projectPoints(xyz, turn, self.shift, self.matrix, self.lens)[0].reshape(-1, 2)
        return self._sheared(shown, 1.0)

    def ideal(self, xy: FloatArray) -> FloatArray:
        """Return px without lens, shape (N, 2), for `projection`."""
        if not len(xy):
            return np.empty((0, 2))
        plain = self._sheared(np.asarray(xy, np.float64), -1.0)
        return np.asarray(
            cv2.undistortPoints(plain, self.matrix, self.lens, P=self.matrix).reshape(-1, 2)
        )

    def maps(
        self, turn: FloatArray, matrix: FloatArray, size: tuple[int, int]
    ) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """Return maps for `cv2.remap` into a turned camera without lens."""
        x, y = cv2.initUndistortRectifyMap(self.matrix, self.lens, turn, matrix, size, cv2.CV_32FC1)
        return x + np.float32(self._shear) * (y - np.float32(self.matrix[1, 2])), y

    def _sheared(self, xy: FloatArray, sense: float) -> FloatArray:
        sheared = np.array(xy, np.float64)
        sheared[:, 0] += sense * self._shear * (sheared[:, 1] - self.matrix[1, 2])
        return sheared


def sweep_axis(views: tuple[OpenCvView, OpenCvView]) -> int:
    """Return the world axis along which the cameras look most nearly."""
    return int(np.argmax(np.abs(views[0].rotation[2] + views[1].rotation[2])))


def on_plane(view: OpenCvView, xy: FloatArray, axis: int, height: FloatArray) -> FloatArray:
    """Return where the rays of pixels meet the planes of constant world coordinate."""
    ideal = np.column_stack([view.ideal(xy), np.ones(len(xy))])
    rays = ideal @ np.linalg.inv(view.matrix).T @ view.rotation
    way = (height - view.centre[axis]) / rays[:, axis]
    return np.asarray(view.centre + way[:, None] * rays)


def sweep_heights(
    views: tuple[OpenCvView, OpenCvView], xy: FloatArray, axis: int, volume: FloatArray
) -> FloatArray:
    """Return plane heights 1 px apart in the second view, for the median point."""
    low, high = volume[:, axis]
    middle = np.median(xy, axis=0)[None]
    # evenly in 1 / distance a point moves evenly in the image
    near, far = sorted((low - views[0].centre[axis], high - views[0].centre[axis]), key=abs)
    fine = views[0].centre[axis] + 1 / np.linspace(1 / near, 1 / far, 2000)
    seen = views[1].project(on_plane(views[0], np.repeat(middle, len(fine), axis=0), axis, fine))
    way = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(seen, axis=0), axis=1))])
    steps = np.arange(0.0, way[-1] + 1.0)
    return np.interp(steps, way, fine)
