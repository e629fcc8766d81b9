"""Whether the image points of several cameras belong to one moment."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from closerange.features.image_points import ImagePoints
from closerange.features.points_table import read_points
from closerange.images import Exposures, check_exposures, read_exposures


def require_simultaneous(
    points: ImagePoints | Path | str | Sequence[Path | str],
    *,
    times: Exposures | Path | str,
    tolerance_s: float,
) -> None:
    """Refuse image points of a placement whose cameras did not expose together.

    Parameters
    ----------
    points : ImagePoints, path or sequence of paths
        Image points of all cameras, or their tables.
    times : Exposures or path
        When the images were taken, or their table: ``camera, placement, time_s``.
    tolerance_s : float
        Largest allowed difference between the cameras of one placement, in seconds.

    Raises
    ------
    InputError
        If an image has no time, or cameras exposed further apart.
    """
    if not isinstance(points, ImagePoints):
        points = read_points(*([points] if isinstance(points, (str, Path)) else points))
    if not isinstance(times, Exposures):
        times = read_exposures(times)
    images = zip(points.camera, points.placement, points.reading, strict=True)
    check_exposures(images, times, tolerance_s=tolerance_s)
