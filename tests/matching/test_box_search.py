import itertools

import numpy as np
import pytest

from closerange.matching.box_search import best_box


def _integral(density):
    for _ in range(3):
        density = (density[1:] + density[:-1]).sum(axis=0) / 2
    return float(density)


def _brute_force(inside, worth):
    best = 0.0
    ranges = [list(itertools.combinations(range(n), 2)) for n in inside.shape]
    for (a, b), (c, d), (e, f) in itertools.product(*ranges):
        box = slice(a, b + 1), slice(c, d + 1), slice(e, f + 1)
        if inside[box].all():
            best = max(best, _integral(worth[box]))
    return best


@pytest.mark.parametrize("seed", range(12))
def test_it_finds_what_trying_every_box_finds(seed):
    rng = np.random.default_rng(seed)
    shape = tuple(rng.integers(2, 7, 3))
    inside = rng.random(shape) < rng.choice([0.7, 0.9, 1.0])
    worth = rng.random(shape)
    if not inside.any():
        return
    slices, value = best_box(inside, worth)
    assert inside[slices].all()
    assert value == pytest.approx(_brute_force(inside, worth), abs=1e-12)
    if value:
        assert _integral(worth[slices]) == pytest.approx(value)


def test_a_full_grid_is_one_box_and_an_empty_one_none():
    inside = np.ones((4, 5, 6), bool)
    slices, value = best_box(inside, np.ones((4, 5, 6)))
    assert slices == (slice(0, 4), slice(0, 5), slice(0, 6))
    assert value == pytest.approx(3 * 4 * 5)
    assert best_box(~inside, np.ones((4, 5, 6))) is None


def test_without_a_box_the_best_node_is_found():
    inside = np.zeros((3, 3, 3), bool)
    inside[0, 0, 0] = inside[2, 2, 2] = True
    worth = np.zeros((3, 3, 3))
    worth[2, 2, 2] = 1
    slices, value = best_box(inside, worth)
    assert slices == (slice(2, 3),) * 3
    assert value == 0
    slices, _ = best_box(inside, np.zeros((3, 3, 3)))
    assert inside[slices].all()
