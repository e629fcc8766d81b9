"""One camera: projection, directions, derivatives, moved parameters."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from closerange.geometry.transform import RigidTransform, rotation_from_vector
from closerange.rig.camera import POSE, Camera
from closerange.rig.distortion import COEFFICIENTS, INTRINSICS, BrownIdeal, BrownObserved

NAMES = (*INTRINSICS, *COEFFICIENTS, *POSE)
STEPS = {  # each moves a point by some thousandths of a pixel to a tenth of one
    **dict.fromkeys(("fx", "fy", "cx", "cy", "skew"), 1e-3),
    **dict.fromkeys(("rx", "ry", "rz"), 1e-5),
    **dict.fromkeys(("tx", "ty", "tz"), 1e-3),
}
LENSES = {
    "ideal": (BrownIdeal(-0.15, 0.05, 0.001, -0.0005, 0.01), dict.fromkeys(COEFFICIENTS, 1e-4)),
    "observed": (
        BrownObserved(2e-8, -3e-14, 4e-21, 1e-7, -5e-8, centre_px=(639.5, 511.5)),
        {"k1": 1e-11, "k2": 1e-17, "k3": 1e-23, "p1": 1e-9, "p2": 1e-9},
    ),
    "observed-mm": (
        BrownObserved(
            1e-3, -3e-6, 1e-8, 1e-4, -2e-4, centre_px=(630.0, 500.0), unit_px=(140, 142.0)
        ),
        {"k1": 1e-7, "k2": 1e-8, "k3": 1e-9, "p1": 1e-6, "p2": 1e-6},
    ),
}


def make(lens=None, *, skew: float = 1.7) -> Camera:
    rotation = rotation_from_vector([0.2, -0.3, 0.1])
    matrix = np.array([[1300.0, skew, 648.0], [0, 1310.0, 518.0], [0, 0, 1]])
    pose = RigidTransform(rotation, np.array([5.0, -7.0, 350.0]))
    return Camera("left", (1280, 1024), matrix, pose, lens or BrownIdeal())


@pytest.fixture
def points() -> np.ndarray:
    return np.random.default_rng(1).uniform(-70, 70, (40, 3))


def test_projection_matches_opencv(points):
    lens = LENSES["ideal"][0]
    camera = make(lens, skew=0.0)
    pose = camera.camera_from_world
    coefficients = np.array([lens.k1, lens.k2, lens.p1, lens.p2, lens.k3])
    theirs, _ = cv2.projectPoints(
        points, cv2.Rodrigues(pose.rotation)[0], pose.translation_mm, camera.matrix_px, coefficients
    )
    assert np.abs(theirs.reshape(-1, 2) - camera.project(points)).max() < 1e-9  # 2e-13 measured


def test_projection_matrix_is_the_projection_without_lens(points):
    camera = make()
    homogeneous = np.column_stack([points, np.ones(len(points))]) @ camera.projection_matrix.T
    assert np.allclose(homogeneous[:, :2] / homogeneous[:, 2:], camera.project(points), atol=1e-9)
    assert np.allclose(homogeneous[:, 2], camera.depth_mm(points), atol=1e-9)


@pytest.mark.parametrize("lens", LENSES)
def test_directions_pass_through_the_points(lens, points):
    camera = make(LENSES[lens][0])
    directions = camera.directions(camera.project(points))
    offset = points - camera.centre_mm
    along = np.sum(offset * directions, axis=1)
    assert (along > 0).all()
    assert np.abs(np.linalg.norm(directions, axis=1) - 1).max() < 1e-14
    missed_mm = np.linalg.norm(offset - along[:, None] * directions, axis=1)
    assert missed_mm.max() < 1e-9


@pytest.mark.parametrize("lens", LENSES)
def test_parameter_jacobian_matches_differences(lens, points):
    model, steps = LENSES[lens]
    camera, steps = make(model), {**STEPS, **steps}
    jacobian = camera.parameter_jacobian(points, NAMES)
    assert jacobian.shape == (40, 2, len(NAMES))
    for column, name in enumerate(NAMES):
        step = steps[name]
        ahead = camera.moved({name: step}).project(points)
        back = camera.moved({name: -step}).project(points)
        numeric = (ahead - back) / (2 * step)
        error = np.abs(numeric - jacobian[:, :, column]).max()
        assert error < 1e-5 * np.abs(numeric).max() + 1e-9, (name, error)


@pytest.mark.parametrize("lens", LENSES)
def test_jacobian_by_world_point_matches_differences(lens, points):
    camera = make(LENSES[lens][0])
    jacobian = camera.project_jacobian(points)
    for axis in range(3):
        step = np.zeros(3)
        step[axis] = 1e-3
        numeric = (camera.project(points + step) - camera.project(points - step)) / 2e-3
        assert np.abs(numeric - jacobian[:, :, axis]).max() < 1e-6  # of about 4 px/mm


def test_jacobian_takes_names_in_any_order(points):
    camera = make(LENSES["ideal"][0])
    full = camera.parameter_jacobian(points, NAMES)
    some = ("tz", "k1", "fx", "rx", "skew")
    expected = full[:, :, [NAMES.index(name) for name in some]]
    assert np.array_equal(camera.parameter_jacobian(points, some), expected)


@pytest.mark.parametrize("lens", LENSES)
def test_a_point_behind_the_camera_is_nan_not_mirrored(lens):
    camera = make(LENSES[lens][0])
    forward = camera.camera_from_world.rotation[2]
    behind = camera.centre_mm - 100 * forward
    just_behind = camera.centre_mm - 1e-6 * forward
    seen = camera.project([behind, just_behind, camera.centre_mm + 100 * forward])
    assert np.isnan(seen[:2]).all()
    assert np.isfinite(seen[2]).all()
    assert np.isnan(camera.project_jacobian([behind])).all()
    assert camera.depth_mm([behind])[0] == pytest.approx(-100, abs=1e-9)


def test_beyond_the_fold_is_nan():
    lens = BrownIdeal(k1=-0.3)  # turns back at 1 / sqrt(0.9)
    camera = Camera("a", (100, 100), np.diag([100.0, 100, 1]), RigidTransform(np.eye(3), [0, 0, 0]))
    camera = Camera("a", (100, 100), camera.matrix_px, camera.camera_from_world, lens)
    inside, outside = lens.fold_radius - 1e-6, lens.fold_radius + 1e-6
    seen = camera.project([[inside, 0, 1.0], [outside, 0, 1.0]])
    assert np.isfinite(seen[0]).all()
    assert np.isnan(seen[1]).all()


def test_moved_changes_what_it_names_and_nothing_else():
    camera = make(LENSES["ideal"][0])
    moved = camera.moved({"fx": 2.0, "skew": -0.5, "k2": 0.01, "ty": 3.0})
    for name, change in (("fx", 2.0), ("skew", -0.5), ("k2", 0.01), ("ty", 3.0), ("cy", 0.0)):
        assert moved.parameter(name) - camera.parameter(name) == pytest.approx(change, abs=1e-12)
    assert np.array_equal(moved.camera_from_world.rotation, camera.camera_from_world.rotation)
    assert camera.moved({}).project([[1, 2, 3]]).tolist() == camera.project([[1, 2, 3]]).tolist()


@pytest.mark.parametrize(
    "matrix",
    [
        [[-1300.0, 0, 640], [0, 1300, 512], [0, 0, 1]],
        [[1300.0, 0, 640], [0, 0, 512], [0, 0, 1]],
        [[1300.0, 0, 640], [1, 1300, 512], [0, 0, 1]],
        [[1300.0, 0, 640], [0, 1300, 512], [0, 0, 2]],
    ],
)
def test_an_impossible_matrix_is_refused(matrix):
    with pytest.raises(ValueError, match="upper triangular with fx, fy > 0"):
        Camera("a", (1280, 1024), matrix, RigidTransform(np.eye(3), [0, 0, 100]))


def test_arrays_of_a_camera_cannot_be_changed():
    camera = make()
    with pytest.raises(ValueError, match="read-only"):
        camera.matrix_px[0, 0] = 1.0
    assert camera.project(np.empty((0, 3))).shape == (0, 2)
