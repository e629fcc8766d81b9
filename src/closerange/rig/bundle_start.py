"""Starting values of a bundle: each camera by OpenCV (Zhang's method), then linked together."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import cv2
import numpy as np

from closerange.errors import GeometryError
from closerange.geometry.arrays import FloatArray, IntArray
from closerange.geometry.transform import RigidTransform, rotation_from_vector
from closerange.rig.bundle import Bundle, Sightings
from closerange.rig.camera import Camera
from closerange.rig.distortion import BrownIdeal
from closerange.rig.outliers import FAR, ROUNDING_PX

MIN_POINTS = 6
"""Points that a camera must see of a placement to find its pose."""

MIN_PLACEMENTS = 3
"""Placements that a plane needs for focal length and principal point (Zhang 2000,
doi:10.1109/34.888718)."""

IDENTITY = RigidTransform(np.eye(3), np.zeros(3))


def start_bundle(
    seen: Sightings,
    sizes: Mapping[str, tuple[int, int]],
    free: tuple[str, ...],
) -> Bundle:
    """Find cameras and poses of all placements.

    Parameters
    ----------
    seen : Sightings
        Points; the first placement becomes the world.
    sizes : mapping of str to (int, int)
        Image width and height of each camera, in the order of their indices.
    free : tuple of str
        Parameters to be estimated; the start has no others.

    Returns
    -------
    Bundle
        Good enough for `fit_bundle`.

    Raises
    ------
    GeometryError
        If a camera sees too few placements, or shares none with the others.
    """
    cameras: list[Camera] = []
    poses: list[dict[int, RigidTransform]] = []  # camera from target, by placement
    for i, (name, size) in enumerate(sizes.items()):
        own = posed(seen, i)
        if len(own) < MIN_PLACEMENTS:
            raise GeometryError(
                f"camera {name!r} sees {len(own)} placements with {MIN_POINTS} points or more; "
                f"{MIN_PLACEMENTS} are needed",
                remedy="show the target in more, differently tilted poses",
            )
        camera = Camera(name, size, np.eye(3), IDENTITY)
        camera, alone = _mono(seen, i, own, camera, free)
        cameras.append(camera)
        poses.append(alone)
    located = _linked(cameras, poses, seen.target_mm)
    found = _poses(located, seen, poses)
    world = found[0].inverse()
    return Bundle(
        tuple(
            replace(camera, camera_from_world=camera.camera_from_world.after(found[0]))
            for camera in located
        ),
        (IDENTITY, *(world.after(pose) for pose in found[1:])),
        free,
    )


def posed(seen: Sightings, camera: int) -> list[int]:
    """Return the placements whose pose a camera can find alone."""
    rows = seen.camera == camera
    different = np.unique(
        np.column_stack([seen.placement[rows], seen.target_mm[rows]]), axis=0
    )  # readings repeat points
    placement, count = np.unique(different[:, 0], return_counts=True)
    return [int(i) for i in placement[count >= MIN_POINTS]]


def _linked(
    cameras: list[Camera], poses: list[dict[int, RigidTransform]], target_mm: FloatArray
) -> tuple[Camera, ...]:
    """Carry the first camera's frame from camera to camera through placements they share."""
    world, placed = poses[0].copy(), {0: cameras[0]}
    while len(placed) < len(cameras):
        waiting = [i for i in range(len(cameras)) if i not in placed]
        ready = [i for i in waiting if poses[i].keys() & world.keys()]
        if not ready:
            raise GeometryError(
                f"camera {cameras[waiting[0]].name!r} shares no placement with the other cameras",
                remedy="show the target where this camera and another one see it together",
            )
        i = ready[0]
        shared = {j: (poses[i][j], world[j]) for j in sorted(poses[i].keys() & world.keys())}
        placed[i] = _joined(cameras[i], shared, target_mm)
        for placement, pose in poses[i].items():
            world.setdefault(placement, placed[i].camera_from_world.inverse().after(pose))
    return tuple(placed[i] for i in range(len(cameras)))


def _joined(
    camera: Camera, shared: dict[int, tuple[RigidTransform, RigidTransform]], target_mm: FloatArray
) -> Camera:
    """Place a camera by the placement that agrees best with the others that it shares."""
    candidates = [own.after(world.inverse()) for own, world in shared.values()]
    misses = np.array(
        [
            [_apart_mm(candidate.after(world), own, target_mm) for own, world in shared.values()]
            for candidate in candidates
        ]
    )
    best = int(np.argmin(np.median(misses, axis=1)))
    return replace(camera, camera_from_world=candidates[best])


