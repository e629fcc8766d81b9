"""Calibration from placements in unknown poses: a target that is simply held up.

The control points are given in the target's frame; the world frame is the target's frame in
the first placement. Points are joined, weighed, tested and corrected as in placements of known
poses; only the fit differs: cameras and placements are adjusted together.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from closerange.errors import InputError
from closerange.features.control import ControlPoints
from closerange.features.image_points import ImagePoints
from closerange.geometry.arrays import FloatArray
from closerange.rig.bundle_solution import BundleSolution, place, solve_bundle
from closerange.rig.excess import unstated_px
from closerange.rig.findings import (
    bias_report,
    bounding_box,
    checked_volume,
    discordant,
    residual_table,
    warn_of,
)
from closerange.rig.fit_report import describe_parameters, describe_weights, left_out
from closerange.rig.models import FREE, Model, model_named
from closerange.rig.observations import Observations, join
from closerange.rig.outlier_hints import describe_outliers
from closerange.rig.rig import Rig

METHOD = "least squares in the image (Levenberg-Marquardt), cameras and placements together"


def calibrate_free_poses(
    points: ImagePoints,
    control: ControlPoints,
    size_px: Mapping[str, tuple[int, int]],
    *,
    model: str = "brown",
    volume_mm: ArrayLike | None = None,
) -> Rig:
    """Calibrate cameras from placements of a target in unknown poses.

    Parameters
    ----------
    points : ImagePoints
        Image points; at least three differently tilted placements for each camera. Flags of
        `observations.EXCLUDING` keep a row out of the fit.
    control : ControlPoints
        Points in the target's frame, mm, without placements; rows marked as check stay out of
        the fit.
    size_px : mapping of str to (int, int)
        Width and height of each camera's images.
    model : str, optional
        Free parameters of each camera; ``auto`` means ``brown`` here.
    volume_mm : array_like, shape (2, 3), optional
        Measuring volume in the world; the bounding box of the points in all placements, without
        it.

    Returns
    -------
    Rig
        Cameras in the target's frame of the first placement, not yet judged.

    Raises
    ------
    InputError
        If an option or table cannot be used: a linear model, a missing image size, points outside
        of the image, a volume upside down.
    GeometryError
        If there are too few placements, a camera cannot be linked to the first placement, or most
        points of an image contradict the others.

    Warns
    -----
    CloseRangeWarning
        Of points without control, placements that are left out, outliers and large residuals.
    """
    name = "brown" if model == "auto" else model
    if name not in FREE:
        raise InputError(
            f"model {model!r} cannot be used with free poses",
            remedy=f"use one of {', '.join(FREE)}",
        )
    chosen, volume = model_named(name), checked_volume(volume_mm)
    placed = place(join(points, control, size_px))
    solution = solve_bundle(placed, chosen)
    cameras, covariance = solution.fit.bundle.cameras, solution.covariance()
    world = placed.in_world(solution.fit.bundle)
    outliers = np.flatnonzero(world.usable & ~solution.kept).astype(np.int64)
    report = _report(world, solution, chosen, covariance)
    report["outliers"] = describe_outliers(
        world, cameras, outliers, solution.xy_px, known_poses=False
    )
    report["volume"] = "stated" if volume_mm is not None else "bounding box of all placements"
    warn_of(report)
    return Rig(
        cameras=cameras,
        volume_mm=bounding_box(world, outliers) if volume is None else volume,
        parameters=tuple(f"{camera.name}.{name}" for camera in cameras for name in chosen.free),
        parameter_cov=covariance,
        noise_px=solution.noise_px,
        tau_px=unstated_px(world, cameras, solution.kept, solution.xy_px, solution.fit.dof),
        dof=solution.fit.dof,
        model=name,
        residuals=residual_table(world, cameras, solution.kept, solution.xy_px),
        report=report,
    )


def _report(
    world: Observations, solution: BundleSolution, model: Model, covariance: FloatArray
) -> dict[str, Any]:
    """Say what `fit_report` says, and what concerns the placements."""
    fit, xy = solution.fit, solution.xy_px
    return {
        "method": METHOD,
        "model": model.name,
        "noise_px": solution.noise_px,
        "dof": fit.dof,
        "weights": describe_weights(
            world,
            tau_px=solution.tau_px,
            chi_square_per_dof=fit.chi_square / fit.dof if solution.weighted else None,
            linear=False,
        ),
        "left_out": left_out(world),
        "cameras": _cameras_report(solution, model, covariance),
        "disc_bias": bias_report(world, xy),
        "discordant": discordant(world, solution.kept, xy, noise_px=solution.noise_px, dof=fit.dof),
        "free_poses": {
            "world": f"target's frame in placement {solution.placed.placements[0]!r}",
            "placements": len(fit.bundle.poses),
        },
    }


def _cameras_report(
    solution: BundleSolution, model: Model, covariance: FloatArray
) -> dict[str, Any]:
    fit, camera_of = solution.fit, solution.seen.camera
    std = np.sqrt(np.diag(covariance)).reshape(-1, len(model.free))
    # the placements' parameters belong to no camera: each point's own share of the freedom counts
    freedom = 2 - np.sum(fit.orthonormal**2, axis=(1, 2))
    cameras: dict[str, Any] = {}
    for i, camera in enumerate(fit.bundle.cameras):
        own = camera_of[solution.used] == i
        rss = float(np.sum(fit.residual_px[own] ** 2))
        cameras[camera.name] = {
            "points": int(np.count_nonzero(own)),
            "outliers": int(np.count_nonzero((camera_of == i) & ~solution.used)),
            "n": 2 * int(np.count_nonzero(own)),
            "p": len(model.free),
            "rss_px2": rss,
            "s_px": float(np.sqrt(rss / max(float(freedom[own].sum()), 1.0))),
            "condition": fit.condition,
            "iterations": fit.iterations,
            "converged": fit.converged,
            "parameters": describe_parameters(camera, model, std[i]),
        }
    return cameras
