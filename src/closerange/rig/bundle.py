"""Cameras and placements in unknown poses adjusted together: a bundle adjustment.

The world is the target's frame in the first placement, which therefore has no parameters.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from closerange.errors import GeometryError
from closerange.geometry.arrays import BoolArray, FloatArray, IntArray
from closerange.geometry.least_squares import LeastSquaresFit, levenberg_marquardt
from closerange.geometry.transform import RigidTransform, rotation_from_vector
from closerange.rig.camera import Camera
from closerange.rig.fit import Fit, take_apart
from closerange.rig.projector import left_jacobian
from closerange.rig.view import whiten

MAX_ITERATIONS = 200
"""A usual bundle needs ten steps from OpenCV's start."""


@dataclass(frozen=True, slots=True, eq=False)
class Sightings:
    """Points of a target seen in its placements; N rows.

    Attributes
    ----------
    camera, placement : ndarray of int, shape (N,)
        Indices.
    target_mm : ndarray, shape (N, 3)
        Known positions in the target's frame.
    xy_px : ndarray, shape (N, 2)
        Where they are seen.
    whitener : ndarray, shape (N, 3), or None
        As in `View`; None for unit weights.
    """

    camera: IntArray
    placement: IntArray
    target_mm: FloatArray
    xy_px: FloatArray
    whitener: FloatArray | None = None

    def __len__(self) -> int:
        return len(self.xy_px)

    def select(self, rows: BoolArray) -> Sightings:
        """Keep some rows."""
        whitener = None if self.whitener is None else self.whitener[rows]
        return Sightings(
            self.camera[rows],
            self.placement[rows],
            self.target_mm[rows],
            self.xy_px[rows],
            whitener,
        )

    def weighted(self, whitener: FloatArray | None) -> Sightings:
        """Return the same points with other weights."""
        return Sightings(self.camera, self.placement, self.target_mm, self.xy_px, whitener)


@dataclass(frozen=True, slots=True, eq=False)
class Bundle:
    """Cameras and placements.

    Attributes
    ----------
    cameras : tuple of Camera
        In the world.
    poses : tuple of RigidTransform
        World from target, mm; the first is the identity.
    free : tuple of str
        Estimated parameters of each camera.
    """

    cameras: tuple[Camera, ...]
    poses: tuple[RigidTransform, ...]
    free: tuple[str, ...]

    @property
    def camera_count(self) -> int:
        """Number of the cameras' parameters, which come before those of the placements."""
        return len(self.free) * len(self.cameras)

    @property
    def count(self) -> int:
        """Number of parameters."""
        return self.camera_count + 6 * (len(self.poses) - 1)

    def possible(self, x: FloatArray) -> bool:
        """Whether changes leave all focal lengths positive."""
        changes = x[: self.camera_count].reshape(len(self.cameras), -1)
        return all(
            camera.parameter(name) + change[self.free.index(name)] > 0
            for camera, change in zip(self.cameras, changes, strict=True)
            for name in ("fx", "fy")
        )

    def at(self, x: FloatArray) -> Bundle:
        """Return the state with changes added to all parameters."""
        changes = x[: self.camera_count].reshape(len(self.cameras), -1)
        cameras = tuple(
            camera.moved(dict(zip(self.free, change, strict=True)))
            for camera, change in zip(self.cameras, changes, strict=True)
        )
        poses = [self.poses[0]]
        turns = x[self.camera_count :].reshape(-1, 6)
        for pose, change in zip(self.poses[1:], turns, strict=True):
            rotation = rotation_from_vector(change[:3]) @ pose.rotation
            poses.append(RigidTransform(rotation, pose.translation_mm + change[3:]))
        return Bundle(cameras, tuple(poses), self.free)

    def world_mm(self, placement: IntArray, target_mm: FloatArray) -> FloatArray:
        """Return points of placements in the world, shape (N, 3)."""
        world = np.empty_like(target_mm)
        for i, pose in enumerate(self.poses):
            rows = placement == i
            world[rows] = pose.apply(target_mm[rows])
        return world

    def by_world(self, seen: Sightings) -> FloatArray:
        """Return d calculated / d point in the world, shape (N, 2, 3)."""
        world = self.world_mm(seen.placement, seen.target_mm)
        jacobian = np.empty((len(seen), 2, 3))
        for i, camera in enumerate(self.cameras):
            rows = seen.camera == i
            jacobian[rows] = camera.project_jacobian(world[rows])
        return jacobian

    def residuals(self, seen: Sightings) -> FloatArray:
        """Return observed minus calculated, shape (N, 2)."""
        world = self.world_mm(seen.placement, seen.target_mm)
        residual = np.empty_like(seen.xy_px)
        for i, camera in enumerate(self.cameras):
            rows = seen.camera == i
            residual[rows] = seen.xy_px[rows] - camera.project(world[rows])
        return residual

    def columns(self, seen: Sightings) -> FloatArray:
        """Return d calculated / d parameters, shape (P, 2, N)."""
        world = self.world_mm(seen.placement, seen.target_mm)
        full = np.zeros((self.count, 2, len(world)))
        width = len(self.free)
        for i, camera in enumerate(self.cameras):
            rows = np.flatnonzero(seen.camera == i)
            own = camera.parameter_jacobian(world[rows], self.free)
            full[i * width : (i + 1) * width, :, rows] = np.moveaxis(own, 0, 2).swapaxes(0, 1)
        by_point = self.by_world(seen)
        for j, pose in enumerate(self.poses[1:]):
            rows = np.flatnonzero(seen.placement == j + 1)
            arms = world[rows] - pose.translation_mm
            turned = np.cross(arms[:, None, :], by_point[rows])  # row . -[a]x = a x row
            own = np.concatenate([turned, by_point[rows]], axis=2)
            start = self.camera_count + 6 * j
            full[start : start + 6, :, rows] = np.moveaxis(own, 0, 2).swapaxes(0, 1)
        return full

    def turns_as_added(self, x: FloatArray) -> FloatArray:
        """Return d (small turn at x) / d x: the identity but for the rotation vectors at x."""
        change = np.eye(len(x))
        turn = self.free.index("rx")
        starts = [i * len(self.free) + turn for i in range(len(self.cameras))]
        for start in (*starts, *range(self.camera_count, len(x), 6)):
            change[start : start + 3, start : start + 3] = left_jacobian(x[start : start + 3])
        return change


