"""The trust verdict: whether a rig may be believed."""

from __future__ import annotations

import numpy as np

from closerange.geometry.arrays import FloatArray
from closerange.rig.rig import Rig, Trust
from closerange.verification.error_map import ErrorMap, judged_volume, predict_errors, seen_by

CALIBRATION_SHARE = 3.0
"""Untrustworthy when the calibration contributes more than three times what one reading does:
averaging readings then gains nothing, and the stated noise says nothing about the error."""

VOLUME_SHARE = 0.01
"""Untrustworthy when one reading errs by more than 1 % of the volume's diagonal: the points
then hardly belong together."""

FAIR_SHARE = 1.0
"""Fair, not good, when the calibration contributes more than a reading does."""

FEW_DOF = 10
"""Below this s^2 is known to worse than 45 % (sqrt(2/dof)); the prediction is as uncertain."""


def judge_rig(rig: Rig, *, volume_given: bool = False) -> Trust:
    """Judge a rig by the error that it predicts inside its volume.

    Single parameters are never judged: a nearly affine view or refraction makes them odd
    without harm to positions.

    Parameters
    ----------
    rig : Rig
        Calibrated cameras.
    volume_given : bool, optional
        The user has stated the volume: it is judged as it is, however thin.

    Returns
    -------
    Trust
        Verdict, predicted errors and reasons with remedies.
    """
    if not np.isfinite(rig.parameter_cov).all():
        reason = "the predicted error is not finite: add control points off their common plane"
        return Trust("untrustworthy", np.full(3, np.nan), np.full(3, np.nan), (reason,))
    volume = rig.volume_mm if volume_given else judged_volume(rig.volume_mm)
    errors = predict_errors(rig, volume)
    total, calibration = _rms(errors.std_mm), _rms(errors.calibration_std_mm)
    grave = [
        *_convergence(rig),
        *(_coverage(rig, errors) or _undefined(rig, total)),
        *_grave(total, calibration, volume),
    ]
    light = _light(rig, errors, total, calibration)
    verdict = "untrustworthy" if grave else "fair" if light else "good"
    return Trust(verdict, total, calibration, tuple(grave + light))


def _grave(total: FloatArray, calibration: FloatArray, volume: FloatArray) -> list[str]:
    if not np.isfinite(total).all():
        return []  # said already by `_light`, `_coverage` or `_undefined`
    reasons = []
    image = np.sqrt(np.maximum(total**2 - calibration**2, 0.0))
    worst = int(np.argmax(calibration / np.maximum(image, 1e-300)))
    if calibration[worst] > CALIBRATION_SHARE * image[worst]:
        reasons.append(
            f"{'XYZ'[worst]}: the calibration alone errs by {calibration[worst]:.3g} mm, one "
            f"reading by {image[worst]:.3g} mm (limit {CALIBRATION_SHARE:g} times): add control "
            "points where there are none, above all in depth"
        )
    diagonal = float(np.linalg.norm(volume[1] - volume[0]))
    if total.max() > VOLUME_SHARE * diagonal:
        reasons.append(
            f"{'XYZ'[int(np.argmax(total))]}: predicted error {total.max():.3g} mm in a volume of "
            f"{diagonal:.3g} mm diagonal (limit {100 * VOLUME_SHARE:g} %): check that points, "
            "placements and cameras are named rightly"
        )
    return reasons


def _coverage(rig: Rig, errors: ErrorMap) -> list[str]:
    """Report a volume that no two cameras see; one camera alone measures no positions."""
    views = seen_by(rig, errors.xyz_mm).sum(axis=1)
    if len(rig.cameras) < 2 or (views >= 2).any():
        return []
    lower, upper = errors.xyz_mm.min(axis=0), errors.xyz_mm.max(axis=0)
    return [
        (
            f"no part of the volume {lower.tolist()} to {upper.tolist()} mm is seen by two "
            "cameras: turn the cameras, or state the --volume that they see"
        )
    ]


def _undefined(rig: Rig, total: FloatArray) -> list[str]:
    """Report cameras that all see the volume from one place: their rays never cross."""
    if len(rig.cameras) < 2 or np.isfinite(total).all():
        return []
    centres = np.stack([camera.centre_mm for camera in rig.cameras])
    apart = float(np.linalg.norm(centres - centres[0], axis=1).max())
    names = ", ".join(camera.name for camera in rig.cameras)
    return [
        (
            f"no position is defined: the cameras {names} see the volume from places only "
            f"{apart:.3g} mm apart: are these the images of one camera under several names? Name "
            "each camera's own images, or move the cameras apart and calibrate again"
        )
    ]


def _light(rig: Rig, errors: ErrorMap, total: FloatArray, calibration: FloatArray) -> list[str]:
    reasons = []
    if len(rig.cameras) < 2:
        reasons.append("one camera: no positions; calibrate a second one that sees the same volume")
    if rig.dof < FEW_DOF:
        reasons.append(
            f"only {rig.dof} degrees of freedom: the prediction itself is uncertain by "
            f"{100 * np.sqrt(0.5 / max(rig.dof, 1)):.0f} %; add control points"
        )
    unseen = float(np.mean(~np.isfinite(errors.std_mm).all(axis=1)))
    if np.isfinite(total).all() and unseen > 0.5:
        reasons.append(
            f"{100 * unseen:.0f} % of the volume is seen by fewer than two cameras: "
            "turn the cameras, or state a smaller --volume"
        )
    image = np.sqrt(np.maximum(total**2 - calibration**2, 0.0))
    if np.isfinite(total).all() and (calibration > FAIR_SHARE * image).any():
        reasons.append("the calibration errs by more than one reading: more control points help")
    return reasons


def _convergence(rig: Rig) -> list[str]:
    """Report cameras whose fit stopped early."""
    cameras = rig.report.get("cameras", {})
    return [
        f"camera {name}: the fit did not converge; add control points or choose a smaller --model"
        for name, entry in cameras.items()
        if isinstance(entry, dict) and entry.get("converged") is False
    ]


def _rms(std_mm: FloatArray) -> FloatArray:
    """Return the root mean square over the nodes that are seen, shape (3,)."""
    seen = std_mm[np.isfinite(std_mm).all(axis=1)]
    if not len(seen):
        return np.full(3, np.nan)
    rms: FloatArray = np.sqrt(np.mean(seen**2, axis=0))
    return rms
