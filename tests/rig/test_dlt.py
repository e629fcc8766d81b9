"""The linear solution and the split of its matrix into a camera."""

from __future__ import annotations

import numpy as np
import pytest

from closerange.errors import GeometryError, InputError
from closerange.geometry.transform import RigidTransform
from closerange.rig.camera import Camera
from closerange.rig.decompose import camera_from_matrix
from closerange.rig.distortion import BrownIdeal
from closerange.rig.dlt import solve_dlt

SIZE = (1280, 1024)


def look(centre, *, focal: float = 1300.0, skew: float = 0.0, lens=None) -> Camera:
    """Aim a camera at the origin, world y upwards."""
    centre = np.asarray(centre, float)
    z = -centre / np.linalg.norm(centre)
    x = np.cross(z, [0.0, 1.0, 0.0])
    x /= np.linalg.norm(x)
    rotation = np.array([x, np.cross(z, x), z])
    matrix = np.array([[focal, skew, 648.5], [0, 1.02 * focal, 518.5], [0, 0, 1]])
    pose = RigidTransform(rotation, -rotation @ centre)
    return Camera("left", SIZE, matrix, pose, lens or BrownIdeal())


def grid(counts=(3, 3, 3), half=(75.0, 75.0, 75.0)) -> np.ndarray:
    axes = [
        np.linspace(-size, size, count) if count > 1 else np.zeros(1)
        for size, count in zip(half, counts, strict=True)
    ]
    return np.array(np.meshgrid(*axes)).reshape(3, -1).T


def test_exact_on_its_own_model():
    camera, points = look((120, 20, 330), skew=3.0), grid()
    solution = solve_dlt(points, camera.project(points))
    expected = camera.projection_matrix  # its last row already has unit length
    assert np.abs(solution.matrix / expected - 1).max() < 1e-9
    assert np.abs(solution.residual_px).max() < 1e-9
    assert solution.rms_px < 1e-9
    assert solution.condition < 10  # 2.6 measured: a cube is as good as it gets


def test_w_is_depth_in_mm():
    camera, points = look((120, 20, 330)), grid()
    matrix = solve_dlt(points, camera.project(points)).matrix
    assert np.allclose(points @ matrix[2, :3] + matrix[2, 3], camera.depth_mm(points), atol=1e-8)


def test_residuals_are_observed_minus_calculated():
    camera, points = look((120, 20, 330)), grid()
    rng = np.random.default_rng(3)
    observed = camera.project(points) + rng.normal(0, 0.05, (27, 2))
    solution = solve_dlt(points, observed)
    calculated = camera_from_matrix(solution.matrix, "a", SIZE).project(points)
    assert np.allclose(solution.residual_px, observed - calculated, atol=1e-9)
    expected = 0.05 * np.sqrt(1 - 11 / 54)  # 0.0446
    assert solution.rms_px == pytest.approx(expected, rel=0.25)  # sd of an RMS of 43: 11 %


@pytest.mark.parametrize("unit", [1e-3, 1.0, 1e3])
@pytest.mark.parametrize("offset", [0.0, 1e6])
def test_any_origin_and_unit_serve(unit, offset):
    camera, points = look((120, 20, 330)), grid()
    moved = points * unit + np.array([offset, -offset, offset]) * unit
    solution = solve_dlt(moved, camera.project(points))
    # 1e6 mm away, world coordinates keep 1e-10 mm, which P multiplies by 4 px/mm
    assert np.abs(solution.residual_px).max() < (1e-9 if offset == 0 else 1e-6)


def test_the_origin_at_the_camera_is_no_trap():
    camera, points = look((120, 20, 330)), grid((5, 5, 5))
    rng = np.random.default_rng(4)
    observed = camera.project(points) + rng.normal(0, 0.05, (125, 2))
    plain = solve_dlt(points, observed).matrix
    at_camera = solve_dlt(points - camera.centre_mm, observed).matrix
    shift = np.eye(4)
    shift[:3, 3] = -camera.centre_mm
    assert np.allclose(at_camera @ shift, plain, rtol=1e-8, atol=1e-6)


@pytest.mark.parametrize("distance", [350.0, 1e4, 1e6, 1e8])
def test_decomposition_projects_exactly_even_nearly_affine(distance):
    camera = look(np.array([0.34, 0.06, 0.94]) * distance, focal=1300 * distance / 350, skew=-67.0)
    split = camera_from_matrix(-3.7 * -camera.projection_matrix, "left", SIZE)
    points = grid()
    assert np.abs(split.project(points) - camera.project(points)).max() < 1e-9
    assert split.matrix_px[0, 1] == pytest.approx(-67.0, abs=1e-4)
    assert np.allclose(split.matrix_px, camera.matrix_px, rtol=1e-4, atol=1e-4)
    assert np.allclose(split.centre_mm, camera.centre_mm, rtol=1e-4)


