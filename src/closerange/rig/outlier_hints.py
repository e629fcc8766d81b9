"""What may be wrong with the points that a calibration left out."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from closerange.geometry.arrays import FloatArray, IntArray
from closerange.geometry.intersection import intersect_linear
from closerange.rig.camera import Camera
from closerange.rig.observations import Observations

EXPLAINS = 10.0
"""A changed sign or label is named if it lowers the residual at least by this factor: by chance
one point in a hundred of those that lie within ten residuals does."""


def describe_outliers(
    observations: Observations,
    cameras: Sequence[Camera],
    rows: IntArray,
    xy_px: FloatArray,
    *,
    known_poses: bool = True,
) -> list[dict[str, Any]]:
    """List outliers with a guess at their cause.

    Parameters
    ----------
    observations : Observations
        All points.
    cameras : sequence of Camera
        Calibrated without the outliers.
    rows : ndarray of int, shape (K,)
        The outliers.
    xy_px : ndarray, shape (N, 2)
        Image positions that were compared.
    known_poses : bool, optional
        The positions are those of the control table; False where placements were estimated, so
        that no row of it can be blamed.

    Returns
    -------
    list of dict
        JSON-ready: camera, placement, point, residual_px and hint. Where the same control
        position is an outlier in several cameras, the control row is suspected and
        ``control_error_mm`` says by how much its position differs from the intersection of rays.
    """
    points = observations.points
    entries: list[dict[str, Any]] = []
    errors = _control_errors(observations, cameras, rows, xy_px) if known_poses else {}
    for row in rows:
        camera = cameras[observations.camera[row]]
        seen, known = xy_px[row], observations.xyz_mm[row]
        residual = seen - camera.project(known)[0]
        entry: dict[str, Any] = {
            "camera": points.camera[row],
            "placement": points.placement[row],
            "point": points.point[row],
            "residual_px": [_finite(value) for value in residual],
            "hint": "",
        }
        error = errors.get(int(observations.control_row[row]))
        sign = _lost_sign(camera, known, seen) if known_poses else ""
        if error is not None:
            entry["control_error_mm"] = [float(value) for value in error]
            entry["hint"] = (
                f"outlier in several cameras: the control row is wrong, by "
                f"({error[0]:+.3f}, {error[1]:+.3f}, {error[2]:+.3f}) mm"
            )
        if sign:
            entry["hint"] = f"sign of {sign} lost in the control row?"
        entries.append(entry)
    for entry, row in zip(entries, rows, strict=True):
        camera = cameras[observations.camera[row]]
        entry["hint"] = entry["hint"] or _other_point(observations, camera, int(row), xy_px)
    return entries


def _control_errors(
    observations: Observations, cameras: Sequence[Camera], rows: IntArray, xy_px: FloatArray
) -> dict[int, FloatArray]:
    """Control position minus intersection of rays, where several cameras call it an outlier."""
    found: dict[int, FloatArray] = {}
    matrices = np.stack([camera.projection_matrix for camera in cameras])
    for control_row in np.unique(observations.control_row[rows]):
        mine = rows[observations.control_row[rows] == control_row]
        if len(np.unique(observations.camera[mine])) < 2:
            continue
        ideal = np.full((1, len(cameras), 2), np.nan)
        for row in mine:
            index = observations.camera[row]
            ideal[0, index] = cameras[index].undistort(xy_px[row])[0]
        seen = np.isfinite(ideal).all(axis=2)
        known = observations.xyz_mm[mine[0]]
        meeting = intersect_linear(matrices, ideal, seen, known)[0]
        if np.isfinite(meeting).all():
            found[int(control_row)] = known - meeting
    return found


def _lost_sign(camera: Camera, known_mm: FloatArray, seen_px: FloatArray) -> str:
    """Name the coordinate whose opposite explains where the point is seen; blank if none does."""
    before = np.linalg.norm(seen_px - camera.project(known_mm)[0])
    for axis, name in enumerate("xyz"):
        turned = known_mm.copy()
        turned[axis] = -turned[axis]
        after = np.linalg.norm(seen_px - camera.project(turned)[0])
        if turned[axis] != 0 and after * EXPLAINS < before:
            return name
    return ""


def _other_point(observations: Observations, camera: Camera, row: int, xy_px: FloatArray) -> str:
    """Say which other control point of the placement lies where this one is seen."""
    points = observations.points
    placement = points.placement[row]
    others = np.array([name == placement for name in points.placement])
    index = np.flatnonzero(others)
    miss = np.linalg.norm(camera.project(observations.xyz_mm[index]) - xy_px[row], axis=1)
    own = np.linalg.norm(camera.project(observations.xyz_mm[row])[0] - xy_px[row])
    if not np.isfinite(miss).any():
        return ""
    best = int(np.nanargmin(miss))
    other = points.point[index[best]]
    if other == points.point[row] or not miss[best] * EXPLAINS < own:
        return ""
    return f"it lies where point {other!r} is expected: labels exchanged?"


def _finite(value: float) -> float | None:
    return float(value) if np.isfinite(value) else None
