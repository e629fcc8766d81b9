"""Which lens terms a rig needs: models compared by cross-validation in mm.

Points are left out in turn and predicted by a camera fitted to the others. The error in the image
is carried to the point's depth, where it is a length across the line of sight. The residuals of
the fit itself are never compared: they fall with every parameter, needed or not.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from closerange.errors import GeometryError
from closerange.geometry.arrays import FloatArray, IntArray
from closerange.rig.camera import Camera
from closerange.rig.camera_fit import CameraFit, fit_camera
from closerange.rig.models import FREE, Model, model_named
from closerange.rig.view import View

CANDIDATES = ("brown-k3", "brown", "brown-k1k2", "brown-k1", "pinhole")
"""From rich to lean, so that each starts from the one before."""

DEFAULT = "brown"

FOLDS = 10
"""Customary: each fit keeps nine tenths of the points, so that it is hardly weaker than the full
one."""

GOOD_ENOUGH = 1e-8
"""Share of the cost that a last step may still gain: parameters within a thousandth of their
standard deviations, for errors that are known to some per cent."""

SIGNIFICANT = 3.0
"""Standard errors by which a model must beat the default. Four rivals have about one chance in
two hundred to do so by luck."""


@dataclass(frozen=True, slots=True, eq=False)
class Choice:
    """The chosen model and why.

    Attributes
    ----------
    model : str
        Its name.
    report : dict
        Table of all candidates and the rule; JSON-ready.
    """

    model: str
    report: dict[str, Any]


def candidates(points: int) -> list[Model]:
    """Return the models that a camera with this many points can afford, from rich to lean."""
    models = [model_named(name) for name in CANDIDATES]
    return [model for model in models if model.affordable(points)]


def choose_model(
    views: Sequence[View],
    groups: Sequence[IntArray],
    starts: Sequence[Camera],
    *,
    progress: Callable[[int, int], None] | None = None,
) -> Choice:
    """Choose among the affordable models, the same for all cameras.

    Parameters
    ----------
    views : sequence of View
        Points of each camera, without blunders.
    groups : sequence of ndarray of int
        Control position of each point: readings of one position are left out together.
    starts : sequence of Camera
        Any fit of each camera.
    progress : callable, optional
        Called with (models tried, models).

    Returns
    -------
    Choice
        `DEFAULT`, unless another model's error is lower by `SIGNIFICANT` standard errors of the
        difference; of several such the one with the lowest error. Where the default cannot be
        afforded, the lowest error decides.
    """
    errors: dict[str, FloatArray] = {}
    noise: dict[str, float] = {}
    refused: dict[str, str] = {}
    cameras = list(starts)
    models = candidates(min(len(view) for view in views))
    for number, model in enumerate(models):
        if progress is not None:
            progress(number, len(models))
        try:
            fits = [
                fit_camera(view, model.free, camera, gain_limit=GOOD_ENOUGH)
                for view, camera in zip(views, cameras, strict=True)
            ]
            errors[model.name] = np.concatenate(
                [
                    left_out_errors(fit, view, group)
                    for fit, view, group in zip(fits, views, groups, strict=True)
                ]
            )
        except GeometryError as error:
            refused[model.name] = error.message
            continue
        cameras = [fit.camera for fit in fits]
        noise[model.name] = _noise(fits)
    if not errors:
        return Choice("dlt", {"chosen": "dlt", "rule": "too few points for a lens model"})
    return _decide(errors, noise, refused)


def left_out_errors(fit: CameraFit, view: View, group: IntArray) -> FloatArray:
    """Predict each point from a fit without its fold.

    Parameters
    ----------
    fit : CameraFit
        Of all points.
    view : View
        The same points.
    group : ndarray of int, shape (N,)
        Points of one group share a fold.

    Returns
    -------
    ndarray, shape (N,)
        Mean of the two squared errors, mm^2, across the line of sight at the point's depth.

    Raises
    ------
    GeometryError
        If the model cannot be fitted without some fold.

    Notes
    -----
    One Gauss-Newton step from the full solution, exact for a linear model: with the fold's rows
    Q_F of the orthonormal basis, ``r + Q_F (I - Q_F' Q_F)^-1 Q_F' r``.
    """
    _, index = np.unique(group, return_inverse=True)
    fold = index % min(FOLDS, index.max() + 1)
    folds = [fold == number for number in range(fold.max() + 1)]
    bases = [fit.orthonormal[rows].reshape(-1, len(fit.free)) for rows in folds]
    rest = np.eye(len(fit.free)) - np.stack([q.T @ q for q in bases])
    if np.linalg.eigvalsh(rest).min() < 1e-9:
        raise GeometryError("a tenth of the points carries a parameter alone")
    moments = [q.T @ fit.whitened[rows].ravel() for q, rows in zip(bases, folds, strict=True)]
    changes = np.linalg.solve(rest, np.stack(moments)[..., None])[..., 0]
    left_out = fit.whitened.copy()
    for rows, q, change in zip(folds, bases, changes, strict=True):
        left_out[rows] += (q @ change).reshape(-1, 2)
    pixels = _in_px(left_out, view.whitener)
    matrix = fit.camera.matrix_px
    depth = fit.camera.depth_mm(view.xyz_mm)
    lengths = pixels * (depth[:, None] / np.array([matrix[0, 0], matrix[1, 1]]))
    squares: FloatArray = np.mean(lengths**2, axis=1)
    return squares


def _in_px(whitened: FloatArray, whitener: FloatArray | None) -> FloatArray:
    if whitener is None:
        return whitened
    a, b, c = whitener.T
    x = whitened[:, 0] / a
    return np.stack([x, (whitened[:, 1] - b * x) / c], axis=1)


def _noise(fits: Sequence[CameraFit]) -> float:
    dof = sum(fit.dof for fit in fits)
    return float(np.sqrt(sum(fit.rss_px2 for fit in fits) / dof))


def _decide(
    errors: dict[str, FloatArray], noise: dict[str, float], refused: dict[str, str]
) -> Choice:
    mean = {name: float(np.mean(square)) for name, square in errors.items()}
    lowest = min(mean, key=lambda name: mean[name])
    reference = DEFAULT if DEFAULT in errors else lowest
    chosen, table = reference, []
    for name in reversed(errors):
        gain = errors[reference] - errors[name]
        error = float(np.std(gain) / np.sqrt(len(gain)))
        ratio = float(np.mean(gain)) / error if error > 0 else 0.0
        if ratio > SIGNIFICANT and mean[name] < mean[chosen]:
            chosen = name
        table.append(
            {
                "model": name,
                "parameters_per_camera": len(FREE[name]),
                "cross_validated_mm": float(np.sqrt(mean[name])),
                "noise_px": noise[name],
                "better_by_standard_errors": ratio,
            }
        )
    report = {
        "chosen": chosen,
        "compared_with": reference,
        "rule": f"{reference} unless another model's cross-validated error is lower by more than "
        f"{SIGNIFICANT:g} standard errors of the difference; never by the residuals",
        "unit": "mm across the line of sight at the left-out points, root mean square",
        "folds": FOLDS,
        "table": table,
        "not_possible": refused,
    }
    return Choice(chosen, report)