def test_decomposition_refuses_what_is_no_camera():
    matrix = look((120, 20, 330)).projection_matrix
    with pytest.raises(GeometryError, match="mirrored"):
        camera_from_matrix(-matrix, "a", SIZE)
    affine = matrix.copy()
    affine[2, :3] = 0
    with pytest.raises(GeometryError, match="affine or singular"):
        camera_from_matrix(affine, "a", SIZE)
    with pytest.raises(GeometryError, match="not finite"):
        camera_from_matrix(matrix * np.nan, "a", SIZE)
    with pytest.raises(GeometryError, match=r"\(3, 3\)"):
        camera_from_matrix(matrix[:, :3], "a", SIZE)


def test_a_plane_is_refused_with_thickness_and_extent():
    camera, points = look((120, 20, 330)), grid((5, 5, 1))
    points[7, 2] += 0.03
    with pytest.raises(GeometryError) as caught:
        solve_dlt(points, camera.project(points))
    assert "one plane (0.031 mm thick over 212.1 mm; the limit is 0.21 mm)" in caught.value.message
    assert "at least 35 mm in front or behind" in caught.value.remedy
    assert caught.value.exit_code == 1


def test_a_tilted_plane_is_refused_too():
    camera = look((120, 20, 330))
    points = grid((5, 5, 1)) @ np.linalg.qr(np.random.default_rng(0).normal(size=(3, 3)))[0]
    with pytest.raises(GeometryError, match="one plane"):
        solve_dlt(points, camera.project(points))


def test_a_thin_block_is_accepted_and_its_condition_tells():
    camera, thin = look((120, 20, 330)), grid(half=(75.0, 75.0, 0.75))
    solution = solve_dlt(thin, camera.project(thin))
    assert 100 < solution.condition < 1000  # 169 measured, against 2.6 for the cube


def test_other_degenerate_sets_are_refused():
    camera = look((120, 20, 330))
    line = np.column_stack([np.linspace(-50, 50, 9), np.linspace(0, 5, 9), np.zeros(9)])
    with pytest.raises(GeometryError, match="one line"):
        solve_dlt(line, camera.project(line))
    spot = np.tile([1.0, 2, 3], (9, 1))
    with pytest.raises(GeometryError, match="one spot"):
        solve_dlt(spot, camera.project(spot))
    one_off = np.vstack([grid((3, 3, 1)), [[0, 0, 50.0]]])  # a plane and a single point above it
    with pytest.raises(GeometryError, match="condition number"):
        solve_dlt(one_off, camera.project(one_off))
    doubled = np.vstack([grid()[[0, 5, 7, 12, 23]], grid()[[0]]])  # six, two of them the same
    with pytest.raises(GeometryError, match="condition number"):
        solve_dlt(doubled, camera.project(doubled))


def test_too_few_or_not_finite_points_are_refused():
    camera, points = look((120, 20, 330)), grid()
    seen = camera.project(points)
    with pytest.raises(GeometryError, match="5 points, a camera needs at least 6"):
        solve_dlt(points[:5], seen[:5])
    seen[[4, 9]] = np.nan
    with pytest.raises(GeometryError, match="2 of 27 points are not finite, the first is number 4"):
        solve_dlt(points, seen)
    with pytest.raises(InputError, match=r"shape \(27, 3\), image points \(26, 2\)"):
        solve_dlt(points, seen[:26])


@pytest.mark.parametrize("axis", [0, 1, 2])
def test_left_handed_axes_are_explained(axis):
    camera, points = look((120, 20, 330)), grid()
    mirrored = points.copy()
    mirrored[:, axis] *= -1
    with pytest.raises(GeometryError) as caught:
        solve_dlt(mirrored, camera.project(points))
    assert "det R = -1" in caught.value.message
    assert "left-handed" in caught.value.message
    assert "right-handed" in caught.value.remedy


def test_points_on_both_sides_of_the_camera_are_refused():
    points = grid() * 5  # the camera stands within them
    camera = look((120, 20, 330))
    homogeneous = np.column_stack([points, np.ones(27)]) @ camera.projection_matrix.T
    behind = np.count_nonzero(homogeneous[:, 2] <= 0)
    assert 0 < behind < 13
    with pytest.raises(GeometryError, match=f"{behind} of 27 points would lie behind"):
        solve_dlt(points, homogeneous[:, :2] / homogeneous[:, 2:])


def test_a_telecentric_view_is_refused():
    points = grid()
    with pytest.raises(GeometryError, match="no perspective"):
        solve_dlt(points, points[:, :2] * [4.0, -4.0] + points[:, 2:] * 0.3 + 600)


def test_distortion_shows_in_the_residuals():
    camera = look((120, 20, 330), lens=BrownIdeal(-0.15, 0.05, 0.001, -0.0005))
    points = grid()
    solution = solve_dlt(points, camera.project(points))
    assert 0.5 < solution.rms_px < 2  # about 1 px where the noise is 0.05
