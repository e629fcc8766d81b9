"""First guesses of a camera, from known points alone."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from closerange.geometry.arrays import FloatArray
from closerange.geometry.transform import RigidTransform
from closerange.rig.camera import Camera
from closerange.rig.decompose import camera_from_matrix
from closerange.rig.view import View

FOCAL_LADDER = (0.5, 1, 2, 4, 8, 16)
"""Focal lengths over image size that are tried: from fish-eyes to telephoto lenses."""


def square_pixels(view: View, matrix: FloatArray) -> Camera:
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
    for focal in max(view.size_px) * np.array(FOCAL_LADDER):
        depth = focal / max(scales.mean(), np.finfo(float).tiny)
        shift = depth * np.append((affine[:, 3] - centre) / focal, 1.0)
        k = np.array([[focal, 0, centre[0]], [0, focal, centre[1]], [0, 0, 1]])
        pose = RigidTransform(rotation, shift - rotation @ middle)
        camera = Camera(view.name, view.size_px, k, pose)
        miss = np.nan_to_num(view.xy_px - camera.project(view.xyz_mm), nan=1e6)
        found.append((float(np.sum(miss**2)), camera))
    return [camera for _, camera in sorted(found, key=lambda pair: pair[0])][:2]
