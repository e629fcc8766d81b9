"""The verb `calibrate`: image points of known world points become a rig."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike

from closerange.errors import InputError, UntrustedError
from closerange.features.control import ControlPoints, read_control
from closerange.features.image_points import ImagePoints
from closerange.features.points_table import read_points
from closerange.files import sha256
from closerange.rig.calibrate import calibrate_rig
from closerange.rig.camera import Camera
from closerange.rig.disc_bias import DiscViews, disc_centre_bias
from closerange.rig.rig import Rig
from closerange.verification.trust import judge_rig
from closerange.version import __version__

DISC_PASSES = 2
"""Fits after taking off the discs' bias: the second changes cameras by less than 1e-4 px."""

Tables = ImagePoints | Path | str | Sequence[Path | str]


def calibrate(
    points: Tables,
    *,
    control: ControlPoints | Path | str,
    image_size: Mapping[str, tuple[int, int]] | None = None,
    model: str = "auto",
    volume_mm: ArrayLike | None = None,
    free_poses: bool = False,
    accept_untrusted: bool = False,
) -> Rig:
    """Calibrate cameras to the world frame of known points.

    Parameters
    ----------
    points : ImagePoints, path or sequence of paths
        Image points, or their tables.
    control : ControlPoints or path
        Known world positions in mm, or their table. Rows with ``role = check`` stay out of
        the fit.
    image_size : mapping of str to (int, int), optional
        Width and height in px of each camera's images; needed where the points come from
        tables, which do not hold it.
    model : str, optional
        ``auto`` (chosen by cross-validation), ``brown`` (fx fy cx cy k1 k2 p1 p2), ``dlt``,
        ``thesis-dlt``, ``thesis-distortion`` and others of `closerange.rig.models`.
    volume_mm : array_like, shape (2, 3), optional
        Measuring volume; the bounding box of the control points by default.
    free_poses : bool, optional
        Placements in unknown poses; not available yet.
    accept_untrusted : bool, optional
        Return an untrustworthy rig, marked so, instead of raising.

    Returns
    -------
    Rig
        Cameras with the covariance of their parameters and a trust verdict.

    Raises
    ------
    InputError
        If a table or an option cannot be used.
    GeometryError
        If the points cannot carry a calibration at all.
    UntrustedError
        If the rig must not be believed, with the predicted error in mm and what to do.
    """
    if free_poses:
        raise InputError(
            "placements in unknown poses are not supported by this version",
            remedy="state the placements' positions in the control table",
        )
    inputs = _hashes(points, control)
    if not isinstance(points, ImagePoints):
        points = read_points(*([points] if isinstance(points, (str, Path)) else points))
    if not isinstance(control, ControlPoints):
        control = read_control(control)
    sizes = {**points.size_px, **(image_size or {})}
    volume = None if volume_mm is None else np.reshape(np.asarray(volume_mm, np.float64), (2, 3))
    rig = calibrate_rig(points, control, sizes, model=model, volume_mm=volume)
    if np.isfinite(points.disc_diameter_mm).any():
        for _ in range(DISC_PASSES):
            corrected = without_disc_bias(rig.cameras, points, control)
            rig = calibrate_rig(corrected, control, sizes, model=model, volume_mm=volume)
    trust = judge_rig(rig, volume_given=volume is not None)
    options = {"model": model, "volume_mm": None if volume is None else volume.tolist()}
    provenance = {"program": f"closerange {__version__}", "options": options, "inputs": inputs}
    rig = replace(rig, trust=trust, provenance={**rig.provenance, **provenance})
    if not rig.trusted and not accept_untrusted:
        raise UntrustedError(
            f"{trust}\n" + "\n".join(trust.reasons),
            remedy="follow the reasons; --accept-untrusted writes the rig all the same, marked",
        )
    return rig


def without_disc_bias(
    cameras: Sequence[Camera], points: ImagePoints, control: ControlPoints
) -> ImagePoints:
    """Take the perspective and lens bias off the centres of discs at known positions.

    Parameters
    ----------
    cameras : sequence of Camera
        Approximately calibrated cameras.
    points : ImagePoints
        Centres as seen.
    control : ControlPoints
        Their world positions.

    Returns
    -------
    ImagePoints
        Images of the discs' centres; rows that are no discs, or whose attitude cannot be
        known because one camera only sees their ellipse, are unchanged.
    """
    names = [camera.name for camera in cameras]
    known = control.rows_of(points)
    usable = [
        row
        for row in range(len(points))
        if known[row] >= 0
        and points.camera[row] in names
        and np.isfinite(points.ellipse[row]).all()
    ]
    keys = [(points.placement[i], points.reading[i], points.point[i]) for i in usable]
    disc_of = {key: disc for disc, key in enumerate(dict.fromkeys(keys))}
    discs = [disc_of[key] for key in keys]
    views = [names.index(points.camera[i]) for i in usable]
    xyz = np.empty((len(disc_of), 3))
    xyz[discs] = control.xyz_mm[known[usable]]
    diameter = np.full(len(disc_of), np.nan)
    diameter[discs] = points.disc_diameter_mm[usable]
    ellipse = np.full((len(disc_of), len(names), 3), np.nan)
    ellipse[discs, views] = points.ellipse[usable]
    bias = disc_centre_bias(cameras, DiscViews(xyz, ellipse, diameter))
    xy = points.xy_px.copy()
    xy[usable] -= bias[discs, views]
    return replace(points, xy_px=xy)


def _hashes(points: Tables, control: ControlPoints | Path | str) -> dict[str, str]:
    """Return SHA-256 by file name of all inputs that are files."""
    files: list[Path | str] = []
    if isinstance(points, (str, Path)):
        files.append(points)
    elif not isinstance(points, ImagePoints):
        files.extend(points)
    if isinstance(control, (str, Path)):
        files.append(control)
    return {Path(file).name: sha256(file) for file in files}
