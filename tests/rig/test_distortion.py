"""Lens models: both directions, derivatives, the range in which they hold."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from closerange.rig.distortion import COEFFICIENTS, INTRINSICS, BrownIdeal, BrownObserved

K = np.array([[1300.0, 2.5, 648.0], [0, 1310.0, 518.0], [0, 0, 1]])
IDEAL = BrownIdeal(-0.15, 0.05, 0.001, -0.0005, 0.01)
OBSERVED = BrownObserved(2e-8, -3e-14, 4e-21, 1e-7, -5e-8, centre_px=(639.5, 511.5))
OBSERVED_MM = BrownObserved(
    1e-3, -3e-6, 1e-8, 1e-4, -2e-4, centre_px=(630.0, 500.0), unit_px=(140.0, 142.0)
)
LENSES = {"ideal": IDEAL, "observed": OBSERVED, "observed-mm": OBSERVED_MM}
STEPS = {
    "ideal": dict.fromkeys(COEFFICIENTS, 1e-4),
    "observed": {"k1": 1e-11, "k2": 1e-17, "k3": 1e-23, "p1": 1e-9, "p2": 1e-9},
    "observed-mm": {"k1": 1e-7, "k2": 1e-8, "k3": 1e-9, "p1": 1e-6, "p2": 1e-6},
}


@pytest.fixture
def pixels() -> np.ndarray:
    x, y = np.meshgrid(np.linspace(0, 1279, 9), np.linspace(0, 1023, 7))
    return np.column_stack([x.ravel(), y.ravel()])


@pytest.mark.parametrize("name", LENSES)
def test_both_directions_cancel(name, pixels):
    lens = LENSES[name]
    shift = np.linalg.norm(lens.distort(pixels, K) - pixels, axis=1).max()
    assert shift > 1  # the lens does something
    assert np.abs(lens.undistort(lens.distort(pixels, K), K) - pixels).max() < 1e-9
    assert np.abs(lens.distort(lens.undistort(pixels, K), K) - pixels).max() < 1e-9


def test_ideal_model_is_opencvs(pixels):
    no_skew = K * (1 - np.eye(3, k=1))
    coefficients = np.array([IDEAL.k1, IDEAL.k2, IDEAL.p1, IDEAL.p2, IDEAL.k3])
    rays = np.column_stack([(pixels - no_skew[:2, 2]) / np.diag(no_skew)[:2], np.ones(63)])
    theirs, _ = cv2.projectPoints(rays, np.zeros(3), np.zeros(3), no_skew, coefficients)
    assert np.abs(theirs.reshape(-1, 2) - IDEAL.distort(pixels, no_skew)).max() < 1e-9


def test_observed_model_is_equation_6_5():
    x, y = 100.0, -50.0
    r2 = x * x + y * y
    lens = BrownObserved(k1=1e-8, k2=2e-14, k3=3e-20, p1=1e-6, p2=-2e-6, centre_px=(10.0, 20.0))
    radial = 1e-8 * r2 + 2e-14 * r2**2 + 3e-20 * r2**3
    expected = [
        10 + x + x * radial + 1e-6 * (r2 + 2 * x * x) + 2 * -2e-6 * x * y,
        20 + y + y * radial + 2 * 1e-6 * x * y - 2e-6 * (r2 + 2 * y * y),
    ]
    assert np.allclose(lens.undistort([[10 + x, 20 + y]], K)[0], expected, atol=1e-11, rtol=0)


@pytest.mark.parametrize("name", LENSES)
def test_jacobian_matches_differences(name, pixels):
    lens = LENSES[name]
    jacobian = lens.jacobian(pixels, K)
    for axis in range(2):
        step = np.eye(2)[axis] * 0.01
        numeric = (lens.distort(pixels + step, K) - lens.distort(pixels - step, K)) / 0.02
        assert np.abs(numeric - jacobian[:, :, axis]).max() < 1e-7


@pytest.mark.parametrize("name", LENSES)
def test_coefficient_columns_match_differences(name, pixels):
    lens = LENSES[name]
    jacobian = lens.parameter_jacobian(pixels, K, COEFFICIENTS)
    for column, term in enumerate(COEFFICIENTS):
        step = STEPS[name][term]
        ahead = lens.moved(**{term: step}).distort(pixels, K)
        back = lens.moved(**{term: -step}).distort(pixels, K)
        numeric = (ahead - back) / (2 * step)
        error = np.abs(numeric - jacobian[:, :, column]).max()
        assert error < 1e-5 * np.abs(numeric).max(), (term, error)


@pytest.mark.parametrize("name", LENSES)
def test_intrinsic_columns_match_differences_at_fixed_directions(name, pixels):
    lens = LENSES[name]
    xy = (pixels - K[:2, 2]) @ np.linalg.inv(K[:2, :2]).T
    jacobian = lens.parameter_jacobian(pixels, K, INTRINSICS)
    places = {"fx": (0, 0), "fy": (1, 1), "cx": (0, 2), "cy": (1, 2), "skew": (0, 1)}
    for column, term in enumerate(INTRINSICS):
        seen = []
        for step in (1e-3, -1e-3):
            changed = K.copy()
            changed[places[term]] += step
            seen.append(lens.distort(xy @ changed[:2, :2].T + changed[:2, 2], changed))
        numeric = (seen[0] - seen[1]) / 2e-3
        assert np.abs(numeric - jacobian[:, :, column]).max() < 1e-7, term


def test_fold_radius_is_where_the_radius_stops_growing():
    lens = BrownIdeal(k1=-0.3, k2=0.02)
    fold = lens.fold_radius
    radius = np.linspace(0, 2 * fold, 20001)
    seen = radius + lens.radial_curve(radius)
    first = radius[np.argmax(np.diff(seen) <= 0)]
    assert first == pytest.approx(fold, abs=2e-4)  # spacing of the brute-force search
    assert BrownIdeal(k1=0.1).fold_radius == np.inf
    assert BrownIdeal().fold_radius == np.inf


def test_both_directions_are_nan_beyond_the_fold():
    lens, focal = BrownIdeal(k1=-0.3), np.diag([1000.0, 1000.0, 1.0])
    fold = lens.fold_radius
    seen = lens.distort(np.array([[1000 * fold * 0.999, 0], [1000 * fold * 1.001, 0]]), focal)
    assert np.isfinite(seen[0]).all()
    assert np.isnan(seen[1]).all()
    largest = 1000 * (fold + lens.radial_curve(np.array(fold)))
    ideal = lens.undistort(np.array([[largest * 0.999, 0], [largest * 1.01, 0]]), focal)
    assert np.isfinite(ideal[0]).all()
    assert np.isnan(ideal[1]).all()


@pytest.mark.parametrize("name", LENSES)
def test_a_nan_stays_one_nan(name, pixels):
    lens, holed = LENSES[name], pixels.copy()
    holed[3] = np.nan
    for result in (lens.distort(holed, K), lens.undistort(holed, K)):
        assert np.isnan(result[3]).all()
        assert np.isfinite(np.delete(result, 3, axis=0)).all()


def test_radial_curves_of_section_6_2_have_one_sign():
    radius = np.array([0.1, 0.5])
    assert (BrownIdeal(k1=-0.15).radial_curve(radius) < 0).all()  # barrel: too near to the axis
    # the same barrel, seen from the observed side, needs a positive correction
    assert (BrownObserved(k1=0.15).radial_curve(radius) < 0).all()


@pytest.mark.parametrize("name", LENSES)
def test_no_points_are_no_error(name):
    empty = np.empty((0, 2))
    assert LENSES[name].distort(empty, K).shape == (0, 2)
    assert LENSES[name].undistort(empty, K).shape == (0, 2)
