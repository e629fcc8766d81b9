"""Matched edges as a wire frame: their positions, and lines between neighbours on an edge."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from closerange.delivery.ply import write_ply
from closerange.geometry.arrays import FloatArray, IntArray
from closerange.matching.correspondences import Correspondences
from closerange.position.measure import measure_points
from closerange.rig.rig import Rig

STEEPEST = 5.0
"""Length of a line, per the median length, above which it is left out: an edge so steep that points
a pixel apart lie five times as far apart in space is seen at 80 degrees, where it hardly is one
edge any more."""

_NAME = re.compile(r"e(\d+)\.(\d+)")


@dataclass(frozen=True, slots=True)
class Drawn:
    """What was written."""

    vertices: int
    lines: int


def write_wire_frame(rig: Rig, matches: Correspondences, path: Path | str) -> Drawn:
    """Write the positions of unflagged matches, linked along edges, as PLY.

    Parameters
    ----------
    rig : Rig
        Calibrated cameras.
    matches : Correspondences
        Matches; edge points named as `closerange.match` names them are linked.
    path : Path or str
        File, replaced whole or not at all.

    Returns
    -------
    Drawn
        How many points and lines. Points have ``std``, the root of the trace of their covariance
        in mm, and a colour by Z.
    """
    clean = matches.select(np.flatnonzero(matches.clean)) if matches.clean.any() else None
    if clean is None:
        write_ply(path, np.empty((0, 3)), std_mm=[], lines=[], colour_by=[])
        return Drawn(0, 0)
    positions = measure_points(rig, clean.to_image_points())
    usable = positions.measured & (positions.flags == 0)
    xyz_mm = positions.xyz_mm[usable]
    point = [name for name, use in zip(positions.point, usable, strict=True) if use]
    lines = neighbours(point, xyz_mm)
    write_ply(
        path,
        xyz_mm,
        std_mm=np.sqrt(np.trace(positions.cov_mm2[usable], axis1=1, axis2=2)),
        lines=lines,
        colour_by=xyz_mm[:, 2],
    )
    return Drawn(len(point), len(lines))


def neighbours(point: Sequence[str], xyz_mm: FloatArray) -> IntArray:
    """Return pairs of points that follow each other on an edge.

    Parameters
    ----------
    point : sequence of str
        N names; ``e{chain}.{place}`` for edge points, others have no neighbours.
    xyz_mm : ndarray, shape (N, 3)
        Positions.

    Returns
    -------
    ndarray of int, shape (M, 2)
        Rows; without pairs that are much farther apart than usual, as where one edge passes
        behind another.
    """
    row_of: dict[tuple[int, int], int] = {}
    for row, name in enumerate(point):
        found = _NAME.fullmatch(name)
        if found:
            row_of[int(found[1]), int(found[2])] = row
    pairs = np.array(
        [
            (row, row_of[chain, place + 1])
            for (chain, place), row in row_of.items()
            if (chain, place + 1) in row_of
        ],
        dtype=np.int64,
    ).reshape(-1, 2)
    if not len(pairs):
        return pairs
    length = np.linalg.norm(xyz_mm[pairs[:, 1]] - xyz_mm[pairs[:, 0]], axis=1)
    return np.asarray(pairs[length <= STEEPEST * np.median(length)])
