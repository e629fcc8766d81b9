"""The page "The thesis, reproduced": its averages equal the print, and it is up to date."""

from __future__ import annotations

import importlib
import re
from pathlib import Path

import numpy as np
import pytest

ROOT = Path(__file__).parents[2]


@pytest.fixture
def benchmark(monkeypatch):
    """Import modules of the generator, which stands outside of the package."""
    monkeypatch.syspath_prepend(str(ROOT / "benchmarks"))
    return importlib.import_module


@pytest.mark.parametrize(
    ("points", "rows", "printed"),
    [
        (18, 28, [0.04552, 0.01700, 0.05050, 0.07785]),
        (27, 37, [0.04245, 0.01748, 0.04240, 0.06956]),
    ],
)
def test_averages_over_all_rows_equal_the_print(benchmark, points, rows, printed):
    positions = benchmark("thesis.positions")
    run = positions.read_run(points)
    assert len(run.check) == rows
    assert run.check.sum() == 10
    # 1e-5 mm is the print's last digit; rows were rounded before they were averaged
    np.testing.assert_allclose(positions.averages(run), printed, atol=1.0e-5)


def test_averages_of_the_54_point_run_equal_the_print_where_rows_survive(benchmark):
    positions = benchmark("thesis.positions")
    run = positions.read_run(54)
    assert len(run.check) == 64
    mean = positions.averages(run)
    np.testing.assert_allclose(mean[2], 0.04765, atol=1.0e-5)
    # two X, two Y and one spatial error are lost: what is missing must be positive and small
    printed = np.array([0.04895, 0.01760, 0.04765, 0.08097])
    lost = np.isnan(run.error_mm).sum(axis=0)
    np.testing.assert_array_equal(lost, [2, 2, 0, 1])
    missing = 64 * printed - np.nansum(run.error_mm, axis=0)
    np.testing.assert_allclose(missing[[0, 1, 3]], [0.0855, 0.0316, 0.1537], atol=1e-3)


def test_errors_agree_with_the_positions_they_come_from(benchmark):
    positions = benchmark("thesis.positions")
    for points in (18, 27, 54):
        run = positions.read_run(points)
        recomputed = np.abs(run.calculated_mm - run.nominal_mm)
        known = np.isfinite(recomputed)
        # the source rounds its last digit differently by up to 3e-5
        np.testing.assert_allclose(run.error_mm[:, :3][known], recomputed[known], atol=3.1e-5)


def test_check_rows_are_worse_than_fitted_rows_in_space(benchmark):
    positions = benchmark("thesis.positions")
    for points, fitted, check in ((18, 0.0628, 0.1050), (27, 0.0633, 0.0864), (54, 0.0641, 0.1742)):
        run = positions.read_run(points)
        assert positions.averages(run, ~run.check)[3] == pytest.approx(fitted, abs=5e-5)
        assert positions.averages(run, run.check)[3] == pytest.approx(check, abs=5e-5)


def test_most_of_the_lateral_residual_stays_with_the_dot(benchmark):
    positions = benchmark("thesis.positions")
    runs = [positions.read_run(points) for points in (18, 27, 54)]
    _, residuals = positions.dot_residuals(runs)
    share, before, after = positions.repeated_share(residuals)
    np.testing.assert_allclose(share[:2], [0.89, 0.73], atol=0.005)
    np.testing.assert_allclose(before, [0.051, 0.021, 0.047], atol=5e-4)
    np.testing.assert_allclose(after, [0.017, 0.011, 0.042], atol=5e-4)


def test_decomposition_gives_back_the_matrix_up_to_scale(benchmark):
    parameters = benchmark("thesis.parameters")
    for matrix in parameters.readings().values():
        camera = parameters.decompose(matrix)
        np.testing.assert_allclose(matrix @ [*camera.centre_mm, 1], 0, atol=1e-9)
        # K K' and M M' agree up to scale
        k = np.array(
            [
                [camera.fx_px, camera.skew_px, camera.principal_px[0]],
                [0, camera.fy_px, camera.principal_px[1]],
                [0, 0, 1],
            ]
        )
        m = matrix[:, :3]
        np.testing.assert_allclose(k @ k.T, m @ m.T / (m[2] @ m[2]), rtol=1e-9, atol=1e-6)


def test_half_range_of_90_normal_values(benchmark):
    evaluation = benchmark("thesis.evaluation")
    sampled = np.ptp(np.random.default_rng(1).standard_normal((20_000, 90)), axis=1).mean() / 2
    # 20 000 samples: standard error 0.002
    assert evaluation.half_range_factor(90) == pytest.approx(sampled, abs=0.01)
    assert evaluation.half_range_factor(90) == pytest.approx(2.47, abs=0.005)


def test_page_is_deterministic_and_up_to_date(benchmark):
    page = benchmark("thesis_reproduced")
    printed = page.printed_page()
    assert page.printed_page() == printed
    committed = page.PAGE.read_text(encoding="utf-8")
    assert page.OURS_BEGIN in committed
    found = benchmark("thesis.tables").differences(page.without_ours(committed), printed)
    assert not found, "run: python benchmarks/thesis_reproduced.py"


def test_comparison_of_pages_finds_a_changed_number_and_a_changed_word(benchmark):
    differences = benchmark("thesis.tables").differences
    assert differences("error 0.0421 mm", "error 0.0422 mm") == []
    assert differences("error 0.0421 mm", "error 0.0424 mm")
    assert differences("error 0.0421 mm", "error 0.0424 mm", share=0.01) == []
    assert differences("error 0.0421 mm", "errors 0.0421 mm")
    assert differences("a", "a\nb")


def test_no_table_cell_is_split_by_a_bar(benchmark):
    page = benchmark("thesis_reproduced").printed_page()
    tables = re.findall(r"(?:^\|.*\n)+", page, re.MULTILINE)
    assert len(tables) >= 12
    for table in tables:
        assert len({line.count("|") for line in table.splitlines()}) == 1, table
