"""Calibrate all cameras of a rig from points at known positions."""

from __future__ import annotations

import warnings
from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from closerange.errors import CloseRangeWarning, InputError
from closerange.features.control import ControlPoints
from closerange.features.image_points import ImagePoints
from closerange.flags import Flag
from closerange.geometry.arrays import BoolArray, FloatArray, IntArray
from closerange.rig.diagnosis import (
    BAD_PX,
    BAD_SHARE,
    check_scale,
    explain_camera,
    explain_placement,
)
from closerange.rig.fit_report import fit_report
from closerange.rig.model_choice import candidates, choose_model
from closerange.rig.models import FREE, MODELS, Model, model_named
from closerange.rig.observations import Observations, join, listed, without_disc_bias
from closerange.rig.outlier_hints import describe_outliers
from closerange.rig.outliers import ROUNDING_PX, limit
from closerange.rig.rig import Residuals, Rig
from closerange.rig.solution import CameraRefusedError, Solution, solve


def calibrate_rig(
    points: ImagePoints,
    control: ControlPoints,
    size_px: Mapping[str, tuple[int, int]],
    *,
    model: str = "auto",
    volume_mm: ArrayLike | None = None,
    reject: bool = True,
) -> Rig:
    """Calibrate the cameras of a rig from points at known world positions.

    Each camera is fitted by least squares of its image residuals; all share the model and one
    variance. Blunders are left out and flagged. Disc centres are corrected for perspective where
    two cameras see the disc's ellipse.

    Parameters
    ----------
    points : ImagePoints
        Where the control points are seen, in any number of cameras, placements and readings.
        Flags of `observations.EXCLUDING` keep a row out of the fit.
    control : ControlPoints
        Where they are, mm, right-handed; rows marked as check stay out of the fit.
    size_px : mapping of str to (int, int)
        Image width and height of each camera.
    model : str, optional
        Of `models.MODELS`. ``brown`` frees fx fy cx cy k1 k2 p1 p2; ``auto`` chooses by
        cross-validation in mm.
    volume_mm : array_like, shape (2, 3), optional
        Measuring volume; the bounding box of the control points seen, without it.
    reject : bool, optional
        Leave out blunders.

    Returns
    -------
    Rig
        Cameras with the covariance of their parameters, not yet judged (`trust` is None).

    Raises
    ------
    InputError
        If an option or table cannot be used: unknown model, missing image size, points outside
        of the image, a volume upside down, sizes in different units.
    GeometryError
        If the points cannot fix a camera, or contradict each other in a way that a mistake in
        labels, axes or cameras explains.

    Warns
    -----
    CloseRangeWarning
        Of points without control, outliers, and large or contradictory residuals.
    """
    if model not in MODELS:
        model_named(model)  # raises
    volume = _checked_volume(volume_mm)
    observations = join(points, control, size_px)
    solution, xy, choice = _solve(observations, control, model, reject=reject)
    covariance = solution.covariance()
    kept = _kept(observations, solution)
    outliers = np.flatnonzero(observations.usable & ~kept).astype(np.int64)
    report = fit_report(observations, solution, covariance)
    report["disc_bias"] = _bias_report(observations, xy)
    report["outliers"] = describe_outliers(observations, solution.cameras, outliers, xy)
    report["discordant"] = _discordant(observations, solution, kept, xy)
    if choice:
        report["model_choice"] = choice
    report["volume"] = "bounding box of the control points" if volume_mm is None else "stated"
    _warn(report, solution)
    return Rig(
        cameras=solution.cameras,
        volume_mm=_bounding_box(observations) if volume is None else volume,
        parameters=tuple(
            f"{camera.name}.{name}" for camera in solution.cameras for name in solution.model.free
        ),
        parameter_cov=covariance,
        noise_px=solution.noise_px,
        dof=solution.dof,
        model=solution.model.name,
        residuals=_residuals(observations, solution, kept, xy),
        report=report,
    )


def _checked_volume(volume_mm: ArrayLike | None) -> FloatArray | None:
    if volume_mm is None:
        return None
    volume = np.asarray(volume_mm, dtype=np.float64)
    if volume.shape != (2, 3) or not np.isfinite(volume).all():
        raise InputError(
            f"the volume has shape {volume.shape}; expected two corners of three numbers, in mm",
            remedy="give X Y Z of the lower corner, then of the upper one",
        )
    if not (volume[0] < volume[1]).all():
        raise InputError(
            f"the volume's lower corner {volume[0].tolist()} is not below its upper corner "
            f"{volume[1].tolist()} on every axis",
            remedy="give the smaller X, Y, Z first",
        )
    return volume


