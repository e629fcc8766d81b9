"""Chapter 2 as printed: eq. (2.1)-(2.5), a12 = 1."""

from __future__ import annotations

import json
import warnings

import numpy as np
import pytest

from closerange.errors import CloseRangeWarning, GeometryError, InputError
from closerange.geometry.transform import RigidTransform
from closerange.rig.camera import Camera
from closerange.rig.dlt import solve_dlt
from closerange.rig.thesis_dlt import (
    camera_from_thesis,
    centre_of,
    centred_from_pixels,
    solve_thesis_dlt,
    thesis_matrix,
)

SIZE = (1280, 1024)


def look(centre) -> Camera:
    centre = np.asarray(centre, float)
    z = -centre / np.linalg.norm(centre)
    x = np.cross(z, [0.0, 1.0, 0.0])
    x /= np.linalg.norm(x)
    rotation = np.array([x, np.cross(z, x), z])
    matrix = np.array([[1300.0, 0, 648.5], [0, 1300, 518.5], [0, 0, 1]])
    return Camera("left", SIZE, matrix, RigidTransform(rotation, -rotation @ centre))


def grid(count: int = 3) -> np.ndarray:
    return np.array(np.meshgrid(*[np.linspace(-75, 75, count)] * 3)).reshape(3, -1).T


def observed(camera: Camera, points: np.ndarray, seed: int) -> np.ndarray:
    noise = np.random.default_rng(seed).normal(0, 0.05, (len(points), 2))
    return centred_from_pixels(camera.project(points) + noise, SIZE)


def test_image_coordinates_count_from_the_centre_upwards():
    centred = centred_from_pixels([[0.0, 0.0], [639.5, 511.5], [1279.0, 0.0]], SIZE)
    assert centred.tolist() == [[-639.5, 511.5], [0.0, 0.0], [639.5, 511.5]]


@pytest.mark.parametrize("solver", ["svd", "normal-equations"])
def test_exact_on_its_own_model(solver):
    camera, points = look((120, 20, 330)), grid()
    centred = centred_from_pixels(camera.project(points), SIZE)
    parameters = solve_thesis_dlt(points, centred, solver=solver)
    assert parameters.shape == (11,)
    expected = camera.projection_matrix / camera.projection_matrix[2, 3]
    found = thesis_matrix(parameters, SIZE)
    assert found[2, 3] == 1.0
    assert np.abs(found / expected - 1).max() < 1e-9
    back = camera_from_thesis(parameters, "left", SIZE)
    assert np.abs(back.project(points) - camera.project(points)).max() < 1e-9
    assert np.allclose(back.matrix_px, camera.matrix_px, atol=1e-6)


def test_equation_2_3_holds_as_printed():
    camera, points = look((120, 20, 330)), grid()
    centred = centred_from_pixels(camera.project(points), SIZE)
    a = solve_thesis_dlt(points, centred)
    w = points @ a[8:11] + 1
    assert np.allclose((points @ a[0:3] + a[3]) / w, centred[:, 0], atol=1e-9)
    assert np.allclose((points @ a[4:7] + a[7]) / w, centred[:, 1], atol=1e-9)


@pytest.mark.parametrize("count", [3, 5])
def test_normal_equations_equal_svd(count):
    points = grid(count)
    centred = observed(look((120, 20, 330)), points, seed=1)
    svd = solve_thesis_dlt(points, centred, solver="svd")
    normal = solve_thesis_dlt(points, centred, solver="normal-equations")
    assert np.abs(normal / svd - 1).max() < 1e-6  # 1e-12 measured
    assert not np.array_equal(normal, svd)  # two ways, not one


def test_as_accurate_as_the_default_where_the_gauge_is_good():
    camera, points = look((120, 20, 330)), grid(5)
    check = np.random.default_rng(0).uniform(-75, 75, (200, 3))
    ours, theirs = [], []
    for seed in range(20):
        centred = observed(camera, points, seed)
        thesis = camera_from_thesis(solve_thesis_dlt(points, centred), "a", SIZE)
        default = solve_dlt(points, centred * (1, -1) + centre_of(SIZE)).matrix
        h = np.column_stack([check, np.ones(200)]) @ default.T
        truth = camera.project(check)
        ours.append(np.mean((thesis.project(check) - truth) ** 2))
        theirs.append(np.mean((h[:, :2] / h[:, 2:] - truth) ** 2))
    ratio = np.sqrt(np.mean(ours) / np.mean(theirs))
    assert 0.9 < ratio < 1.1


