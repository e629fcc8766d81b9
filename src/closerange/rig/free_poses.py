"""Calibration from placements in unknown poses: a target that is simply held up.

The control points are given in the target's frame; the world frame is the target's frame in
the first placement. Starting values come from OpenCV (Zhang's method), then cameras and
placements are adjusted together.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import cv2
import numpy as np

from closerange.errors import GeometryError, InputError
from closerange.features.control import ControlPoints
from closerange.features.image_points import ImagePoints
from closerange.geometry.arrays import FloatArray, IntArray
from closerange.geometry.least_squares import levenberg_marquardt
from closerange.geometry.transform import RigidTransform, rotation_from_vector
from closerange.rig.camera import POSE, Camera
from closerange.rig.distortion import BrownIdeal
from closerange.rig.models import FREE, model_named
from closerange.rig.projector import left_jacobian
from closerange.rig.rig import Residuals, Rig

MIN_POINTS = 6
"""Points that a camera must see of a placement to use it."""

MIN_PLACEMENTS = 3
"""Placements that a plane needs for focal length and principal point (Zhang 2000,
doi:10.1109/34.888718)."""


@dataclass(frozen=True, slots=True, eq=False)
class _Views:
    """Usable rows: N points with camera and placement indices."""

    cameras: tuple[str, ...]
    placements: tuple[str, ...]
    points: ImagePoints
    camera: IntArray
    placement: IntArray
    xyz_mm: FloatArray  # in the target's frame

    def rows(self, camera: int, placement: int | None = None) -> IntArray:
        """Return the rows of a camera, or of a camera and a placement."""
        chosen = self.camera == camera
        if placement is not None:
            chosen = chosen & (self.placement == placement)
        return np.flatnonzero(chosen)


def calibrate_free_poses(
    points: ImagePoints,
    control: ControlPoints,
    size_px: Mapping[str, tuple[int, int]],
    *,
    model: str = "brown",
) -> Rig:
    """Calibrate cameras from placements of a target in unknown poses.

    Parameters
    ----------
    points : ImagePoints
        Image points; at least three differently tilted placements for each camera.
    control : ControlPoints
        Points in the target's frame, mm, without placements.
    size_px : mapping of str to (int, int)
        Width and height of each camera's images.
    model : str, optional
        Free parameters of each camera; ``auto`` means ``brown`` here.

    Returns
    -------
    Rig
        Cameras in the target's frame of the first placement; `volume_mm` is the bounding box of
        all points.

    Raises
    ------
    InputError
        If the model is a linear one, or an image size is missing.
    GeometryError
        If there are too few placements or a camera cannot be linked to the first placement.
    """
    name = "brown" if model == "auto" else model
    if name not in FREE:
        raise InputError(
            f"model {model!r} cannot be used with free poses",
            remedy=f"use one of {', '.join(FREE)}",
        )
    free = model_named(name).free
    views = _join(points, control, size_px)
    cameras, poses = _start(views, size_px, free)
    return _adjust(views, cameras, poses, name)


def _join(
    points: ImagePoints, control: ControlPoints, size_px: Mapping[str, tuple[int, int]]
) -> _Views:
    row = control.rows_of(points)
    usable = points.found & (row >= 0) & (points.flags == 0)
    pairs = list(zip(points.camera, points.placement, strict=True))
    counts = Counter(pair for pair, good in zip(pairs, usable, strict=True) if good)
    usable &= np.array([counts[pair] >= MIN_POINTS for pair in pairs], dtype=bool)
    kept, row = points.select(usable), row[usable]
    missing = [camera for camera in kept.cameras if camera not in size_px]
    if missing:
        raise InputError(
            f"the image size of camera {missing[0]!r} is not known",
            remedy=f"add --image-size {missing[0]}=WxH",
        )
    cameras = points.cameras  # one without usable points is named below, not dropped
    if not cameras:
        raise GeometryError("there are no image points", remedy="detect the target first")
    placements = tuple(dict.fromkeys(kept.placement))
    camera = np.array([cameras.index(name) for name in kept.camera], dtype=np.int64)
    index = {name: i for i, name in enumerate(placements)}
    placement = np.array([index[name] for name in kept.placement], dtype=np.int64)
    views = _Views(cameras, placements, kept, camera, placement, control.xyz_mm[row])
    for i, name in enumerate(cameras):
        if len(_good_placements(views, i)) < MIN_PLACEMENTS:
            raise GeometryError(
                f"camera {name!r} sees {len(_good_placements(views, i))} placements with "
                f"{MIN_POINTS} points or more; {MIN_PLACEMENTS} are needed",
                remedy="show the target in more, differently tilted poses",
            )
    return views


def _good_placements(views: _Views, camera: int) -> list[int]:
    counts = np.bincount(views.placement[views.rows(camera)], minlength=len(views.placements))
    return [int(i) for i in np.flatnonzero(counts >= MIN_POINTS)]


def _start(
    views: _Views, size_px: Mapping[str, tuple[int, int]], free: tuple[str, ...]
) -> tuple[list[Camera], list[RigidTransform]]:
    """Return cameras and world_from_target of each placement, linked through shared placements."""
    seen: list[dict[int, RigidTransform]] = []  # camera_from_target by placement
    cameras: list[Camera] = []
    for i, name in enumerate(views.cameras):
        camera, poses = _mono(views, i, size_px[name], free)
        cameras.append(camera)
        seen.append(poses)
    world: dict[int, RigidTransform] = {0: RigidTransform(np.eye(3), np.zeros(3))}
    placed: dict[int, RigidTransform] = {}
    while len(placed) < len(cameras):
        ready = [
            i for i in range(len(cameras)) if i not in placed and seen[i].keys() & world.keys()
        ]
        if not ready:
            lost = next(i for i in range(len(cameras)) if i not in placed)
            raise GeometryError(
                f"camera {views.cameras[lost]!r} shares no placement with the other cameras",
                remedy="show the target where this camera and another one see it together",
            )
        i = ready[0]
        link = min(seen[i].keys() & world.keys())
        placed[i] = seen[i][link].after(world[link].inverse())
        for placement, pose in seen[i].items():
            world.setdefault(placement, placed[i].inverse().after(pose))
    located = [replace(camera, camera_from_world=placed[i]) for i, camera in enumerate(cameras)]
    return located, [world[i] for i in range(len(views.placements))]


def _mono(
    views: _Views, camera: int, size_px: tuple[int, int], free: tuple[str, ...]
) -> tuple[Camera, dict[int, RigidTransform]]:
    """Calibrate one camera by OpenCV, as a start."""
    placements = _good_placements(views, camera)
    rows = [views.rows(camera, placement) for placement in placements]
    flags = 0 if "k3" in free else cv2.CALIB_FIX_K3
    flags |= 0 if "p1" in free else cv2.CALIB_ZERO_TANGENT_DIST
    flags |= 0 if "k2" in free else cv2.CALIB_FIX_K2
    flags |= 0 if "k1" in free else cv2.CALIB_FIX_K1
    name = views.cameras[camera]
    try:
        _, matrix, lens, turns, shifts = cv2.calibrateCamera(
            [views.xyz_mm[row].astype(np.float32) for row in rows],
            [views.points.xy_px[row].astype(np.float32) for row in rows],
            size_px,
            None,
            None,
            flags=flags,
        )
    except cv2.error as error:
        raise GeometryError(
            f"camera {name!r}: no starting values can be found from these placements",
            remedy="show a flat target in differently tilted poses",
        ) from error
    k1, k2, p1, p2, k3 = np.ravel(lens)[:5]
    poses = {
        placement: RigidTransform(rotation_from_vector(np.ravel(turn)), np.ravel(shift))
        for placement, turn, shift in zip(placements, turns, shifts, strict=True)
    }
    identity = RigidTransform(np.eye(3), np.zeros(3))
    brown = BrownIdeal(float(k1), float(k2), float(p1), float(p2), float(k3))
    return Camera(name, size_px, matrix, identity, brown), poses


@dataclass(frozen=True, slots=True, eq=False)
class _Bundle:
    """The adjustment: all cameras and all placements but the first, which is the world."""

    views: _Views
    cameras: list[Camera]
    poses: list[RigidTransform]
    free: tuple[str, ...]

    @property
    def count(self) -> int:
        """Number of parameters."""
        return len(self.free) * len(self.cameras) + 6 * (len(self.poses) - 1)

    def at(self, x: FloatArray) -> _Bundle:
        """Return the state with changes added to all parameters."""
        width = len(self.free)
        cameras = [
            camera.moved(dict(zip(self.free, x[i * width : (i + 1) * width], strict=True)))
            for i, camera in enumerate(self.cameras)
        ]
        turns = x[width * len(cameras) :].reshape(-1, 6)
        poses = [self.poses[0]]
        for pose, change in zip(self.poses[1:], turns, strict=True):
            rotation = rotation_from_vector(change[:3]) @ pose.rotation
            poses.append(RigidTransform(rotation, pose.translation_mm + change[3:]))
        return _Bundle(self.views, cameras, poses, self.free)

    def world_mm(self) -> FloatArray:
        """Return each row's point in the world."""
        world = np.empty_like(self.views.xyz_mm)
        for i, pose in enumerate(self.poses):
            rows = self.views.placement == i
            world[rows] = pose.apply(self.views.xyz_mm[rows])
        return world

    def residuals(self) -> FloatArray:
        """Return observed minus calculated, (N, 2)."""
        world, xy = self.world_mm(), self.views.points.xy_px
        residual = np.empty_like(xy)
        for i, camera in enumerate(self.cameras):
            rows = self.views.rows(i)
            residual[rows] = xy[rows] - camera.project(world[rows])
        return residual

    def jacobian(self) -> FloatArray:
        """Return d calculated / d parameters, (2N, P)."""
        world = self.world_mm()
        full = np.zeros((len(world), 2, self.count))
        width = len(self.free)
        for i, camera in enumerate(self.cameras):
            rows = self.views.rows(i)
            full[rows, :, i * width : (i + 1) * width] = camera.parameter_jacobian(
                world[rows], self.free
            )
            by_point = camera.project_jacobian(world[rows])
            for j, pose in enumerate(self.poses[1:], start=1):
                chosen = self.views.placement[rows] == j
                arms = world[rows[chosen]] - pose.translation_mm
                turned = np.cross(arms[:, None, :], by_point[chosen])  # row . -[a]x = a x row
                start = width * len(self.cameras) + 6 * (j - 1)
                full[rows[chosen], :, start : start + 3] = turned
                full[rows[chosen], :, start + 3 : start + 6] = by_point[chosen]
        return full.reshape(-1, self.count)


