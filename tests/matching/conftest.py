"""Cameras for tests of what several of them see in common."""

from __future__ import annotations

from functools import cache
from types import SimpleNamespace

import numpy as np
import pytest

from closerange.geometry.transform import RigidTransform, rotation_from_vector
from closerange.matching.search import inside_image
from closerange.matching.volume_proposal import propose_volume
from closerange.rig.camera import Camera
from closerange.verification.scenes import looking_at_origin, strong_lens_rig


@pytest.fixture(scope="session")
def setups() -> SimpleNamespace:
    """Cameras, where their images end in space, and proposals that are made once."""
    return SimpleNamespace(
        converged=converged, parallel=parallel, moved_world=moved_world, halfspaces=halfspaces,
        seen=seen, in_box=in_box, cameras=cameras, proposal=proposal,
    )  # fmt: skip


def converged(focal=900.0, lens=None, angles=(-0.3, 0.3), size=(640, 512)):
    return [
        looking_at_origin(
            f"c{i}",
            angle_rad=angle,
            distance_mm=500.0,
            focal_px=focal,
            distortion=lens,
            size_px=size,
        )
        for i, angle in enumerate(angles)
    ]


def parallel(baseline=100.0, focal=1200.0):
    matrix = np.array([[focal, 0, 319.5], [0, focal, 255.5], [0, 0, 1]])
    return [
        Camera(name, (640, 512), matrix, RigidTransform(np.diag([1.0, -1, -1]), [x, 0.0, 1000.0]))
        for name, x in (("left", baseline / 2), ("right", -baseline / 2))
    ]


def moved_world(views, turn):
    """Return the same cameras in a world frame that is turned."""
    rotation = rotation_from_vector(turn)
    return [
        Camera(
            c.name,
            c.size_px,
            c.matrix_px,
            RigidTransform(
                c.camera_from_world.rotation @ rotation.T, c.camera_from_world.translation_mm
            ),
            c.distortion,
        )
        for c in views
    ]


def halfspaces(views):
    """Each border of each image is a plane of the world: a . X + b <= 0 inside."""
    rows = []
    for camera in views:
        p = camera.projection_matrix
        width, height = camera.size_px
        for axis, size in ((0, width), (1, height)):
            rows.append(-(p[axis] + 0.5 * p[2]))
            rows.append(p[axis] - (size - 0.5) * p[2])
        rows.append(-p[2])
    return np.array(rows)


def seen(views, xyz):
    return np.sum([inside_image(camera, camera.project(xyz)) for camera in views], axis=0)


def in_box(box, count=1000, seed=3):
    rng = np.random.default_rng(seed)
    points = rng.uniform(box[0], box[1], (count, 3))
    corners = [[box[(i >> axis) & 1, axis] for axis in range(3)] for i in range(8)]
    return np.concatenate([points, corners])


@cache
def cameras(name):
    """Return a set of cameras by its name."""
    far = {"baseline": 20.0, "focal": 4000.0}
    return {
        "converged": converged,
        "long lens": lambda: converged(focal=3000.0),
        "wide lens": lambda: converged(focal=700.0),
        "three": lambda: converged(angles=(-0.3, 0.1, 0.5)),
        "strong lens": lambda: list(strong_lens_rig().cameras),
        "parallel": parallel,
        "far": lambda: parallel(**far),
        "turned": lambda: moved_world(converged(), [0.5, 0.6, 0.3]),
        "far, turned": lambda: moved_world(parallel(**far), [0.7, 0.4, 0.0]),
    }[name]()


@cache
def proposal(name):
    """Return the volume that is proposed for a set of cameras."""
    box = propose_volume(cameras(name))
    box.flags.writeable = False
    return box
