"""Calibrate all cameras of a rig from points at known positions."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from closerange.errors import GeometryError
from closerange.features.control import ControlPoints
from closerange.features.image_points import ImagePoints
from closerange.geometry.arrays import BoolArray, FloatArray, IntArray
from closerange.rig.camera import Camera
from closerange.rig.diagnosis import (
    BAD_PX,
    BAD_SHARE,
    check_scale,
    explain_camera,
    explain_placement,
)
from closerange.rig.excess import unstated_px
from closerange.rig.findings import (
    bias_report,
    bounding_box,
    checked_volume,
    discordant,
    residual_table,
    warn_of,
)
from closerange.rig.fit_report import fit_report
from closerange.rig.model_choice import candidates, choose_model
from closerange.rig.models import FREE, MODELS, Model, model_named
from closerange.rig.observations import Observations, join, without_disc_bias
from closerange.rig.outlier_hints import describe_outliers
from closerange.rig.rig import Rig
from closerange.rig.solution import CameraRefusedError, Solution, solve


def calibrate_rig(
    points: ImagePoints,
    control: ControlPoints,
    size_px: Mapping[str, tuple[int, int]],
    *,
    model: str = "auto",
    volume_mm: ArrayLike | None = None,
    reject: bool = True,
    progress: Callable[[int, int], None] | None = None,
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
    progress : callable, optional
        Called with (lens models tried, models) while ``auto`` chooses.

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
    volume = checked_volume(volume_mm)
    observations = join(points, control, size_px)
    solution, xy, choice = _solve(observations, control, model, reject=reject, progress=progress)
    covariance = solution.covariance()
    kept = _kept(observations, solution)
    outliers = np.flatnonzero(observations.usable & ~kept).astype(np.int64)
    _require_in_front(observations, solution.cameras, outliers)
    report = fit_report(observations, solution, covariance)
    report["disc_bias"] = bias_report(observations, xy)
    report["outliers"] = describe_outliers(observations, solution.cameras, outliers, xy)
    report["discordant"] = discordant(
        observations, kept, xy, noise_px=solution.noise_px, dof=solution.dof
    )
    if choice:
        report["model_choice"] = choice
    report["volume"] = "bounding box of the control points" if volume_mm is None else "stated"
    warn_of(report)
    return Rig(
        cameras=solution.cameras,
        volume_mm=bounding_box(observations, outliers) if volume is None else volume,
        parameters=tuple(
            f"{camera.name}.{name}" for camera in solution.cameras for name in solution.model.free
        ),
        parameter_cov=covariance,
        noise_px=solution.noise_px,
        tau_px=unstated_px(observations, solution.cameras, kept, xy, solution.dof),
        dof=solution.dof,
        model=solution.model.name,
        residuals=residual_table(observations, solution.cameras, kept, xy),
        report=report,
    )


def _solve(
    observations: Observations,
    control: ControlPoints,
    model: str,
    *,
    reject: bool,
    progress: Callable[[int, int], None] | None,
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
    choice = _choice(solution, progress) if asked is None else {}
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


def _choice(solution: Solution, progress: Callable[[int, int], None] | None) -> dict[str, Any]:
    if solution.model.name == "dlt":
        return {"chosen": "dlt", "rule": "too few points for a lens model"}
    groups = [part.control_row for part in solution.stated]
    return choose_model(solution.views, groups, solution.cameras, progress=progress).report


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
        explain_placement(observations, control, int(index), solution.clean[index])


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


def _require_in_front(
    observations: Observations, cameras: Sequence[Camera], outliers: IntArray
) -> None:
    """Refuse control points behind a camera that sees them: they are impossible, not only wrong."""
    for row in outliers:
        camera = cameras[observations.camera[row]]
        depth = float(camera.depth_mm(observations.xyz_mm[row]).item())
        if depth > 0:
            continue
        placement, point = observations.points.placement[row], observations.points.point[row]
        name = f"{placement}/{point}" if placement else point
        x, y, z = observations.xyz_mm[row]
        raise GeometryError(
            f"control point {name!r} at ({x:g}, {y:g}, {z:g}) mm lies {-depth:.4g} mm behind "
            f"camera {camera.name!r}, which sees it",
            remedy="correct its row in the control table",
        )
