"""Deciding which disc of a lattice is row 0, column 0.

Each way to lay the target over the lattice costs one for every disc of the target that is not
seen, one for every disc seen beside the target, and two for every disc whose size belongs to
another place. An answer is given only when the next best costs clearly more.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from closerange.errors import DetectionError
from closerange.features.grid_growing import Candidates, Nodes
from closerange.features.pattern import DiscGrid
from closerange.features.plane_map import plane_roll
from closerange.geometry.arrays import FloatArray, IntArray

ROLL_LIMIT_RAD = float(np.radians(45))
"""Upright targets are read up to this roll, less the uncertainty of the roll itself: at 45 degrees
a square grid looks the same turned either way."""

LINE_ROLL_LIMIT_RAD = float(np.radians(60))
"""The same for a single row or column, which no quarter turn can be confused with. Two cameras
must differ by 60 degrees in roll before one could read a line the other way round."""

CLEARLY = 3.0
"""Least difference of cost between the best and the next answer: no single missing disc, nor
a single other thing in its place, moves it by more than 2."""

MARK_COST = 2.0
"""A disc of the wrong size weighs as much as a disc missing here and one too many there."""

LEAST_SEEN = 0.5
"""Share of the discs that must be seen; a smaller part may as well be something else."""

MOST_WRONG = 0.01
"""Share of discs that may have the size of another class (glare, dirt)."""

PITCHES_ALIKE = 1.1
"""Pitches that differ by more are told apart by the ellipses, so quarter turns are too."""


@dataclass(frozen=True, slots=True, eq=False)
class Layout:
    """One way to lay the target over the lattice.

    Attributes
    ----------
    cost : float
        See the module.
    wrong : int
        Discs whose size belongs to another place.
    index : ndarray of int, shape (N,)
        Candidate of each point of the target, -1 where there is none.
    """

    cost: float
    wrong: int
    index: IntArray

    @property
    def seen(self) -> int:
        """How many discs of the target are in the lattice."""
        return int(np.count_nonzero(self.index >= 0))


def refusal(found: int, grid: DiscGrid, why: str, remedy: str) -> DetectionError:
    """Build the error of a target that is not, or not unambiguously, in the image."""
    expected = grid.rows * grid.columns
    plural = "" if expected == 1 else "s"
    return DetectionError(
        f"{found} disc candidates found, {expected} disc{plural} expected "
        f"({grid.rows} rows x {grid.columns} columns): {why}",
        remedy=remedy,
    )


def place_lattice(
    nodes: Nodes, ratios: FloatArray, candidates: Candidates, grid: DiscGrid
) -> IntArray:
    """Decide which candidate is which disc.

    Parameters
    ----------
    nodes : dict of (int, int) to int
        A checked lattice of n discs.
    ratios : ndarray, shape (n,)
        Measured over predicted ordinary diameter, NaN where unknown.
    candidates : Candidates
        M discs.
    grid : DiscGrid
        The target.

    Returns
    -------
    ndarray of int, shape (N,)
        Candidate of each disc in row-major order, -1 where it is missing.

    Raises
    ------
    DetectionError
        If the labels, or the orientation, cannot be decided, or the target is mirrored.
    """
    ij = np.array(list(nodes), dtype=np.int64)
    index = np.array(list(nodes.values()), dtype=np.int64)
    classes = _classes(ratios, grid)
    alike = max(grid.pitch_mm) / min(grid.pitch_mm) < PITCHES_ALIKE
    turns = (0, 1, 2, 3) if alike else (0, 2)
    layouts = {turn: _layouts(_turned(ij, turn), index, classes, grid) for turn in turns}
    if grid.orientation == "upright":
        best = _upright(layouts, ij, candidates.xy_px[index], len(candidates), grid)
    else:
        mirrored = [
            layout
            for turn in turns
            for layout in _layouts(_turned(ij[:, ::-1], turn), index, classes, grid)
        ]
        best = _by_marks(layouts, mirrored, len(candidates), grid)
    if best.seen < max(LEAST_SEEN * grid.rows * grid.columns, 4):
        raise refusal(
            len(candidates),
            grid,
            f"only {best.seen} stand in the target's grid",
            "bring the whole target into view, sharp and evenly lit",
        )
    return best.index


def place_line(line: tuple[int, ...], candidates: Candidates, grid: DiscGrid) -> IntArray:
    """Decide which end of a single row or column comes first.

    Parameters
    ----------
    line : tuple of int
        Candidates in order, as many as the target has discs.
    candidates : Candidates
        M discs.
    grid : DiscGrid
        A target of one row or one column.

    Returns
    -------
    ndarray of int, shape (N,)
        Candidate of each disc.

    Raises
    ------
    DetectionError
        If the roll is too near to where the two ends exchange, or marks contradict.
    """
    index = np.array(line, dtype=np.int64)
    radius = candidates.radius_px[index]
    classes = _classes(radius / np.median(radius), grid)
    wanted = _class_numbers(grid)
    wrong = [int((classes != wanted).sum()), int((classes[::-1] != wanted).sum())]
    if grid.orientation == "marks":
        if min(wrong) or wrong[0] == wrong[1]:
            raise _marks_contradict(len(candidates), grid)
        return index if wrong[0] == 0 else index[::-1]
    x = candidates.xy_px[index]
    # through the discs' ellipses a tilt does not count as roll
    along = candidates.whitener[index].mean(axis=0) @ (x[-1] - x[0])
    angle = float(np.arctan2(along[1], along[0]))
    if grid.columns == 1:
        angle -= np.pi / 2
    angle = (angle + np.pi) % (2 * np.pi) - np.pi
    if abs(angle) > np.pi / 2:
        index, wrong = index[::-1], wrong[::-1]
        angle -= np.copysign(np.pi, angle)
    if abs(angle) > LINE_ROLL_LIMIT_RAD:
        other = "rows" if grid.columns == 1 else "columns"
        raise refusal(
            len(candidates),
            grid,
            f"the line is rolled by {np.degrees(angle):.0f} degrees, the limit is "
            f"{np.degrees(LINE_ROLL_LIMIT_RAD):.0f}",
            f"turn the target, exchange rows and columns (now {other} = {len(line)}), "
            "or use mark discs",
        )
    if wrong[0]:
        raise _marks_contradict(len(candidates), grid)
    return index


def _upright(
    layouts: dict[int, list[Layout]], ij: IntArray, xy_px: FloatArray, found: int, grid: DiscGrid
) -> Layout:
    """Take the turn of least roll; refuse near the limit and where the shape contradicts."""
    pitch = np.array(grid.pitch_mm)
    rolls = {turn: plane_roll(_turned(ij, turn) * pitch, xy_px) for turn in layouts}
    turn = min(rolls, key=lambda key: abs(rolls[key][0]))
    roll, margin = rolls[turn]
    if abs(roll) + margin > ROLL_LIMIT_RAD:
        raise refusal(
            found,
            grid,
            f"rolled by {np.degrees(abs(roll)):.1f} degrees; an upright target is read up to "
            f"{np.degrees(ROLL_LIMIT_RAD - margin):.1f}",
            'turn target or camera, or use a target with mark discs (orientation = "marks")',
        )
    best, second = sorted(layouts[turn], key=lambda layout: layout.cost)[:2]
    span = np.ptp(_turned(ij, turn), axis=0) + 1
    across = min(min(part, key=lambda layout: layout.cost).cost for part in layouts.values())
    if across <= best.cost - CLEARLY and grid.rows != grid.columns:
        raise refusal(
            found,
            grid,
            f"the image shows {span[1]} rows x {span[0]} columns",
            "exchange rows and columns in the target file, or turn the target upright",
        )
    if best.wrong > MOST_WRONG * grid.rows * grid.columns:
        raise _marks_contradict(found, grid)
    if best.cost > 0 and second.cost - best.cost < CLEARLY:
        raise refusal(
            found,
            grid,
            f"the image shows {span[1]} rows x {span[0]} columns of equal discs; which of them "
            "are the target's cannot be decided",
            "bring all outer rows and columns into view, remove other round things, "
            "or use mark discs",
        )
    return best


def _by_marks(
    layouts: dict[int, list[Layout]], mirrored: list[Layout], found: int, grid: DiscGrid
) -> Layout:
    """Take the cheapest layout if it is clearly cheaper than every other one."""
    best, second = sorted(
        (layout for part in layouts.values() for layout in part), key=lambda layout: layout.cost
    )[:2]
    if min(layout.cost for layout in mirrored) <= best.cost - CLEARLY:
        raise refusal(
            found,
            grid,
            "the target is mirrored: its mark discs fit only a mirror image",
            "do not mirror the image; look at the printed side; check mark_discs "
            "(rows count from the top)",
        )
    if best.wrong > MOST_WRONG * grid.rows * grid.columns:
        raise _marks_contradict(found, grid)
    if second.cost - best.cost < CLEARLY:
        raise refusal(
            found,
            grid,
            "the mark discs seen do not decide between two orientations",
            "bring all mark discs into view, sharp and evenly lit",
        )
    return best


def _marks_contradict(found: int, grid: DiscGrid) -> DetectionError:
    return refusal(
        found,
        grid,
        "the sizes of the discs contradict mark_discs",
        "check rows, columns and diameters of mark_discs; rows count from the top",
    )


def _turned(ij: IntArray, turn: int) -> IntArray:
    """Return (column, row) after a number of quarter turns, right-handed in the image."""
    for _ in range(turn):
        ij = np.column_stack([ij[:, 1], -ij[:, 0]])
    return ij


def _class_numbers(grid: DiscGrid) -> IntArray:
    """Give numbers to the diameters of the target's discs in ascending order; shape (N,)."""
    return np.unique(grid.diameters_mm, return_inverse=True)[1].reshape(-1).astype(np.int64)


