"""The verb `calibrate`: image points of known world points become a rig."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path

from numpy.typing import ArrayLike

from closerange.errors import CloseRangeWarning, UntrustedError
from closerange.features.control import ControlPoints, read_control
from closerange.features.image_points import ImagePoints
from closerange.features.points_table import read_points
from closerange.rig.calibrate import calibrate_rig
from closerange.rig.findings import checked_volume
from closerange.rig.free_poses import calibrate_free_poses
from closerange.rig.rig import Rig
from closerange.verification.travel import travel_hints
from closerange.verification.trust import judge_rig
from closerange.workflows.inputs import input_hashes, versions

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
    progress: Callable[[int, int], None] | None = None,
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
        Placements in unknown poses: `control` is in the target's frame, the world is the
        target's frame in the first placement.
    accept_untrusted : bool, optional
        Return an untrustworthy rig, marked so, instead of raising.
    progress : callable, optional
        Called with (lens models tried, models).

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

    Warns
    -----
    CloseRangeWarning
        As `calibrate_rig`, and of control points that a device seems to have misplaced.
    """
    named = points, control
    if not isinstance(points, ImagePoints):
        points = read_points(*([points] if isinstance(points, (str, Path)) else points))
    if not isinstance(control, ControlPoints):
        control = read_control(control)
    inputs = input_hashes(_files(*named))  # after the readers, which refuse devices and pipes
    sizes = {**points.size_px, **(image_size or {})}
    volume = checked_volume(volume_mm)
    if free_poses:
        rig = calibrate_free_poses(points, control, sizes, model=model, volume_mm=volume)
    else:
        rig = calibrate_rig(
            points, control, sizes, model=model, volume_mm=volume, progress=progress
        )
        rig = _with_travel_hints(rig)
    trust = judge_rig(rig, volume_given=volume is not None)
    options = {
        "model": model,
        "volume_mm": None if volume is None else volume.tolist(),
        "free_poses": free_poses,
    }
    provenance = {**versions(), "options": options, "inputs": inputs}
    rig = replace(rig, trust=trust, provenance={**rig.provenance, **provenance})
    if not rig.trusted and not accept_untrusted:
        raise UntrustedError(
            f"{trust}\n" + "\n".join(trust.reasons),
            remedy="follow the reasons; --accept-untrusted writes the rig all the same, marked",
        )
    return rig


def _with_travel_hints(rig: Rig) -> Rig:
    """Warn of regular errors of the device that positioned the control points."""
    hints = travel_hints(rig)
    for hint in hints:
        warnings.warn(hint, CloseRangeWarning, stacklevel=3)
    return replace(rig, report={**rig.report, "travel": hints}) if hints else rig


def _files(points: Tables, control: ControlPoints | Path | str) -> list[Path | str]:
    """List those inputs that are files."""
    files: list[Path | str] = []
    if isinstance(points, (str, Path)):
        files.append(points)
    elif not isinstance(points, ImagePoints):
        files.extend(points)
    if isinstance(control, (str, Path)):
        files.append(control)
    return files
