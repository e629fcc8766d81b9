"""Matched edges as a wire frame: their positions, and lines between neighbours on an edge."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from closerange.delivery.ply import write_ply
from closerange.delivery.wire import neighbours
from closerange.flags import Flag
from closerange.matching.correspondences import Correspondences
from closerange.position.measure import measure_points
from closerange.rig.rig import Rig

__all__ = ["Drawn", "neighbours", "write_wire_frame"]


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
    # whoever asked for points outside of the calibrated volume wants to see them
    usable = positions.measured & (positions.flags & ~int(Flag.outside_volume) == 0)
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
