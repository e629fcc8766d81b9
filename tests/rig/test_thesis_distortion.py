"""Chapter 6 as printed: eq. (6.5)-(6.14), and the radial tables of section 6.2."""

from __future__ import annotations

import csv
from dataclasses import replace

import numpy as np
import pytest

from closerange.errors import GeometryError, InputError
from closerange.geometry.transform import RigidTransform
from closerange.rig.camera import Camera
from closerange.rig.decompose import camera_from_matrix
from closerange.rig.distortion import BrownIdeal, BrownObserved
from closerange.rig.dlt import solve_dlt
from closerange.rig.radial_table import (
    RadialTable,
    lens_centre,
    radial_table_of,
)
from closerange.rig.thesis_distortion import (
    THESIS_ASSUMPTIONS,
    compare_assumptions,
    fit_thesis_distortion,
    thesis_residuals,
)
from closerange.rig.thesis_dlt import centre_of, centred_from_pixels, solve_thesis_dlt

SIZE = (1280, 1024)
BROWN = BrownIdeal(-0.15, 0.05, 0.001, -0.0005)
OWN = BrownObserved(-2e-8, 3e-14, -2e-20, 1e-7, -5e-8, centre_px=centre_of(SIZE))


def look(side: float, lens) -> Camera:
    """Rig B of the research: 0.35 m away, 40 degrees between the views, f = 1300 px."""
    angle = np.radians(20) * side
    centre = 350 * np.array([np.sin(angle), 0.0, np.cos(angle)])
    z = -centre / 350
    x = np.cross(z, [0.0, 1.0, 0.0])
    rotation = np.array([x, np.cross(z, x), z])
    matrix = np.array([[1300.0, 0, 648.5], [0, 1300, 518.5], [0, 0, 1]])
    return Camera("left", SIZE, matrix, RigidTransform(rotation, -rotation @ centre), lens)


def grid(count: int) -> np.ndarray:
    return np.array(np.meshgrid(*[np.linspace(-75, 75, count)] * 3)).reshape(3, -1).T


def observed(camera: Camera, points: np.ndarray, seed: int) -> np.ndarray:
    noise = np.random.default_rng(seed).normal(0, 0.05, (len(points), 2))
    return camera.project(points) + noise


def intersect(cameras, seen) -> np.ndarray:
    """Intersect two rays linearly, for each point (independent of the package's triangulation)."""
    rows = []
    for camera, xy in zip(cameras, seen, strict=True):
        p, ideal = camera.projection_matrix, camera.undistort(xy)
        rows += [p[0] - ideal[:, :1] * p[2], p[1] - ideal[:, 1:] * p[2]]
    stacked = np.stack(rows, axis=1)
    normal = np.einsum("nki,nkj->nij", stacked[:, :, :3], stacked[:, :, :3])
    right = -np.einsum("nki,nk->ni", stacked[:, :, :3], stacked[:, :, 3])
    return np.linalg.solve(normal, right[:, :, None])[:, :, 0]


@pytest.mark.parametrize("count", [3, 5])
def test_recovers_its_own_model(count):
    camera, points = look(1, OWN), grid(count)
    seen = camera.project(points)
    plain = replace(camera, distortion=BrownIdeal()).project(points)
    assert np.abs(seen - plain).max() > 0.8  # px of distortion to be found
    fit = fit_thesis_distortion(points, centred_from_pixels(seen, SIZE))
    assert fit.converged
    assert fit.iterations <= 6  # "the error dropped substantially in the first 6": 2 measured
    assert fit.phi < 1e-12
    # y up: P2 turns its sign
    expected = [OWN.k1, OWN.k2, OWN.k3, OWN.p1, -OWN.p2]
    assert np.allclose(fit.parameters[11:], expected, rtol=1e-4, atol=0)
    back = fit.camera("left", SIZE)
    assert isinstance(back.distortion, BrownObserved)
    assert np.abs(back.project(points) - seen).max() < 1e-6
    assert np.allclose(back.matrix_px, camera.matrix_px, atol=1e-3)


@pytest.mark.parametrize("parameters", THESIS_ASSUMPTIONS)
def test_frees_what_it_says(parameters):
    fit = fit_thesis_distortion(
        grid(3),
        centred_from_pixels(observed(look(1, BROWN), grid(3), 0), SIZE),
        parameters=parameters,
    )
    assert len(fit.free) == parameters
    assert fit.jacobian.shape == (54, parameters)
    assert (np.delete(fit.parameters, fit.free) == 0).all()
    assert (fit.parameters[list(fit.free)] != 0).all()