def _adjust(views: _Views, cameras: list[Camera], poses: list[RigidTransform], model: str) -> Rig:
    free = model_named(model).free
    start = _Bundle(views, cameras, poses, free)

    def function(x: FloatArray) -> tuple[FloatArray, FloatArray]:
        state = start.at(x)
        return state.residuals().ravel(), -state.jacobian() @ _turns_as_added(x, start)

    fit = levenberg_marquardt(function, np.zeros(start.count), step_limit=1e-9)
    state = start.at(fit.x)
    dof = 2 * len(views.points) - start.count
    variance = fit.cost / max(dof, 1)
    jacobian = state.jacobian()
    scale = np.maximum(np.linalg.norm(jacobian, axis=0), 1e-300)
    _, singular, vt = np.linalg.svd(jacobian / scale, full_matrices=False)
    if singular[-1] < 1e-10 * singular[0]:
        raise GeometryError(
            "the placements do not determine the cameras: their poses are too alike",
            remedy="tilt the target by 20 to 40 degrees about different axes",
        )
    full_cov = variance * (vt.T / singular**2) @ vt / np.outer(scale, scale)
    count = len(free) * len(cameras)
    world = state.world_mm()
    volume = np.stack([world.min(axis=0), world.max(axis=0)])
    names = tuple(f"{camera.name}.{name}" for camera in state.cameras for name in free)
    return Rig(
        cameras=tuple(state.cameras),
        volume_mm=volume,
        parameters=names,
        parameter_cov=0.5 * (full_cov + full_cov.T)[:count, :count],
        noise_px=float(np.sqrt(variance)),
        dof=dof,
        model=model,
        residuals=Residuals(
            camera=views.points.camera,
            placement=views.points.placement,
            point=views.points.point,
            xyz_mm=world,
            xy_px=views.points.xy_px,
            residual_px=state.residuals(),
            fitted=np.ones(len(world), dtype=bool),
            flags=np.zeros(len(world), dtype=np.int64),
        ),
        report=_report(state, full_cov, fit.converged, model),
    )