def _solve(
    observations: Observations, control: ControlPoints, model: str, *, reject: bool
) -> tuple[Solution, FloatArray, dict[str, Any]]:
    """Find blunders and mistakes, correct disc centres, choose the model if asked to, and fit.

    Blunders are found with the richest model that the points can afford, whatever model is
    wanted: a lens that the wanted model lacks would pass for blunders at the corners.
    """
    asked = None if model == "auto" else model_named(model)
    sorting = _sorting_model(observations, asked)
    xy = observations.points.xy_px
    try:
        solution = solve(observations, xy, sorting, reject=reject)
    except CameraRefusedError as error:
        explain_camera(observations, control, error.camera, float("inf"))
        if asked is None or asked.name == sorting.name:
            raise
        solution = solve(observations, xy, asked, reject=reject)
    _look_for_mistakes(observations, control, solution)
    check_scale(observations, solution.cameras)
    corrected = without_disc_bias(observations, solution.cameras)
    if (corrected != xy).any():
        xy = corrected
        solution = solve(observations, xy, solution.model, reject=reject, like=solution)
    choice = _choice(solution) if asked is None else {}
    final = asked or model_named(choice["chosen"])
    if final.name != solution.model.name:
        solution = solve(observations, xy, final, reject=reject, like=solution)
    return solution, xy, choice


def _sorting_model(observations: Observations, asked: Model | None) -> Model:
    fewest = min(len(observations.rows(i)) for i in range(len(observations.cameras)))
    affordable = candidates(fewest)
    if not affordable:
        return asked or model_named("dlt")
    richest = affordable[0]
    if asked is not None and asked.name in FREE and len(asked.free) >= len(richest.free):
        return asked
    return richest


def _choice(solution: Solution) -> dict[str, Any]:
    if solution.model.name == "dlt":
        return {"chosen": "dlt", "rule": "too few points for a lens model"}
    groups = [part.control_row for part in solution.stated]
    return choose_model(solution.views, groups, solution.cameras).report


def _look_for_mistakes(
    observations: Observations, control: ControlPoints, solution: Solution
) -> None:
    noise = np.array([clean.plain_px for clean in solution.clean])
    share = np.array([np.mean(~clean.kept) for clean in solution.clean])
    fitted = np.array([np.sqrt(fit.rss_px2 / fit.dof) for fit in solution.fits])
    bad = (noise > BAD_PX) & ((fitted > BAD_PX) | (share > BAD_SHARE))
    bad |= _whole_images(observations, solution)
    for index in np.flatnonzero(bad):
        explain_camera(observations, control, int(index), float(noise[index]))
        explain_placement(observations, control, int(index), float(noise[index]))


def _whole_images(observations: Observations, solution: Solution) -> BoolArray:
    """Say which cameras lost most of the points of some placement: blunders do not gather so."""
    whole = np.zeros(len(solution.clean), dtype=bool)
    for index, clean in enumerate(solution.clean):
        names = np.array([observations.points.placement[i] for i in observations.rows(index)])
        for placement in np.unique(names[~clean.kept]):
            whole[index] |= 2 * np.count_nonzero(
                ~clean.kept[names == placement]
            ) > np.count_nonzero(names == placement)
    return whole & (len(set(observations.points.placement)) > 1)


def _kept(observations: Observations, solution: Solution) -> BoolArray:
    kept = np.zeros(len(observations), dtype=bool)
    for index, clean in enumerate(solution.clean):
        kept[observations.rows(index)] = clean.kept
    return kept


def _bounding_box(observations: Observations) -> FloatArray:
    xyz = observations.xyz_mm
    return np.stack([xyz.min(axis=0), xyz.max(axis=0)])


def _residuals(
    observations: Observations, solution: Solution, kept: BoolArray, xy_px: FloatArray
) -> Residuals:
    points = observations.points
    residual = np.full((len(observations), 2), np.nan)
    for index, camera in enumerate(solution.cameras):
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


def _bias_report(observations: Observations, xy_px: FloatArray) -> dict[str, Any]:
    shift = np.linalg.norm(observations.points.xy_px - xy_px, axis=1)
    return {"corrected_points": int(np.count_nonzero(shift)), "largest_px": float(shift.max())}


def _discordant(
    observations: Observations, solution: Solution, kept: BoolArray, xy_px: FloatArray
) -> list[str]:
    """List control positions that one camera sees in two places; outliers are listed elsewhere."""
    found: list[str] = []
    noise = max(solution.noise_px, ROUNDING_PX)
    # difference of two points: variance 2 s^2 on each of two coordinates
    largest = 2 * noise * np.sqrt(limit(solution.dof, max(len(observations), 1)))
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


def _warn(report: dict[str, Any], solution: Solution) -> None:
    texts = list(report["discordant"][:3])
    outliers = report["outliers"]
    if outliers:
        names = [f"{e['camera']}/{e['placement']}/{e['point']}" for e in outliers]
        hints = list(dict.fromkeys(e["hint"] for e in outliers if e["hint"]))
        texts.append(
            f"{len(outliers)} outliers are left out of the fit: {listed(names)}"
            + (f" ({'; '.join(hints[:3])})" if hints else "")
        )
    for name, entry in report["cameras"].items():
        if entry["s_px"] > BAD_PX:
            texts.append(
                f"camera {name!r}: the residuals are {entry['s_px']:.2f} px, image points are "
                f"usually better than {BAD_PX:g} px: does the model {solution.model.name!r} lack "
                "lens terms, or are control positions wrong?"
            )
        if not entry["converged"]:
            texts.append(
                f"camera {name!r}: the fit stopped after {entry['iterations']} steps without "
                f"converging; choose a smaller model than {solution.model.name!r} or add points"
            )
    for text in texts:
        warnings.warn(text, CloseRangeWarning, stacklevel=3)
