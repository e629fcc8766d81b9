"""Levenberg-Marquardt against SciPy, closed forms and functions that misbehave."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.optimize import least_squares

from closerange.geometry.least_squares import levenberg_marquardt

T = np.linspace(0, 3, 60)
Y = 2 * np.exp(-1.3 * T) + 0.5 + 0.02 * np.sin(37 * T)


def rosenbrock(x):
    return (
        np.array([10 * (x[1] - x[0] ** 2), 1 - x[0]]),
        np.array([[-20 * x[0], 10.0], [-1.0, 0.0]]),
    )


def decay(x):
    e = np.exp(-x[1] * T)
    return x[0] * e + x[2] - Y, np.column_stack([e, -x[0] * T * e, np.ones_like(T)])


def test_straight_line_equals_closed_form():
    a = np.column_stack([T, np.ones_like(T)])
    fit = levenberg_marquardt(lambda x: (a @ x - Y, a), [0, 0])
    expected, cost, *_ = np.linalg.lstsq(a, Y, rcond=None)
    assert fit.converged
    np.testing.assert_allclose(fit.x, expected, rtol=1e-9)
    assert fit.cost == pytest.approx(cost[0], rel=1e-12)
    covariance = fit.covariance(fit.cost / (len(T) - 2))
    np.testing.assert_allclose(covariance, cost[0] / 58 * np.linalg.inv(a.T @ a), rtol=1e-9)


def test_rosenbrock_valley_ends_at_its_bottom():
    fit = levenberg_marquardt(rosenbrock, [-1.2, 1])
    assert fit.converged
    np.testing.assert_allclose(fit.x, [1, 1], atol=1e-9)


@pytest.mark.parametrize("start", [[1, 1, 0], [10, 0.1, -3], [3, 3, 1]])
def test_decay_equals_scipy(start):
    fit = levenberg_marquardt(decay, start)
    peer = least_squares(lambda x: decay(x)[0], start, lambda x: decay(x)[1], xtol=1e-14)
    assert fit.converged
    np.testing.assert_allclose(fit.x, peer.x, rtol=1e-6)
    assert fit.cost == pytest.approx(2 * peer.cost, rel=1e-10)


@pytest.mark.parametrize("curvature", [-0.97, -1.1])
def test_large_residuals_do_not_make_it_leap_from_side_to_side(curvature):
    """Steps without damping multiply x by the curvature (Dennis and Schnabel's example)."""

    def function(x):
        values = np.array([x[0] + 1, curvature * x[0] ** 2 + x[0] - 1])
        return values, np.array([[1.0], [2 * curvature * x[0] + 1]])

    fit = levenberg_marquardt(function, [0.3], gain_limit=1e-10)
    assert fit.converged
    assert abs(fit.x[0]) < 1e-5
    assert fit.iterations < 20  # 12 and 14; 200 and 178 with less damping after every step downhill


def test_units_do_not_matter():
    scale = np.array([1e6, 1e-5, 1e3])
    plain = levenberg_marquardt(decay, [1, 1, 0])

    def scaled(x):
        residuals, jacobian = decay(x / scale)
        return residuals, jacobian / scale

    other = levenberg_marquardt(scaled, np.array([1, 1, 0]) * scale)
    np.testing.assert_allclose(other.x / scale, plain.x, rtol=1e-8)
    assert abs(other.iterations - plain.iterations) <= 1


def test_values_that_are_not_finite_reject_the_step():
    def root(x):  # NaN below 0; the first step of Gauss-Newton jumps there
        with np.errstate(invalid="ignore"):
            return np.sqrt(x) - 0.1, 0.5 / np.sqrt(np.abs(x))[:, None]

    fit = levenberg_marquardt(root, [4.0])
    assert fit.converged
    assert fit.x[0] == pytest.approx(0.01, rel=1e-8)


def test_start_outside_the_domain_is_not_converged():
    fit = levenberg_marquardt(lambda x: (np.array([np.nan, x[0]]), np.ones((2, 1))), [1.0])
    assert not fit.converged
    assert fit.cost == np.inf
    assert fit.iterations == 0


def test_parameter_without_influence_stays():
    def padded(x):
        residuals, jacobian = decay(x[:3])
        return residuals, np.column_stack([jacobian, np.zeros_like(T)])

    fit = levenberg_marquardt(padded, [1, 1, 0, 7])
    assert fit.converged
    assert fit.x[3] == 7


def test_parameters_that_only_act_together_still_reach_the_minimum():
    def twice(x):
        residuals, jacobian = decay([x[0] + x[3], x[1], x[2]])
        return residuals, np.column_stack([jacobian, jacobian[:, 0]])

    fit = levenberg_marquardt(twice, [1, 1, 0, 0.5])
    single = levenberg_marquardt(decay, [1.5, 1, 0])
    assert fit.converged
    assert fit.cost == pytest.approx(single.cost, rel=1e-9)
    assert fit.x[0] + fit.x[3] == pytest.approx(single.x[0], rel=1e-6)


def test_iterations_are_limited_and_never_end_worse():
    fit = levenberg_marquardt(rosenbrock, [-1.2, 1], max_iterations=3)
    start, _ = rosenbrock(np.array([-1.2, 1.0]))
    assert fit.iterations == 3
    assert not fit.converged
    assert fit.cost <= start @ start


def test_wrong_derivatives_end_without_convergence():
    fit = levenberg_marquardt(lambda x: (x - 3.0, -np.ones((1, 1))), [1.0])
    assert not fit.converged
    assert fit.x[0] == 1.0


def test_larger_gain_limit_stops_earlier():
    exact = levenberg_marquardt(decay, [10, 0.1, -3])
    rough = levenberg_marquardt(decay, [10, 0.1, -3], gain_limit=1e-3)
    assert rough.converged
    assert rough.iterations < exact.iterations
    assert rough.cost <= 1.002 * exact.cost


def test_same_input_same_output():
    first, second = (levenberg_marquardt(decay, [10, 0.1, -3]) for _ in range(2))
    np.testing.assert_array_equal(first.x, second.x)


def rounded_line(rounding):
    """Exact points of a curve far from the origin, rounded; the residuals are differences."""
    seen = 640 + 300 * np.exp(-1.3 * T)
    if rounding:
        seen = np.round(seen / rounding) * rounding

    def function(x):
        e = np.exp(-x[1] * T)
        return (x[2] + x[0] * e) - seen, np.column_stack([e, -x[0] * T * e, np.ones_like(T)])

    return function, float(seen @ seen)


@pytest.mark.parametrize("rounding", [0.0, 1e-9, 1e-6])
def test_exact_data_converge_at_their_rounding(rounding):
    function, terms = rounded_line(rounding)
    fit = levenberg_marquardt(function, [250, 1, 600], terms=terms)
    assert fit.converged
    assert fit.iterations < 15
    np.testing.assert_allclose(fit.x, [300, 1.3, 640], rtol=max(1e-12, rounding))


def test_terms_do_not_stop_a_search_that_still_gains():
    plain = levenberg_marquardt(decay, [10, 0.1, -3])
    fit = levenberg_marquardt(decay, [10, 0.1, -3], terms=float(Y @ Y))
    np.testing.assert_array_equal(fit.x, plain.x)