def _turns_as_added(x: FloatArray, bundle: _Bundle) -> FloatArray:
    """Return d (small turn at x) / d x: the identity but for the rotation vectors at x."""
    change = np.eye(len(x))
    width = len(bundle.free)
    starts = [i * width + bundle.free.index("rx") for i in range(len(bundle.cameras))]
    starts += list(range(width * len(bundle.cameras), len(x), 6))
    for start in starts:
        change[start : start + 3, start : start + 3] = left_jacobian(x[start : start + 3])
    return change


def _report(state: _Bundle, cov: FloatArray, converged: bool, model: str) -> dict[str, Any]:
    cameras: dict[str, Any] = {}
    std = np.sqrt(np.diag(cov))
    width = len(state.free)
    residual = state.residuals()
    for i, camera in enumerate(state.cameras):
        own = residual[state.views.rows(i)]
        cameras[camera.name] = {
            "parameters": {
                name: {
                    "value": camera.parameter(name),
                    "std": float(std[i * width + j]),
                    "free": True,
                }
                for j, name in enumerate(state.free)
                if name not in POSE
            },
            "rss_px2": float(np.sum(own**2)),
            "n": 2 * len(own),
            "converged": bool(converged),
        }
    return {
        "cameras": cameras,
        "fixed": model_named(model).fixed,
        "free_poses": {
            "world": f"target's frame in placement {state.views.placements[0]!r}",
            "placements": len(state.poses),
        },
    }