def test_jacobian_matches_differences_and_the_gradient_vanishes():
    points = grid(3)
    centred = centred_from_pixels(observed(look(1, BROWN), points, 1), SIZE)
    fit = fit_thesis_distortion(points, centred)
    steps = np.array([*[1e-4] * 8, *[1e-7] * 3, 1e-10, 1e-16, 1e-22, 1e-7, 1e-7])
    for column, step in enumerate(steps):
        change = np.zeros(16)
        change[column] = step
        ahead = thesis_residuals(fit.parameters + change, points, centred)
        back = thesis_residuals(fit.parameters - change, points, centred)
        numeric = ((ahead - back) / (2 * step)).ravel()
        error = np.abs(numeric - fit.jacobian[:, column]).max()
        assert error < 1e-6 * np.abs(numeric).max(), (column, error)
    f = thesis_residuals(fit.parameters, points, centred).ravel()
    assert f @ f == pytest.approx(fit.phi, rel=1e-9)
    cosine = fit.jacobian.T @ f / (np.linalg.norm(fit.jacobian, axis=0) * np.linalg.norm(f))
    assert np.abs(cosine).max() < 1e-5


def test_phi_only_falls_from_the_linear_start():
    points = grid(3)
    centred = centred_from_pixels(observed(look(1, BROWN), points, 2), SIZE)
    fit = fit_thesis_distortion(points, centred)
    start = np.concatenate([solve_thesis_dlt(points, centred), np.zeros(5)])
    first = float(np.sum(thesis_residuals(start, points, centred) ** 2))
    assert fit.phi_history[0] == pytest.approx(first, rel=1e-12)
    assert (np.diff(fit.phi_history) < 0).all()
    assert fit.phi_history[-1] == fit.phi
    assert len(fit.phi_history) == fit.iterations + 1


def test_a_minimum_by_another_method_is_the_same():
    from scipy.optimize import least_squares  # noqa: PLC0415  # an independent minimiser

    points = grid(3)
    centred = centred_from_pixels(observed(look(1, BROWN), points, 3), SIZE)
    fit = fit_thesis_distortion(points, centred)
    scale = np.where(fit.parameters == 0, 1, np.abs(fit.parameters))
    theirs = least_squares(
        lambda a: thesis_residuals(a * scale, points, centred).ravel(),
        fit.parameters / scale * 1.01,
        xtol=1e-15,
        ftol=1e-15,
        gtol=1e-15,
    )
    assert fit.phi == pytest.approx(2 * theirs.cost, rel=1e-6)


def test_the_four_assumptions_as_a_table():
    points = grid(3)
    rows = compare_assumptions(
        points, centred_from_pixels(observed(look(1, BROWN), points, 0), SIZE)
    )
    assert [row.assumption for row in rows] == [1, 2, 3, 4]
    assert [row.parameters for row in rows] == [11, 12, 14, 16]
    phi = [row.phi for row in rows]
    assert phi == sorted(phi, reverse=True)
    assert rows[0].reduction_percent == 0
    for row in rows:
        assert row.reduction_percent == pytest.approx(100 * (1 - row.phi / phi[0]), abs=1e-9)
        assert row.fit.converged


def test_the_printed_table_follows_the_same_order_and_arithmetic(shared):
    with (shared / "data/thesis/sec_6_5_distortion.csv").open() as stream:
        printed = [row for row in csv.DictReader(stream) if row["experiment"] == "1"]
    values = [float(row["phi"]) for row in printed]
    assert values == sorted(values, reverse=True)
    assert float(printed[3]["reduction_pct_recomputed"]) == pytest.approx(
        100 * (1 - values[3] / values[0]), abs=0.05
    )


def test_chapter_2_fails_under_distortion_and_chapter_6_does_not():
    """Research, rig B, 27 points: calibration part 43x the bound of 13.4 um, against 1.22x."""
    points, cameras = grid(3), (look(1, BROWN), look(-1, BROWN))
    check = np.random.default_rng(9).uniform(-75, 75, (400, 3))
    truth = [camera.project(check) for camera in cameras]
    linear_um, thesis_um, linear_px, thesis_px = [], [], [], []
    for run in range(12):
        plain, full = [], []
        for index, camera in enumerate(cameras):
            seen = observed(camera, points, 10 * run + index)
            solution = solve_dlt(points, seen)
            plain.append(camera_from_matrix(solution.matrix, "a", SIZE))
            full.append(fit_thesis_distortion(points, centred_from_pixels(seen, SIZE)))
            linear_px.append(solution.rms_px)
            full[-1] = full[-1].camera("a", SIZE)
            thesis_px.append(np.sqrt(np.mean((full[-1].project(points) - seen) ** 2)))
        for errors, pair in ((linear_um, plain), (thesis_um, full)):
            miss = np.linalg.norm(intersect(pair, truth) - check, axis=1)
            errors.append(1000 * np.sqrt(np.mean(miss**2)))
    linear, thesis = np.sqrt(np.mean(np.square(linear_um))), np.sqrt(np.mean(np.square(thesis_um)))
    assert 300 < linear < 1000, linear  # research 576 um
    assert 10 < thesis < 30, thesis  # research 16.3 um
    assert 0.7 < np.mean(linear_px) < 1.5  # research 1.08 px
    assert 0.038 < np.mean(thesis_px) < 0.048  # research 0.043 px


