"""What a calibration says of its points: volume, residuals, contradictions and warnings.

It is the same for placements in known and in unknown poses; the latter put the estimated world
positions into `Observations.xyz_mm`.
"""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from closerange.errors import CloseRangeWarning, InputError
from closerange.flags import Flag
from closerange.geometry.arrays import BoolArray, FloatArray, IntArray
from closerange.rig.camera import Camera
from closerange.rig.diagnosis import BAD_PX
from closerange.rig.observations import Observations, listed
from closerange.rig.outliers import ROUNDING_PX, limit
from closerange.rig.rig import Residuals


def checked_volume(volume_mm: ArrayLike | None) -> FloatArray | None:
    """Return a stated volume as its two corners, shape (2, 3), or refuse it."""
    if volume_mm is None:
        return None
    try:
        volume = np.asarray(volume_mm, dtype=np.float64)
    except (TypeError, ValueError):  # texts, corners of unequal length
        volume = np.empty(0)
    if volume.shape not in ((2, 3), (6,)) or not np.isfinite(volume).all():
        raise InputError(
            f"the volume {volume_mm!r} is not two corners of three finite numbers, in mm",
            remedy="give X Y Z of the lower corner, then of the upper one",
        )
    volume = volume.reshape(2, 3)
    if not (volume[0] < volume[1]).all():
        raise InputError(
            f"the volume's lower corner {volume[0].tolist()} is not below its upper corner "
            f"{volume[1].tolist()} on every axis",
            remedy="give the smaller X, Y, Z first",
        )
    return volume


def bounding_box(observations: Observations, outliers: IntArray) -> FloatArray:
    """Enclose the control points, but for those that no camera agrees with."""
    agreed = np.ones(len(observations), dtype=bool)
    agreed[outliers] = False
    xyz = observations.xyz_mm[np.isin(observations.control_row, observations.control_row[agreed])]
    return np.stack([xyz.min(axis=0), xyz.max(axis=0)])


def residual_table(
    observations: Observations, cameras: Sequence[Camera], kept: BoolArray, xy_px: FloatArray
) -> Residuals:
    """List what each point contributed, points that were not fitted included."""
    points = observations.points
    residual = np.full((len(observations), 2), np.nan)
    for index, camera in enumerate(cameras):
        mine = observations.camera == index
        residual[mine] = xy_px[mine] - camera.project(observations.xyz_mm[mine])
    flags = points.flags.copy()
    flags[observations.usable & ~kept] |= int(Flag.outlier)
    return Residuals(
        camera=points.camera,
        placement=points.placement,
        point=points.point,
        xyz_mm=observations.xyz_mm,
        xy_px=xy_px,
        residual_px=residual,
        fitted=kept,
        flags=flags,
    )


def bias_report(observations: Observations, xy_px: FloatArray) -> dict[str, Any]:
    """Say how far disc centres were corrected for perspective."""
    shift = np.linalg.norm(observations.points.xy_px - xy_px, axis=1)
    return {"corrected_points": int(np.count_nonzero(shift)), "largest_px": float(shift.max())}


def discordant(
    observations: Observations, kept: BoolArray, xy_px: FloatArray, *, noise_px: float, dof: int
) -> list[str]:
    """List control positions that one camera sees in two places; outliers are listed elsewhere."""
    found: list[str] = []
    noise = max(noise_px, ROUNDING_PX)
    # difference of two points: variance 2 s^2 on each of two coordinates
    largest = 2 * noise * np.sqrt(limit(dof, max(len(observations), 1)))
    rows = np.flatnonzero(kept)
    keys = np.column_stack([observations.camera[rows], observations.xyz_mm[rows]])
    _, group, count = np.unique(keys, axis=0, return_inverse=True, return_counts=True)
    for number in np.flatnonzero(count > 1):
        members: IntArray = rows[group.ravel() == number]
        spread = np.ptp(xy_px[members], axis=0)
        if np.hypot(*spread) > largest:
            names = [
                f"{observations.points.placement[i]}/{observations.points.point[i]}"
                for i in members
            ]
            camera = observations.points.camera[members[0]]
            found.append(
                f"camera {camera!r} sees one position {np.hypot(*spread):.2f} px apart: "
                f"{listed(names)}"
            )
    return found


def warn_of(report: dict[str, Any]) -> None:
    """Warn the caller's caller of what a report contains."""
    model = report["model"]
    texts = list(report["discordant"][:3])
    outliers = report["outliers"]
    if outliers:
        names = [f"{e['camera']}/{e['placement']}/{e['point']}" for e in outliers]
        hints = list(dict.fromkeys(e["hint"] for e in outliers if e["hint"]))
        texts.append(
            f"{len(outliers)} outliers are left out of the fit: {listed(names)}"
            + (f" ({'; '.join(hints[:3])})" if hints else "")
        )
    count = report["weights"]["points"]
    gaps = count - report["weights"]["points_with_covariance"]
    if 0 < gaps < count and report["weights"]["chi_square_per_dof"] is not None:
        texts.append(
            f"{gaps} of {count} points have no covariance: they are weighed with the median of "
            "their camera's; state it for all points or for none"
        )
    for name, entry in report["cameras"].items():
        if entry["s_px"] > BAD_PX:
            texts.append(
                f"camera {name!r}: the residuals are {entry['s_px']:.2f} px, image points are "
                f"usually better than {BAD_PX:g} px: does the model {model!r} lack "
                "lens terms, or are control positions wrong?"
            )
        if not entry["converged"]:
            texts.append(
                f"camera {name!r}: the fit stopped after {entry['iterations']} steps without "
                f"converging; choose a smaller model than {model!r} or add points"
            )
    for text in texts:
        warnings.warn(text, CloseRangeWarning, stacklevel=3)
