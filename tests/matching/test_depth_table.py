"""The table of misfits, against the same sums made one by one."""

from __future__ import annotations

from dataclasses import fields

import numpy as np
import pytest

from closerange.features.edges import EdgePoints
from closerange.matching.candidates import Candidates
from closerange.matching.depth_table import CELLS, MISFIT_LIMIT_PX, SHALLOW, DepthTable
from closerange.matching.element_weights import chain_misfit

ABOVE_MM = 600.0
"""Height of the first camera."""

WIDTHS = {"xy_px": 2, "xyz_mm": 3, "tangent": 2, "epipolar": 2, "upright_first": 2}


def candidates_of(point, height, px_per_mm, sine):
    count = len(point)
    made = {}
    for field in fields(Candidates):
        made[field.name] = np.zeros((count, WIDTHS[field.name]) if field.name in WIDTHS else count)
    made["point"] = np.asarray(point)
    made["xyz_mm"] = np.column_stack([np.zeros((count, 2)), height])
    made["px_per_mm"], made["sine"] = np.asarray(px_per_mm), np.asarray(sine)
    made["upright_second"], made["level"] = np.zeros((count, 2)), np.zeros((count, 2, 2))
    return Candidates(**made)


@pytest.fixture
def scene():
    rng = np.random.default_rng(1)
    point = np.sort(rng.integers(0, 300, 900))
    candidates = candidates_of(
        point, rng.uniform(-20, 20, 900), rng.uniform(1.5, 2.5, 900), rng.uniform(0.01, 1, 900)
    )
    return rng.uniform(0, 200, (300, 2)), candidates, rng.uniform(0, 1, 900)


def test_a_cell_holds_the_least_misfit_of_the_points_candidates(scene):
    _, candidates, price = scene
    table = DepthTable.of(300, candidates, price, 2, ABOVE_MM)
    levels = table.misfit.shape[1]
    height = table.lowest + table.step * np.arange(levels)  # 1 / mm, from the camera
    wanted = np.full((300, levels), MISFIT_LIMIT_PX)
    away = candidates.xyz_mm[:, 2] - ABOVE_MM
    rate = candidates.px_per_mm * away**2 * np.maximum(candidates.sine, SHALLOW)
    for row in range(len(candidates)):
        misfit = np.abs(height - 1 / away[row]) * rate[row] + price[row]
        point = candidates.point[row]
        wanted[point] = np.minimum(wanted[point], misfit)
    np.testing.assert_allclose(table.misfit, wanted, atol=1e-4)
    # at its own height, to half a step, a candidate costs its price at most
    at = table.at(candidates.point, candidates.xyz_mm[:, 2])
    assert (at <= price + 0.5 * table.step * rate + 1e-4).all()


def test_outside_of_the_table_everything_costs_the_limit(scene):
    _, candidates, price = scene
    table = DepthTable.of(300, candidates, price, 2, ABOVE_MM)
    far = table.at(np.array([3, 4, 5]), np.array([1e4, -1e4, np.inf]))
    assert (far == MISFIT_LIMIT_PX).all()


@pytest.mark.parametrize("half", [6.0, 19.0, 400.0])
def test_support_is_the_mean_over_the_cells_around_each_point(scene, half):
    xy, candidates, price = scene
    table = DepthTable.of(300, candidates, price, 2, ABOVE_MM)
    support = table.support(xy, candidates, half)
    cell = ((xy - xy.min(axis=0)) / (2 * half / CELLS)).astype(int)
    column = table.column(candidates.xyz_mm[:, 2])
    for row in range(0, len(candidates), 23):
        mine = cell[candidates.point[row]]
        near = (np.abs(cell - mine) <= CELLS // 2).all(axis=1)
        wanted = table.misfit[near, column[row]].mean()
        assert support[row] == pytest.approx(wanted, abs=1e-4)


def test_one_candidate_is_table_enough():
    candidates = candidates_of([0], [3.0], [2.0], [0.5])
    table = DepthTable.of(1, candidates, np.zeros(1), 2, ABOVE_MM)
    assert table.at(np.array([0]), np.array([3.0]))[0] == pytest.approx(0.0, abs=1e-6)
    assert table.support(np.zeros((1, 2)), candidates, 9.0)[0] == pytest.approx(0.0, abs=1e-6)


def test_the_misfit_of_a_chain_is_the_mean_over_its_points(scene):
    """Three open chains, of which the table knows the misfit at every height."""
    xy, candidates, price = scene
    after, before = np.arange(1, 301), np.arange(-1, 299)
    ends = [119, 131, 299]
    after[ends], before[[0, 120, 132]] = -1, -1
    one, two = np.ones(300), np.tile([0.0, -1.0], (300, 1))
    edges = EdgePoints(xy, two, one, one, one, one, after, before, (200, 200))
    table = DepthTable.of(300, candidates, price, 2, ABOVE_MM)
    mean = chain_misfit(edges, candidates, table, 20)
    column = table.column(candidates.xyz_mm[:, 2])
    first, last = np.array([0, 120, 132]), np.array(ends)
    for row in range(0, len(candidates), 17):
        point = candidates.point[row]
        chain = np.searchsorted(last, point)
        low, high = max(point - 20, first[chain]), min(point + 20, last[chain])
        wanted = table.misfit[low : high + 1, column[row]].mean()
        assert mean[row] == pytest.approx(wanted, abs=1e-4)