def test_too_few_points_or_other_counts_are_refused():
    camera = look(1, BROWN)
    points = np.random.default_rng(0).uniform(-75, 75, (7, 3))
    centred = centred_from_pixels(camera.project(points), SIZE)
    with pytest.raises(GeometryError, match="7 points give 14 equations for 16 parameters"):
        fit_thesis_distortion(points, centred)
    with pytest.raises(InputError, match="13 parameters; the thesis has 11, 12, 14, 16"):
        fit_thesis_distortion(points, centred, parameters=13)


def test_no_distortion_and_no_noise_is_no_trouble():
    camera, points = look(1, BrownIdeal()), grid(3)
    fit = fit_thesis_distortion(points, centred_from_pixels(camera.project(points), SIZE))
    assert fit.converged
    assert fit.phi < 1e-20
    assert np.abs(fit.camera("a", SIZE).project(points) - camera.project(points)).max() < 1e-8


def test_table_of_an_opencv_lens_is_its_radial_curve():
    lens = BrownIdeal(-0.15, 0.05, 0.001, -0.0005)
    table = radial_table_of(look(1, lens))
    ideal = np.linspace(0, 0.55, 50)
    displacement = lens.radial_curve(ideal)
    seen_px = 1300 * (ideal + displacement)
    assert np.abs(table.delta(seen_px) - 1300 * displacement).max() < 2e-3  # of 29 px
    assert (table.delta_px[1:] < 0).all()  # barrel: points lie too near to the centre


def test_corrected_points_are_the_undistorted_ones():
    for lens in (BrownIdeal(-0.15, 0.05), replace_tangential(OWN)):
        camera = look(1, lens)
        seen = np.random.default_rng(0).uniform([0, 0], [1279, 1023], (200, 2))
        corrected = radial_table_of(camera).correct(seen, lens_centre(camera))
        assert np.abs(corrected - camera.undistort(seen)).max() < 2e-3


def replace_tangential(lens: BrownObserved) -> BrownObserved:
    return BrownObserved(lens.k1, lens.k2, lens.k3, centre_px=lens.centre_px)


def test_equation_6_2_at_one_point():
    table = RadialTable([0.0, 50.0, 100.0], [0.0, 1.0, 4.0])
    corrected = table.correct([[60.0 + 10, 80.0 + 20], [10.0, 20.0], [200.0, 0]], [10.0, 20.0])
    assert np.allclose(corrected[0], [10 + 60 * 0.96, 20 + 80 * 0.96], atol=1e-12)
    assert corrected[1].tolist() == [10.0, 20.0]  # the centre stays
    assert np.isnan(corrected[2]).all()  # beyond the table nothing is known


def test_interpolation_has_no_waves_of_its_own():
    table = RadialTable([0.0, 10.0, 20.0, 30.0, 40.0], [0.0, 0.0, 0.0, 1.0, 1.0])
    between = table.delta(np.linspace(0, 40, 401))
    assert (np.diff(between) >= -1e-15).all()
    assert between.min() >= 0
    assert between.max() <= 1


def test_table_ends_where_the_lens_model_ends():
    camera = look(1, BrownIdeal(k1=-1.5))  # folds at 0.31 observed, the corner lies at 0.63
    table = radial_table_of(camera)
    assert np.isfinite(table.delta_px).all()
    assert 380 < table.radius_px[-1] < 415
    assert np.isnan(table.delta([500.0])).all()


@pytest.mark.parametrize(
    ("radius", "delta"),
    [([0.0], [0.0]), ([1.0, 2.0], [0.0, 1.0]), ([0.0, 2, 1], [0.0, 1, 2]), ([0.0, 1], [0.5, 1])],
)
def test_malformed_tables_are_refused(radius, delta):
    with pytest.raises(InputError, match="radii that rise"):
        RadialTable(radius, delta)


def test_impossible_tables_are_refused():
    with pytest.raises(InputError, match="not finite"):
        RadialTable([0.0, np.nan], [0.0, 1.0])
    with pytest.raises(InputError, match="1 rows"):
        radial_table_of(look(1, BROWN), rows=1)
