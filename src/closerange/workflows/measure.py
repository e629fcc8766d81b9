"""The verb `measure`: image points and a rig become positions."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from closerange.features.image_points import ImagePoints
from closerange.features.points_table import read_points
from closerange.matching.correspondences import Correspondences
from closerange.position.measure import measure_points
from closerange.position.positions import Positions
from closerange.rig.rig import Rig
from closerange.rig.rig_file import read_rig


def measure(
    rig: Rig | Path | str,
    points: ImagePoints | Correspondences | Path | str | Sequence[Path | str],
) -> Positions:
    """Measure world positions of points that two or more cameras see.

    Parameters
    ----------
    rig : Rig or path
        Calibrated cameras, or their file.
    points : ImagePoints, Correspondences, path or sequence of paths
        Image points, matches, or their tables.

    Returns
    -------
    Positions
        In mm, each with covariance, residual and flags.

    Raises
    ------
    InputError
        If a file cannot be used or a camera is not in the rig.
    """
    if not isinstance(rig, Rig):
        rig = read_rig(rig)
    if isinstance(points, Correspondences):
        points = points.to_image_points()
    elif not isinstance(points, ImagePoints):
        points = read_points(*([points] if isinstance(points, (str, Path)) else points))
    return measure_points(rig, points)