def _classes(ratios: FloatArray, grid: DiscGrid) -> IntArray:
    """Give each disc the number of the nearest diameter, -1 where its size is unknown."""
    known = np.isfinite(ratios)
    if not known.any():
        return np.full(len(ratios), -1)
    sizes = np.unique(grid.diameters_mm) / np.median(grid.diameters_mm)
    scaled = ratios / np.median(ratios[known])
    distance = np.abs(np.log(np.where(known, scaled, 1.0))[:, None] - np.log(sizes))
    return np.where(known, distance.argmin(axis=1), -1)


def _layouts(place: IntArray, index: IntArray, classes: IntArray, grid: DiscGrid) -> list[Layout]:
    """Lay the target over the lattice at every offset that could compete."""
    wanted = _class_numbers(grid)
    return [
        _layout(place - np.array([column, row]), index, classes, wanted, grid)
        for column in _offsets(place[:, 0], grid.columns)
        for row in _offsets(place[:, 1], grid.rows)
    ]


def _layout(
    place: IntArray, index: IntArray, classes: IntArray, wanted: IntArray, grid: DiscGrid
) -> Layout:
    column, row = place.T
    inside = (column >= 0) & (column < grid.columns) & (row >= 0) & (row < grid.rows)
    point = row[inside] * grid.columns + column[inside]
    result = np.full(len(wanted), -1, dtype=np.int64)
    result[point] = index[inside]
    size = classes[inside]
    wrong = int(np.count_nonzero((size >= 0) & (size != wanted[point])))
    seen = int(inside.sum())
    return Layout(
        cost=len(wanted) - seen + (len(index) - seen) + MARK_COST * wrong,
        wrong=wrong,
        index=result,
    )


def _offsets(values: IntArray, count: int) -> Iterator[int]:
    """Yield first places: all that hold the seen extent, or lie in it, and one more each way."""
    ends = (int(values.min()), int(values.max()) - count + 1)
    yield from range(min(ends) - 1, max(ends) + 2)
