"""What a calibration says of itself: parameters, residual sums and weights, JSON-ready."""

from __future__ import annotations

from collections import Counter
from typing import Any

import numpy as np

from closerange.flags import format_flags
from closerange.geometry.arrays import FloatArray
from closerange.rig.camera import POSE, Camera
from closerange.rig.models import LINEAR, Model
from closerange.rig.observations import Observations
from closerange.rig.solution import Solution

_UNITS = {
    **dict.fromkeys(("fx", "fy", "cx", "cy", "skew"), "px"),
    **dict.fromkeys(POSE[:3], "rad"),
    **dict.fromkeys(POSE[3:], "mm"),
}

_METHODS = {
    "dlt": "direct linear transformation under a unit norm, split into a camera; the covariance is "
    "that of the equivalent camera parameters by their geometric Jacobian, with s^2 = RSS/(n - p)",
    "thesis-dlt": "the thesis' chapter 2 (a12 = 1), split into a camera; the covariance is that of "
    "the equivalent camera parameters by their geometric Jacobian, with s^2 = RSS/(n - p)",
    "thesis-distortion": "the thesis' chapter 6 (algebraic criterion), split into a camera; the "
    "covariance is that of the equivalent camera parameters by their geometric Jacobian, with "
    "s^2 = RSS/(n - p)",
}


def fit_report(
    observations: Observations, solution: Solution, covariance: FloatArray
) -> dict[str, Any]:
    """Describe a solution.

    Parameters
    ----------
    observations : Observations
        All joined points.
    solution : Solution
        The fits.
    covariance : ndarray, shape (P, P)
        Of the free parameters.

    Returns
    -------
    dict
        ``method``, ``model``, ``weights``, ``left_out`` and, by name, ``cameras``.
    """
    name = solution.model.name
    cameras: dict[str, Any] = {}
    done = 0
    for index, fit in enumerate(solution.fits):
        std = np.sqrt(np.diag(covariance)[done : done + len(fit.free)])
        done += len(fit.free)
        cameras[observations.cameras[index]] = _camera_report(solution, index, std)
    return {
        "method": _METHODS.get(name, "least squares in the image (Levenberg-Marquardt)"),
        "model": name,
        "noise_px": solution.noise_px,
        "dof": solution.dof,
        "weights": describe_weights(
            observations,
            tau_px=solution.tau_px,
            chi_square_per_dof=solution.chi_square / solution.dof if solution.weighted else None,
            linear=name in LINEAR,
        ),
        "left_out": left_out(observations),
        "cameras": cameras,
    }


def _camera_report(solution: Solution, index: int, std: FloatArray) -> dict[str, Any]:
    fit, kept = solution.fits[index], solution.clean[index].kept
    return {
        "points": int(np.count_nonzero(kept)),
        "outliers": int(np.count_nonzero(~kept)),
        "n": fit.residual_px.size,
        "p": len(fit.free),
        "rss_px2": fit.rss_px2,
        "s_px": float(np.sqrt(fit.rss_px2 / fit.dof)),
        "condition": fit.condition,
        "iterations": fit.iterations,
        "converged": fit.converged,
        "parameters": describe_parameters(fit.camera, solution.model, std),
    }


def describe_parameters(camera: Camera, model: Model, std: FloatArray) -> dict[str, Any]:
    """Describe the free and the fixed parameters of a camera, JSON-ready, by name."""
    free = {
        name: {
            "value": None if name in POSE[:3] else camera.parameter(name),
            "std": float(std[i]),
            "unit": _UNITS.get(name, ""),
            "free": True,
            "why": "small rotation about the camera's axis, against the estimate"
            if name in POSE[:3]
            else "",
        }
        for i, name in enumerate(model.free)
    }
    fixed = {
        name: {
            "value": 0.0,
            "std": 0.0,
            "unit": _UNITS.get(name, ""),
            "free": False,
            "why": why,
        }
        for name, why in model.fixed.items()
    }
    return {**free, **fixed}


def describe_weights(
    observations: Observations, *, tau_px: float, chi_square_per_dof: float | None, linear: bool
) -> dict[str, Any]:
    """Describe how points were weighed, JSON-ready; no chi^2 where the weights are all one."""
    known = np.isfinite(observations.points.cov_px2[observations.usable, 0, 0])
    if linear:
        words = "unit weights: the method knows no others"
    elif chi_square_per_dof is None:
        words = "unit weights: neither covariances nor std_mm are stated"
    else:
        words = (
            "inverse of C + tau^2 I + std_mm^2 J J': stated covariances (for points without one, "
            "the median of their camera's), a common part, and the control positions' errors; tau "
            "makes chi^2 equal to its degrees of freedom"
        )
    return {
        "rule": words,
        "points_with_covariance": int(np.count_nonzero(known)),
        "points": len(known),
        "tau_px": tau_px,
        "chi_square_per_dof": chi_square_per_dof,
    }


def left_out(observations: Observations) -> dict[str, int]:
    """Count the rows that were kept out before the fit, by their flags."""
    flags = observations.points.flags[~observations.usable]
    return dict(Counter(format_flags(int(flag)) or "check point" for flag in flags))