@dataclass(frozen=True, slots=True, eq=False)
class BundleFit(Fit):
    """An adjusted bundle and what the fit knows of itself.

    Attributes
    ----------
    bundle : Bundle
        The estimate.
    """

    bundle: Bundle


def fit_bundle(seen: Sightings, start: Bundle) -> BundleFit:
    """Adjust cameras and placements by least squares of the (whitened) image residuals.

    Parameters
    ----------
    seen : Sightings
        Points; more numbers than parameters.
    start : Bundle
        Where to begin.

    Returns
    -------
    BundleFit
        The estimate; not converged if the search gave up.

    Raises
    ------
    GeometryError
        If the placements are too few or too alike to tell the parameters apart.
    """
    if seen.xy_px.size <= start.count:
        raise GeometryError(
            f"{len(seen)} points give {seen.xy_px.size} numbers for {start.count} parameters",
            remedy="show the target in more placements, or choose a model with fewer parameters",
        )
    bundle, search = descend(seen, start)
    white, columns = whitened(bundle, seen)
    if not (np.isfinite(white).all() and np.isfinite(columns).all()):
        raise GeometryError(
            "some points cannot be projected by the adjusted cameras",
            remedy="check the names of points and placements, or choose a smaller model",
        )
    factors = take_apart(columns)
    if len(factors.indistinct):
        raise GeometryError(
            "the placements do not determine the cameras: their poses are too alike",
            remedy="tilt the target by 20 to 40 degrees about different axes",
        )
    return BundleFit(
        residual_px=bundle.residuals(seen),
        whitened=white.T,
        orthonormal=factors.orthonormal,
        root=factors.root,
        condition=factors.condition,
        iterations=search.iterations,
        converged=search.converged,
        bundle=bundle,
    )


def descend(
    seen: Sightings, start: Bundle, *, max_iterations: int = MAX_ITERATIONS
) -> tuple[Bundle, LeastSquaresFit]:
    """Search the least squares without asking what they are worth; see `fit_bundle`."""
    beyond = np.full(seen.xy_px.size, np.nan), np.zeros((seen.xy_px.size, start.count))

    def function(x: FloatArray) -> tuple[FloatArray, FloatArray]:
        if not start.possible(x):
            return beyond
        white, columns = whitened(start.at(x), seen)
        jacobian = columns.reshape(start.count, -1).T
        return white.ravel(), -jacobian @ start.turns_as_added(x)

    size, _ = whiten(seen.whitener, seen.xy_px.T, np.zeros((0, 2, len(seen))))
    search = levenberg_marquardt(
        function,
        np.zeros(start.count),
        max_iterations=max_iterations,
        step_limit=1e-9,
        terms=float(np.sum(size**2)),
    )
    return start.at(search.x), search


def whitened(bundle: Bundle, seen: Sightings) -> tuple[FloatArray, FloatArray]:
    """Return residuals (2, N) and their Jacobian's columns (P, 2, N), in standard deviations."""
    return whiten(seen.whitener, bundle.residuals(seen).T, bundle.columns(seen))
