"""On how much of what was to be compared a result stands."""

from __future__ import annotations

import numpy as np

from closerange.features.control import ControlPoints
from closerange.geometry.arrays import BoolArray
from closerange.position.positions import Positions

MOST = 0.5
"""Share of rows left out above which a result says nothing: those that remain are the minority,
and chosen by a flag that looks at their errors."""


def hollow_text(left_out: int, total: int, noun: str) -> str:
    """Say that most rows were left out; empty where they were not.

    Parameters
    ----------
    left_out, total : int
        Rows that could not be used, of how many.
    noun : str
        What they are, in the plural.

    Returns
    -------
    str
        A clause, or nothing.
    """
    if left_out <= MOST * total:
        return ""
    return (
        f"{left_out} of {total} {noun} could not be used: the {total - left_out} that remain say "
        "nothing about the others"
    )


def without_reading(
    positions: Positions, used: BoolArray, truth: ControlPoints
) -> tuple[tuple[str, str], ...]:
    """List the actual positions that no usable row has measured.

    Parameters
    ----------
    positions : Positions
        M rows.
    used : ndarray of bool, shape (M,)
        Which are usable.
    truth : ControlPoints
        Actual positions; a row for all placements counts as measured when its point is, in any.

    Returns
    -------
    tuple of (str, str)
        (placement, point).
    """
    rows = positions.select(np.flatnonzero(used))
    hit = set(truth.rows_for(rows.placement, rows.point).tolist())
    anywhere = set(rows.point)
    return tuple(
        (placement, point)
        for row, (placement, point) in enumerate(zip(truth.placement, truth.point, strict=True))
        if row not in hit and not (placement == "" and point in anywhere)
    )
