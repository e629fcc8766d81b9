"""Arrays that stay what they were checked to be."""

from __future__ import annotations

from typing import Any, TypeAlias

import numpy as np
from numpy.typing import ArrayLike, NDArray

FloatArray: TypeAlias = NDArray[np.floating[Any]]
"""float64 throughout; NumPy's own functions are typed no narrower than this."""

IntArray: TypeAlias = NDArray[np.int64]
BoolArray: TypeAlias = NDArray[np.bool_]


def frozen_array(value: ArrayLike, shape: tuple[int | None, ...], name: str) -> FloatArray:
    """Copy into a read-only float64 array of a given shape.

    Parameters
    ----------
    value : array_like
        Any numbers.
    shape : tuple of int or None
        Expected shape; None accepts any length on that axis.
    name : str
        For the message.

    Returns
    -------
    ndarray of float64
        C-contiguous and not writeable.

    Raises
    ------
    ValueError
        If the shape differs.
    """
    array = np.array(value, dtype=np.float64, order="C")
    lengths = [0 if length is None else length for length in shape]
    if array.size == 0 and array.ndim == 1 and 0 in lengths:
        array = array.reshape(lengths)  # an empty list is no rows of any width
    return _checked(array, shape, name)


def frozen_ints(value: ArrayLike, shape: tuple[int | None, ...], name: str) -> IntArray:
    """Copy into a read-only int64 array of a given shape; see `frozen_array`."""
    return _checked(np.array(value, dtype=np.int64, order="C"), shape, name)


def _checked(array: NDArray[Any], shape: tuple[int | None, ...], name: str) -> NDArray[Any]:
    fits = array.ndim == len(shape) and all(
        wanted in (None, found) for wanted, found in zip(shape, array.shape, strict=True)
    )
    if not fits:
        wanted = tuple("N" if length is None else length for length in shape)
        raise ValueError(f"{name} has shape {array.shape}, expected {wanted}")
    array.flags.writeable = False
    return array


def all_finite(array: FloatArray, axis: int | tuple[int, ...]) -> BoolArray:
    """Return where all numbers along some axes are finite.

    Parameters
    ----------
    array : ndarray
        Any numbers.
    axis : int or tuple of int
        Axes that are reduced.

    Returns
    -------
    ndarray of bool
        One value for each remaining index.
    """
    return np.asarray(np.isfinite(array).all(axis=axis))
