"""COLMAP: bundle adjustment with constant points, camera model OPENCV (k1 k2 p1 p2).

`pycolmap` with every point held constant, focal lengths, principal points and lenses free.
COLMAP puts (0.5, 0.5) at the centre of the top-left pixel. https://colmap.github.io/cameras.html
Positions are the linear intersection of its undistorted rays.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import pycolmap
from numpy.typing import NDArray

from peers.linear_start import start

FloatArray = NDArray[np.float64]

HALF_PX = 0.5


@dataclass(frozen=True, slots=True, eq=False)
class Calibrated:
    """COLMAP's cameras and their [R | t]."""

    cameras: list[Any]
    poses: list[FloatArray]

    def positions(self, xy_px: Sequence[FloatArray]) -> FloatArray:
        """Intersect the rays of all cameras linearly, shape (M, 3) in mm."""
        rows = []
        for camera, pose, seen in zip(self.cameras, self.poses, xy_px, strict=True):
            ray = np.asarray(camera.cam_from_img(seen + HALF_PX))[:, :2]
            rows += [pose[axis] - ray[:, axis, None] * pose[2] for axis in (0, 1)]
        system = np.stack(rows, axis=1)
        a, b = system[:, :, :3], -system[:, :, 3:]
        at = np.swapaxes(a, 1, 2)
        return np.linalg.solve(at @ a, at @ b)[..., 0]


def calibrate(
    xyz_mm: FloatArray, xy_px: Sequence[FloatArray], sizes_px: Sequence[tuple[int, int]]
) -> Calibrated:
    """Adjust all cameras to constant points."""
    scene = pycolmap.Reconstruction()
    for number, (seen, size) in enumerate(zip(xy_px, sizes_px, strict=True), start=1):
        matrix, rotation, shift = start(xyz_mm, seen, size)
        middle = matrix[:2, 2] + HALF_PX
        camera = pycolmap.Camera(
            camera_id=number,
            model="OPENCV",
            width=size[0],
            height=size[1],
            params=[matrix[0, 0], matrix[1, 1], *middle, 0, 0, 0, 0],
        )
        scene.add_camera_with_trivial_rig(camera)
        image = pycolmap.Image(
            name=str(number),
            camera_id=number,
            image_id=number,
            points2D=pycolmap.Point2DList([pycolmap.Point2D(xy) for xy in seen + HALF_PX]),
        )
        pose = pycolmap.Rigid3d(pycolmap.Rotation3d(rotation), shift)
        scene.add_image_with_trivial_frame(image, pose)
    for index, xyz in enumerate(xyz_mm):
        track = pycolmap.Track()
        for number in range(1, len(xy_px) + 1):
            track.add_element(number, index)
        scene.add_point3D(xyz, track)
    _adjust(scene)
    return Calibrated(
        [scene.cameras[number] for number in range(1, len(xy_px) + 1)],
        [scene.images[n].cam_from_world().matrix() for n in range(1, len(xy_px) + 1)],
    )


def _adjust(scene: Any) -> None:
    """Free all parameters of the cameras and none of the points."""
    config = pycolmap.BundleAdjustmentConfig()
    for number in scene.images:
        config.add_image(number)
    for number in scene.points3D:
        config.add_constant_point(number)
    options = pycolmap.BundleAdjustmentOptions()
    options.refine_principal_point = True
    options.print_summary = False
    pycolmap.create_default_bundle_adjuster(options, config, scene).solve()