def test_origin_at_the_camera_is_refused_and_near_it_warned_of():
    camera, points = look((120, 20, 330)), grid(5)
    for seed in range(10):
        centred = observed(camera, points, seed)
        with pytest.raises(GeometryError, match="a12 = 1 is lost"):
            solve_thesis_dlt(points - camera.centre_mm, centred)
        with pytest.warns(CloseRangeWarning, match="a12 = 1 biases"):
            solve_thesis_dlt(points - 0.997 * camera.centre_mm, centred)
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            solve_thesis_dlt(points - 0.5 * camera.centre_mm, centred)


def test_origin_anywhere_in_the_principal_plane_is_refused():
    camera, points = look((120, 20, 330)), grid(5)
    aside = camera.centre_mm + 200 * camera.camera_from_world.rotation[0]
    with pytest.raises(GeometryError, match="principal plane"):
        solve_thesis_dlt(points - aside, observed(camera, points, 2))


def test_the_warned_bias_is_real():
    camera, points = look((120, 20, 330)), grid(5)
    origin = 0.999 * camera.centre_mm
    errors = {"literal": [], "default": []}
    for seed in range(10):
        centred = observed(camera, points, seed)
        with pytest.warns(CloseRangeWarning, match="a12 = 1"):
            biased = camera_from_thesis(solve_thesis_dlt(points - origin, centred), "a", SIZE)
        default = solve_dlt(points - origin, centred * (1, -1) + centre_of(SIZE)).matrix
        h = np.column_stack([points - origin, np.ones(125)]) @ default.T
        truth = camera.project(points)
        errors["literal"].append(np.mean((biased.project(points - origin) - truth) ** 2))
        errors["default"].append(np.mean((h[:, :2] / h[:, 2:] - truth) ** 2))
    literal, default = (np.sqrt(np.mean(errors[name])) for name in ("literal", "default"))
    assert default < 0.03
    assert literal > 3 * default  # 0.06 px against 0.013 px


def test_origin_behind_the_camera_serves():
    camera, points = look((120, 20, 330)), grid()
    moved = points - 2 * camera.centre_mm
    centred = centred_from_pixels(camera.project(points), SIZE)
    parameters = solve_thesis_dlt(moved, centred)
    assert (moved @ parameters[8:11] + 1 < 0).all()
    back = camera_from_thesis(parameters, "left", SIZE)
    assert np.abs(back.project(moved) - camera.project(points)).max() < 1e-8


@pytest.mark.parametrize("wrong", ["axis", "y-down"])
def test_mirrored_input_is_refused(wrong):
    camera, points = look((120, 20, 330)), grid()
    centred = centred_from_pixels(camera.project(points), SIZE)
    if wrong == "axis":
        points = points * [1, 1, -1]
    else:
        centred = centred * [1, -1]
    with pytest.raises(GeometryError, match="left-handed"):
        solve_thesis_dlt(points, centred)


def test_planes_and_unknown_solvers_are_refused():
    camera, points = look((120, 20, 330)), grid()
    centred = centred_from_pixels(camera.project(points), SIZE)
    with pytest.raises(InputError, match="'crout'"):
        solve_thesis_dlt(points, centred, solver="crout")
    flat = points * [1, 1, 0]
    with pytest.raises(GeometryError, match="one plane"):
        solve_thesis_dlt(flat, centred)
    with pytest.raises(GeometryError, match="5 points"):
        solve_thesis_dlt(points[:5], centred[:5])


def test_printed_parameters_of_figure_2_4_are_two_cameras_facing_the_block(shared):
    figure = json.loads((shared / "data/thesis/fig_2_4_calibration_parameters.json").read_text())
    for name in ("camera1", "camera2"):
        camera = camera_from_thesis(figure[name], name, (510, 492))
        expected = figure["derived_check"][name]
        assert np.allclose(camera.centre_mm, expected["centre_mm"], atol=0.06)
        assert camera.matrix_px[0, 0] == pytest.approx(expected["fx_px"], abs=0.06)
        assert camera.matrix_px[1, 1] == pytest.approx(expected["fy_px"], abs=0.06)
        # y turns from up to down, and with it the sign of the skew
        assert camera.matrix_px[0, 1] == pytest.approx(-expected["skew_px"], abs=0.06)
        assert camera.depth_mm([[0, 0, 0]])[0] > 500
        # the printed numbers themselves: eq. (2.1) at the target's corner
        a = np.append(figure[name], 1.0).reshape(3, 4) @ [5.0, 5.0, 6.35, 1.0]
        seen = centred_from_pixels(camera.project([[5.0, 5.0, 6.35]]), (510, 492))[0]
        assert np.allclose(seen, a[:2] / a[2], atol=1e-9)
