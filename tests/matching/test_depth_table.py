"""The table of misfits, against the same sums made one by one."""

from __future__ import annotations

from dataclasses import fields

import numpy as np
import pytest

from closerange.matching import depth_table
from closerange.matching.candidates import Candidates
from closerange.matching.depth_table import (
    CELLS,
    MISFIT_LIMIT_PX,
    SHALLOW,
    DepthTable,
    Line,
    Square,
    Strip,
)

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


def chains_of(ends):
    """Make the next points of open chains of consecutive points that end at the given ones."""
    after = np.arange(1, ends[-1] + 2)
    after[ends] = -1
    return after


@pytest.fixture
def scene():
    """Three chains of 300 points in all, their places, and candidates with prices."""
    rng = np.random.default_rng(1)
    point = np.sort(rng.integers(0, 300, 900))
    candidates = candidates_of(
        point, rng.uniform(-20, 20, 900), rng.uniform(1.5, 2.5, 900), rng.uniform(0.01, 1, 900)
    )
    line = Line.of(chains_of([119, 131, 299]))
    return line, rng.uniform(0, 200, (300, 2)), candidates, rng.uniform(0, 1, 900)


def misfits(line, candidates, price):
    """Tabulate at once; shape (300, levels), points in their own order."""
    table = DepthTable.of(line, candidates, price, 2, ABOVE_MM)
    return table, table.rows(0, table.levels)[:, line.rank].T


@pytest.fixture(params=[10**6, 3000, 1])
def at_once(request, monkeypatch):
    """Work on the whole table, on ten levels, on one."""
    monkeypatch.setattr(depth_table, "AT_ONCE", request.param)


def test_an_entry_is_the_least_misfit_of_the_points_candidates(scene):
    line, _, candidates, price = scene
    table, found = misfits(line, candidates, price)
    height = table.lowest + table.step * np.arange(table.levels)  # 1 / mm, from the camera
    wanted = np.full((300, table.levels), MISFIT_LIMIT_PX)
    away = candidates.xyz_mm[:, 2] - ABOVE_MM
    rate = candidates.px_per_mm * away**2 * np.maximum(candidates.sine, SHALLOW)
    for row in range(len(candidates)):
        misfit = np.abs(height - 1 / away[row]) * rate[row] + price[row]
        point = candidates.point[row]
        wanted[point] = np.minimum(wanted[point], misfit)
    np.testing.assert_allclose(found, wanted, atol=1e-4)
    # at its own height, to half a step, a candidate costs its price at most
    at = table.at(candidates.point, candidates.xyz_mm[:, 2])
    assert (at <= price + 0.5 * table.step * rate + 1e-4).all()


def test_some_levels_are_the_same_as_all(scene):
    line, _, candidates, price = scene
    table = DepthTable.of(line, candidates, price, 2, ABOVE_MM)
    whole = table.rows(0, table.levels)
    for start, stop in ((0, 1), (17, 40), (table.levels - 3, table.levels)):
        np.testing.assert_array_equal(table.rows(start, stop), whole[start:stop])


@pytest.mark.usefixtures("at_once")
def test_any_point_can_be_asked_at_any_height(scene):
    line, _, candidates, price = scene
    table, whole = misfits(line, candidates, price)
    rng = np.random.default_rng(2)
    point, height = rng.integers(0, 300, (40, 3)), rng.uniform(-25, 25, (40, 3))
    column = table.column(height)
    assert (column < 0).any()
    wanted = np.where(column >= 0, whole[point, column], MISFIT_LIMIT_PX)
    np.testing.assert_array_equal(table.at(point, height), wanted)


def test_outside_of_the_table_everything_costs_the_limit(scene):
    line, _, candidates, price = scene
    table = DepthTable.of(line, candidates, price, 2, ABOVE_MM)
    far = table.at(np.array([3, 4, 5]), np.array([1e4, -1e4, np.inf]))
    assert (far == MISFIT_LIMIT_PX).all()


@pytest.mark.usefixtures("at_once")
@pytest.mark.parametrize("half", [6.0, 19.0, 400.0])
def test_a_square_has_the_mean_over_the_cells_around_each_point(scene, half):
    line, xy, candidates, price = scene
    table, whole = misfits(line, candidates, price)
    (mean,) = table.means(candidates, [Square.of(line, xy, half)])
    cell = ((xy - xy.min(axis=0)) / (2 * half / CELLS)).astype(int)
    column = table.column(candidates.xyz_mm[:, 2])
    for row in range(0, len(candidates), 23):
        mine = cell[candidates.point[row]]
        near = (np.abs(cell - mine) <= CELLS // 2).all(axis=1)
        assert mean[row] == pytest.approx(whole[near, column[row]].mean(), abs=1e-5)


@pytest.mark.usefixtures("at_once")
def test_a_strip_has_the_mean_over_the_points_of_its_chain(scene):
    line, xy, candidates, price = scene
    table, whole = misfits(line, candidates, price)
    _, mean = table.means(candidates, [Square.of(line, xy, 9.0), Strip.of(line, 20)])
    column = table.column(candidates.xyz_mm[:, 2])
    first, last = np.array([0, 120, 132]), np.array([119, 131, 299])
    for row in range(0, len(candidates), 17):
        point = candidates.point[row]
        chain = np.searchsorted(last, point)
        low, high = max(point - 20, first[chain]), min(point + 20, last[chain])
        wanted = whole[low : high + 1, column[row]].mean()
        assert mean[row] == pytest.approx(wanted, abs=1e-5)


def test_one_candidate_is_table_enough():
    candidates = candidates_of([0], [3.0], [2.0], [0.5])
    line = Line.of(np.array([-1]))
    table = DepthTable.of(line, candidates, np.zeros(1), 2, ABOVE_MM)
    assert table.at(np.array([0]), np.array([3.0]))[0] == pytest.approx(0.0, abs=1e-6)
    for element in (Square.of(line, np.zeros((1, 2)), 9.0), Strip.of(line, 5)):
        assert table.means(candidates, [element])[0][0] == pytest.approx(0.0, abs=1e-6)


def test_the_line_keeps_chains_together():
    after = np.array([3, -1, 5, 1, 2, 4])  # 0 3 1, and closed 2 5 4
    line = Line.of(after)
    assert line.order.tolist() == [0, 3, 1, 2, 5, 4]
    assert line.order[line.rank].tolist() == list(range(6))
    assert line.start.tolist() == [0, 0, 3, 0, 3, 3]
    assert line.stop.tolist() == [3, 3, 6, 3, 6, 6]
