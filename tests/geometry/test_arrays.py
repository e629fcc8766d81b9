"""Frozen arrays: copied, checked, read-only."""

from __future__ import annotations

import numpy as np
import pytest

from closerange.geometry.arrays import all_finite, frozen_array, frozen_ints


def test_a_frozen_array_is_a_read_only_copy():
    source = np.arange(6, dtype=np.float32).reshape(2, 3)
    frozen = frozen_array(source, (2, 3), "x")
    source[0, 0] = 99
    assert frozen[0, 0] == 0
    assert frozen.dtype == np.float64
    with pytest.raises(ValueError, match="read-only"):
        frozen[0, 0] = 1


def test_any_length_where_none_is_asked():
    assert frozen_array([[1, 2]] * 5, (None, 2), "x").shape == (5, 2)


@pytest.mark.parametrize("value", [[1.0, 2.0], [[1.0, 2.0]], np.zeros((3, 4)), 1.0])
def test_wrong_shape_names_both(value):
    with pytest.raises(ValueError, match=r"xyz_mm has shape .* expected \('N', 3\)"):
        frozen_array(value, (None, 3), "xyz_mm")


def test_an_empty_list_is_no_rows_of_any_width():
    assert frozen_array([], (None, 3), "x").shape == (0, 3)
    assert frozen_array([], (0, 2, 2), "x").shape == (0, 2, 2)
    with pytest.raises(ValueError, match="expected"):
        frozen_array([], (4, 3), "x")


def test_integers():
    flags = frozen_ints([1, 2**17], (2,), "flags")
    assert flags.dtype == np.int64
    assert not flags.flags.writeable
    with pytest.raises(ValueError, match="flags has shape"):
        frozen_ints([1], (2,), "flags")


def test_all_finite():
    array = np.array([[1, np.nan], [1, 2], [np.inf, 0]])
    assert all_finite(array, 1).tolist() == [False, True, False]
    assert all_finite(array[None], (1, 2)).tolist() == [False]
