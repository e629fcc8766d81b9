"""Regular errors of the device that positions a target: lost turns, end stops, a wrong scale.

Control points are often positions of one target, read from dials or a stage. Such a device errs
for whole placements at once: beyond its travel the dial stands still, a lost turn shifts all that
comes after it, a wrong scale stretches all distances. Each of these is put up as a hypothesis, a
displacement of the control points with one to three free numbers, and estimated together with
whatever else is free (the parameters of the cameras), by linear least squares about what was
fitted. What the cameras can imitate, such as one scale of all depths, leaves no trace in a
calibration; a comparison with an independent truth shows it.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from scipy.special import fdtrc

from closerange.features.control import ControlPoints
from closerange.flags import Flag
from closerange.geometry.arrays import BoolArray, FloatArray, IntArray
from closerange.position.positions import Positions
from closerange.rig.rig import Rig

EXPLAINS = 0.5
"""Share of the squared residuals that one hypothesis must account for: it has one to three numbers
for all points, and no mixture of small errors puts half of its squares into so few."""

FALSE_ALARM = 0.01
"""Chance that points without any such error raise one, shared by all hypotheses; it matters where
few points are left to judge by."""

TIED = 2.0
"""Hypotheses whose remaining variances differ by less than this factor cannot be told apart."""

NAMED = 3
"""Hypotheses named at most."""

SURE = 3.0
"""Stated standard deviations that an error must exceed where they are known: less may come from
the calibration itself."""

MAX_PLACEMENTS = 300
"""Placements up to which hypotheses are tried: bounds the time to some seconds."""

SEEN = 1e-6
"""Share of a displacement's square that must remain beside the free parameters: they have
imitated the rest, and below this only rounding is left."""

BEARABLE = int(Flag.outside_volume | Flag.untrusted)
"""Flags of positions that may still be compared."""


@dataclass(frozen=True, slots=True, eq=False)
class _Block:
    """Residuals that share free parameters: one camera, or all positions; m points.

    Attributes
    ----------
    rows : ndarray of int, shape (m,)
        Which of all N points.
    residual : ndarray, shape (m, d)
        Seen minus expected.
    free : ndarray, shape (m, d, p)
        Its change by the free parameters.
    by_point : ndarray, shape (m, d, 3)
        Change of what is expected by the point's position.
    """

    rows: IntArray
    residual: FloatArray
    free: FloatArray
    by_point: FloatArray


@dataclass(frozen=True, slots=True, eq=False)
class _Points:
    """What is examined; N points."""

    placement: tuple[str, ...]
    xyz_mm: FloatArray
    blocks: tuple[_Block, ...]
    floor_mm: FloatArray  # errors below are not reported, per axis


@dataclass(frozen=True, slots=True, eq=False)
class _Hypothesis:
    """An error of the control points: `directions` (N, k, 3) times k unknown numbers."""

    words: str
    directions: FloatArray


@dataclass(frozen=True, slots=True, eq=False)
class _Finding:
    """A hypothesis that explains most of the residuals."""

    words: str
    before: float
    after: float


def travel_hints(rig: Rig) -> list[str]:
    """Say which regular errors of the control points would explain a calibration's residuals.

    Parameters
    ----------
    rig : Rig
        Calibrated with control points in several placements.

    Returns
    -------
    list of str
        One sentence a finding; empty where nothing is suspicious, or nothing could be seen.

    Notes
    -----
    Residuals are compared unweighted. Placements whose points were left out as outliers are
    examined one by one, the others together.
    """
    rows = rig.residuals
    outlier = (rows.flags & int(Flag.outlier)) != 0
    usable = (rows.fitted | outlier) & np.isfinite(rows.residual_px).all(axis=1)
    points = _Points(rows.placement, rows.xyz_mm, tuple(_camera_blocks(rig)), np.zeros(3))
    lost = _mostly(rows.placement, usable, outlier)
    names = _placements(rows.placement, usable)
    if not 1 < len(names) <= MAX_PLACEMENTS:
        return []
    findings = []
    for name in lost:
        here = np.array([placement == name for placement in rows.placement])
        one = [_shift(points, name)]
        findings += _explaining(points, one, (rows.fitted | here) & usable, trials=len(names))
    kept = rows.fitted & usable & ~_among(rows.placement, lost)
    findings += _explaining(points, list(_hypotheses(points, kept)), kept)
    return [_sentence(finding, "px") for finding in findings]


def truth_hints(positions: Positions, truth: ControlPoints) -> list[str]:
    """Say which regular errors would explain how positions differ from their truth.

    Parameters
    ----------
    positions : Positions
        What was measured.
    truth : ControlPoints
        Known positions, of several placements.

    Returns
    -------
    list of str
        As `travel_hints`. The truth or the calibration may be wrong: the difference is theirs.
    """
    row = truth.rows_for(positions.placement, positions.point)
    good = (row >= 0) & positions.measured & ((positions.flags & ~BEARABLE) == 0)
    chosen = np.flatnonzero(good)
    placement = tuple(positions.placement[i] for i in chosen)
    if not 1 < len(set(placement)) <= MAX_PLACEMENTS:
        return []
    known = truth.xyz_mm[row[chosen]]
    variance = np.einsum("mii->mi", positions.cov_mm2[chosen])
    identity = np.broadcast_to(np.eye(3), (len(chosen), 3, 3))
    block = _Block(
        np.arange(len(chosen), dtype=np.int64), positions.xyz_mm[chosen] - known, identity, identity
    )  # the frames' origins may differ: a shift of everything is free
    floor = SURE * np.sqrt(np.median(variance, axis=0))
    points = _Points(placement, known, (block,), floor)
    everything = np.ones(len(chosen), dtype=bool)
    findings = _explaining(points, list(_hypotheses(points, everything)), everything)
    return [_sentence(finding, "mm") for finding in findings]


def _camera_blocks(rig: Rig) -> Iterator[_Block]:
    rows = rig.residuals
    for camera in rig.cameras:
        mine = np.flatnonzero([name == camera.name for name in rows.camera]).astype(np.int64)
        names, _ = rig.parameters_of(camera.name)
        xyz = rows.xyz_mm[mine]
        yield _Block(
            mine,
            rows.residual_px[mine],
            camera.parameter_jacobian(xyz, names),
            camera.project_jacobian(xyz),
        )


def _placements(placement: Sequence[str], wanted: BoolArray) -> list[str]:
    return list(dict.fromkeys(name for name, use in zip(placement, wanted, strict=True) if use))


def _mostly(placement: Sequence[str], usable: BoolArray, outlier: BoolArray) -> list[str]:
    """List the placements half of whose points or more were left out."""
    names = np.array(placement)
    return [
        name
        for name in _placements(placement, usable)
        if 2 * np.count_nonzero(outlier & (names == name)) >= np.count_nonzero(names == name)
    ]


def _among(placement: Sequence[str], names: Sequence[str]) -> BoolArray:
    chosen = set(names)
    return np.array([name in chosen for name in placement], dtype=bool)


def _hypotheses(points: _Points, used: BoolArray) -> Iterator[_Hypothesis]:
    """List what may have happened to the device, for the placements that are used."""
    names = _placements(points.placement, used)
    for name in names:
        yield _shift(points, name)
    number = {name: i for i, name in enumerate(names)}
    index = np.array([number.get(name, -1) for name in points.placement])
    middles = np.array([points.xyz_mm[index == i].mean(axis=0) for i in range(len(names))])
    for axis, letter in enumerate("xyz"):
        along = middles[:, axis]
        levels = np.unique(np.round(along, 6))
        if len(levels) < 2:
            continue
        place = np.where(index >= 0, along[index] - along.mean(), 0.0)
        yield _Hypothesis(
            f"the placements' distances along {letter} are {{:+.2%}} wrong",
            _along(place, axis),
        )
        for low, high in pairwise(levels):
            beyond = along > (low + high) / 2
            if min(np.count_nonzero(beyond), np.count_nonzero(~beyond)) > 1:  # one: a shift
                yield _Hypothesis(
                    f"{letter}_mm is {{:+.3f}} mm wrong in the placements from {letter} = "
                    f"{high:g} mm on",
                    _along((beyond[index] & (index >= 0)).astype(float), axis),
                )


def _shift(points: _Points, name: str) -> _Hypothesis:
    here = np.array([placement == name for placement in points.placement])
    return _Hypothesis(
        f"the positions of placement {name!r} are ({{:+.3f}}, {{:+.3f}}, {{:+.3f}}) mm wrong",
        here[:, None, None] * np.eye(3),
    )


def _along(size: FloatArray, axis: int) -> FloatArray:
    directions = np.zeros((len(size), 1, 3))
    directions[:, 0, axis] = size
    return directions


def _explaining(
    points: _Points, hypotheses: Sequence[_Hypothesis], used: BoolArray, *, trials: int = 0
) -> list[_Finding]:
    """Return the hypotheses that explain most, as one finding if they cannot be told apart."""
    level = FALSE_ALARM / max(trials, len(hypotheses), 1)
    prepared = [_beside_free(block, used) for block in points.blocks]
    found: list[_Finding] = []
    for hypothesis in hypotheses:
        finding = _tested(points, prepared, hypothesis, level)
        if finding is not None:
            found.append(finding)
    if not found:
        return []
    best = min(found, key=lambda finding: finding.after)
    # those that tie are named in the order of the hypotheses, whatever the last digits say
    words = [f.words for f in found if f.after**2 <= TIED * best.after**2][:NAMED]
    return [_Finding(", or ".join(words), best.before, best.after)]


def _beside_free(block: _Block, used: BoolArray) -> tuple[_Block, FloatArray]:
    """Return the used points of a block, and an orthonormal basis of its free parameters."""
    mine = used[block.rows]
    free = block.free[mine]
    matrix = free.reshape(-1, free.shape[2])
    scale = np.linalg.norm(matrix, axis=0)
    basis, _ = np.linalg.qr(matrix / np.where(scale > 0, scale, 1.0))
    chosen = _Block(block.rows[mine], block.residual[mine], free, block.by_point[mine])
    return chosen, basis


def _tested(
    points: _Points,
    prepared: Sequence[tuple[_Block, FloatArray]],
    hypothesis: _Hypothesis,
    level: float,
) -> _Finding | None:
    """Estimate a hypothesis; None if it does not explain enough."""
    count = hypothesis.directions.shape[1]
    normal, right = np.zeros((count, count)), np.zeros(count)
    squares, dof, whole = 0.0, 0, 0.0
    for block, basis in prepared:
        residual = block.residual.ravel()
        residual = residual - basis @ (basis.T @ residual)
        directions = hypothesis.directions[block.rows]
        # control too large by e: what is expected moves by +e, what is seen minus that by -e
        column = -np.einsum("mdx,mkx->mdk", block.by_point, directions).reshape(-1, count)
        whole += float(np.sum(column**2))
        column = column - basis @ (basis.T @ column)
        normal += column.T @ column
        right += column.T @ residual
        squares += float(residual @ residual)
        dof += residual.size - basis.shape[1]
    left = dof - count
    if left < 1 or squares <= 0 or not np.linalg.eigvalsh(normal)[0] > SEEN * whole:
        return None
    size = np.linalg.solve(normal, right)
    gain = float(size @ right)
    after = max(squares - gain, 0.0)
    ratio = gain / count / max(after / left, np.finfo(float).tiny)
    error = np.abs(np.einsum("mkx,k->mx", hypothesis.directions, size)).max(axis=0)
    if (
        gain < EXPLAINS * squares
        or fdtrc(count, left, ratio) > level
        or not (error > points.floor_mm).any()
    ):
        return None
    words = hypothesis.words.format(*size)
    return _Finding(words, float(np.sqrt(squares / dof)), float(np.sqrt(after / left)))


def _sentence(finding: _Finding, unit: str) -> str:
    return (
        f"the known positions look as if {finding.words}: corrected, the differences would fall "
        f"from {finding.before:.3g} to {finding.after:.3g} {unit}. Was the positioning device "
        "(dial, stage) beyond its travel, did it lose a turn, or is its scale another?"
    )