def _apart_mm(one: RigidTransform, other: RigidTransform, target_mm: FloatArray) -> float:
    """Return how far two poses of the target are apart, the root mean square over its points."""
    return float(
        np.sqrt(np.mean(np.sum((one.apply(target_mm) - other.apply(target_mm)) ** 2, axis=1)))
    )


def _poses(
    cameras: tuple[Camera, ...],
    seen: Sightings,
    poses: list[dict[int, RigidTransform]],
) -> list[RigidTransform]:
    """Return where the target is: of what the cameras say, that which suits all of them best.

    A small flat target looks nearly alike in two poses, and one camera may take the wrong one.
    """
    found = []
    for placement in range(int(seen.placement.max()) + 1):
        rows = seen.select(seen.placement == placement)
        candidates = [
            camera.camera_from_world.inverse().after(own[placement])
            for camera, own in zip(cameras, poses, strict=True)
            if placement in own
        ]
        misses = [
            sum(_miss(camera, i, pose, rows) for i, camera in enumerate(cameras))
            for pose in candidates
        ]
        found.append(candidates[int(np.argmin(misses))])
    return found


def _miss(camera: Camera, index: int, pose: RigidTransform, rows: Sightings) -> float:
    """Return a camera's median reprojection error as a share of the target's size in the image."""
    own = rows.select(rows.camera == index)
    if not len(own):
        return 0.0
    miss = np.linalg.norm(camera.project(pose.apply(own.target_mm)) - own.xy_px, axis=1)
    size = np.median(np.linalg.norm(own.xy_px - np.median(own.xy_px, axis=0), axis=1))
    share = np.median(np.where(np.isfinite(miss), miss, np.inf)) / max(float(size), ROUNDING_PX)
    return float(min(share, 1e6))


def _mono(
    seen: Sightings, index: int, placements: list[int], camera: Camera, free: tuple[str, ...]
) -> tuple[Camera, dict[int, RigidTransform]]:
    """Calibrate one camera by OpenCV."""
    rows = [
        _agreeing(seen, np.flatnonzero((seen.camera == index) & (seen.placement == placement)))
        for placement in placements
    ]
    flags = 0 if "k3" in free else cv2.CALIB_FIX_K3
    flags |= 0 if "p1" in free else cv2.CALIB_ZERO_TANGENT_DIST
    flags |= 0 if "k2" in free else cv2.CALIB_FIX_K2
    flags |= 0 if "k1" in free else cv2.CALIB_FIX_K1
    try:
        _, matrix, lens, turns, shifts = cv2.calibrateCamera(
            [seen.target_mm[row].astype(np.float32) for row in rows],
            [seen.xy_px[row].astype(np.float32) for row in rows],
            camera.size_px,
            None,
            None,
            flags=flags,
        )
    except cv2.error as error:
        raise GeometryError(
            f"camera {camera.name!r}: no starting values can be found from these placements",
            remedy="show a flat target in differently tilted poses",
        ) from error
    k1, k2, p1, p2, k3 = np.ravel(lens)[:5]
    poses = {
        placement: RigidTransform(rotation_from_vector(np.ravel(turn)), np.ravel(shift))
        for placement, turn, shift in zip(placements, turns, shifts, strict=True)
    }
    brown = BrownIdeal(float(k1), float(k2), float(p1), float(p2), float(k3))
    return replace(camera, matrix_px=matrix, distortion=brown), poses


def _agreeing(seen: Sightings, rows: IntArray) -> IntArray:
    """Keep those points of an image that most others agree with: a gross one would spoil the start.

    By the homography of least median miss; a lens is no reason to lose a point, see `outliers.FAR`.
    """
    target, image = seen.target_mm[rows], seen.xy_px[rows]
    if np.ptp(target[:, 2]) > 0:
        return rows  # no plane
    homography, _ = cv2.findHomography(target[:, :2], image, cv2.LMEDS)
    if homography is None:
        return rows
    seen_at = np.column_stack([target[:, :2], np.ones(len(rows))]) @ homography.T
    with np.errstate(divide="ignore", invalid="ignore"):
        miss = np.linalg.norm(seen_at[:, :2] / seen_at[:, 2:] - image, axis=1)
    near = miss <= FAR * max(float(np.median(miss)), ROUNDING_PX)
    return rows[near] if np.count_nonzero(near) >= MIN_POINTS else rows
