"""Heights smoothed along chains, against a dense solution of the same equations."""

from __future__ import annotations

import numpy as np
import pytest

from closerange.features.edges import EdgePoints
from closerange.matching.chain_fit import BEND_PX, GROSS, LOOSE, ROUNDS, fit_chains


def edges_of(lengths, angle=None):
    count = sum(lengths)
    after, before = np.full(count, -1), np.full(count, -1)
    start = 0
    for length in lengths:
        after[start : start + length - 1] = np.arange(start + 1, start + length)
        before[start + 1 : start + length] = np.arange(start, start + length - 1)
        start += length
    angle = np.zeros(count) if angle is None else angle
    normal = np.column_stack([np.cos(angle), np.sin(angle)])
    one = np.ones(count)
    return EdgePoints(
        np.zeros((count, 2)), normal, one, one, 0.01 * one, 0 * one, after, before, (99, 99)
    )


def dense(value, std, lengths, corners=()):
    """Solve by a matrix of all equations: measurements, bends, and weak ties of neighbours."""
    known = np.isfinite(value)
    count = len(value)
    weight = np.where(known, 1 / std**2, 0.0)
    trust, start, rows = np.ones(count), 0, []
    for length in lengths:
        for k in range(start + 1, start + length - 1):
            if k not in corners:
                row = np.zeros(count)
                row[k - 1 : k + 2] = [1, -2, 1]
                rows.append(row / BEND_PX)
        for k in range(start + 1, start + length):
            row = np.zeros(count)
            row[k - 1 : k + 1] = [-1, 1]
            rows.append(row * np.sqrt(LOOSE) / BEND_PX)
        start += length
    prior = np.array(rows).T @ np.array(rows) + 1e-9 / BEND_PX**2 * np.eye(count)
    target = np.where(known, value, 0.0)
    for _ in range(ROUNDS):
        smooth = np.linalg.solve(prior + np.diag(weight * trust), weight * trust * target)
        residual = (target - smooth) * np.sqrt(weight)
        trust = 1 / (1 + (residual / GROSS) ** 2) ** 2
    return smooth


def test_the_banded_solution_is_the_dense_one():
    rng = np.random.default_rng(0)
    lengths = (40, 6, 25)
    count = sum(lengths)
    value = 5 + np.cumsum(rng.normal(0, 0.02, count)) + rng.normal(0, 0.1, count)
    value[[10, 11, 50]] = np.nan
    value[20] += 1.5
    std = rng.uniform(0.05, 0.2, count)
    fit = fit_chains(edges_of(lengths), value, std)
    np.testing.assert_allclose(fit.value_px, dense(value, std, lengths), atol=1e-6)
    assert abs(fit.residual[20]) > 5, "an outlier keeps its residual"
    assert np.isnan(fit.residual[[10, 11, 50]]).all()
    assert np.isfinite(fit.std_px).all()


def test_a_chain_may_bend_at_a_corner():
    angle = np.r_[np.zeros(20), np.full(20, np.pi / 2)]
    value = np.r_[np.linspace(0, 2, 20), np.linspace(2, 0, 20)]
    fit = fit_chains(edges_of((40,), angle), value, np.full(40, 0.3))
    stiff = fit_chains(edges_of((40,)), value, np.full(40, 0.3))
    assert np.abs(fit.value_px - value).max() < 0.05
    assert np.abs(stiff.value_px - value).max() > 0.1


def test_a_step_of_several_pixels_parts_two_edges():
    value = np.r_[np.zeros(20), np.full(20, 6.0)]
    fit = fit_chains(edges_of((40,)), value, np.full(40, 0.1))
    np.testing.assert_allclose(fit.value_px, value, atol=0.01)


def test_the_stated_deviation_is_the_scatter():
    """Of straight edges under white noise, away from the ends and at them."""
    rng = np.random.default_rng(3)
    edges = edges_of((60,) * 40)
    std = np.full(2400, 0.15)
    fit = fit_chains(edges, rng.normal(0, 0.15, 2400), std)
    error, stated = fit.value_px.reshape(40, 60), fit.std_px.reshape(40, 60)
    for part, low, high in ((slice(15, 45), 0.7, 1.3), (slice(0, 1), 0.5, 1.6)):
        ratio = np.sqrt((error[:, part] ** 2).mean()) / np.sqrt((stated[:, part] ** 2).mean())
        assert low < ratio < high
    assert stated[:, 30].mean() < 0.6 * 0.15


@pytest.mark.parametrize("length", [1, 2, 3, 6])
def test_short_chains_are_fitted_too(length):
    edges = edges_of((length,))
    fit = fit_chains(edges, np.full(length, 4.0), np.full(length, 0.1))
    np.testing.assert_allclose(fit.value_px, 4.0, atol=1e-6)
    assert (fit.std_px <= 0.1 + 1e-9).all()
    unknown = fit_chains(edges, np.full(length, np.nan), np.full(length, np.nan))
    assert np.isnan(unknown.value_px).all()


def test_nothing_is_fitted_to_nothing():
    fit = fit_chains(edges_of(()), np.zeros(0), np.zeros(0))
    assert len(fit.value_px) == len(fit.std_px) == len(fit.residual) == 0
