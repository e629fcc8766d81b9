"""The rig: cameras in one world frame, and what is known of their uncertainty."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from closerange.errors import InputError
from closerange.geometry.arrays import FloatArray, IntArray, frozen_array, frozen_ints
from closerange.rig.camera import Camera


@dataclass(frozen=True, slots=True, eq=False)
class Trust:
    """Whether a rig may be believed, judged by its predicted error in mm.

    Attributes
    ----------
    verdict : str
        ``good``, ``fair`` or ``untrustworthy``.
    predicted_mm : ndarray, shape (3,)
        RMS over the volume of the predicted standard deviation of X, Y, Z of one position; NaN
        where there are no positions, as with one camera.
    calibration_mm : ndarray, shape (3,)
        The part of it that comes from the calibration and that averaging cannot remove.
    reasons : tuple of str
        Why, each with what to do; empty for ``good``.
    """

    verdict: str
    predicted_mm: FloatArray
    calibration_mm: FloatArray
    reasons: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        if self.verdict not in ("good", "fair", "untrustworthy"):
            raise ValueError(f"verdict {self.verdict!r} is not good, fair or untrustworthy")
        for name in ("predicted_mm", "calibration_mm"):
            object.__setattr__(self, name, frozen_array(getattr(self, name), (3,), name))
        object.__setattr__(self, "reasons", tuple(self.reasons))

    def __str__(self) -> str:
        if np.isnan(self.predicted_mm).any():
            return f"{self.verdict}: no positions, hence no predicted error"
        x, y, z = (_micrometres(value) for value in self.predicted_mm)
        return f"{self.verdict}: predicted error {x} (X) {y} (Y) {z} (Z)"


@dataclass(frozen=True, slots=True, eq=False)
class Residuals:
    """What each control point contributed to a calibration; N rows.

    Attributes
    ----------
    camera, placement, point : tuple of str
        Names.
    xyz_mm : ndarray, shape (N, 3)
        Known world position.
    xy_px : ndarray, shape (N, 2)
        Image position that was compared (bias-corrected for discs).
    residual_px : ndarray, shape (N, 2)
        Observed minus calculated.
    fitted : ndarray of bool, shape (N,)
        Took part in the fit; False for check points and outliers.
    flags : ndarray of int, shape (N,)
        `Flag` bits; `outlier` for blunders that were left out.
    """

    camera: tuple[str, ...]
    placement: tuple[str, ...]
    point: tuple[str, ...]
    xyz_mm: FloatArray
    xy_px: FloatArray
    residual_px: FloatArray
    fitted: NDArray[np.bool_]
    flags: IntArray

    def __post_init__(self) -> None:
        count = len(self.camera)
        for name, width in (("xyz_mm", 3), ("xy_px", 2), ("residual_px", 2)):
            object.__setattr__(self, name, frozen_array(getattr(self, name), (count, width), name))
        object.__setattr__(self, "flags", frozen_ints(self.flags, (count,), "flags"))
        fitted = np.array(self.fitted, dtype=np.bool_)
        if fitted.shape != (count,) or len(self.placement) != count or len(self.point) != count:
            raise ValueError("columns of residuals differ in length")
        fitted.flags.writeable = False
        object.__setattr__(self, "fitted", fitted)

    def __len__(self) -> int:
        return len(self.camera)


@dataclass(frozen=True, slots=True, eq=False)
class Rig:
    """Cameras calibrated to one world frame.

    Attributes
    ----------
    cameras : tuple of Camera
        At least one, with different names.
    volume_mm : ndarray, shape (2, 3)
        Measuring volume: lower and upper corner.
    parameters : tuple of str
        Names of the free parameters as ``camera.parameter``, in the order of `parameter_cov`.
    parameter_cov : ndarray, shape (P, P)
        Their covariance.
    noise_px : float
        s, the standard deviation of one image coordinate: s^2 = RSS / (n - p), at least 1e-6 px,
        what rounding hides in exact data. Where control points have a ``std_mm``, their own
        errors are a part of it.
    dof : int
        n - p, over all cameras.
    model : str
        How it was calibrated (``brown``, ``dlt``, ...).
    residuals : Residuals
        Per point.
    trust : Trust or None
        Verdict; None before it was judged.
    report : mapping
        What was fixed and why, model choice, rejected points: JSON-ready.
    provenance : mapping
        Program version, options and hashes of inputs: JSON-ready.
    tau_px : float
        What the covariances of the calibration's image points left out (print, lens, sensor), as
        the standard deviation of one image coordinate: points that state a covariance C are
        measured with C + tau^2 I. 0 where it did not show, or no point stated a covariance. Errors
        of control positions whose ``std_mm`` is not stated are a part of it.
    """

    cameras: tuple[Camera, ...]
    volume_mm: FloatArray
    parameters: tuple[str, ...]
    parameter_cov: FloatArray
    noise_px: float
    dof: int
    model: str
    residuals: Residuals
    trust: Trust | None = None
    report: Mapping[str, Any] = field(default_factory=dict)
    provenance: Mapping[str, Any] = field(default_factory=dict)
    tau_px: float = 0.0

    def __post_init__(self) -> None:
        object.__setattr__(self, "cameras", tuple(self.cameras))
        names = [camera.name for camera in self.cameras]
        if not names or len(set(names)) < len(names):
            raise ValueError("a rig needs at least one camera, with different names")
        object.__setattr__(self, "volume_mm", frozen_array(self.volume_mm, (2, 3), "volume_mm"))
        if not (self.volume_mm[0] <= self.volume_mm[1]).all():
            raise ValueError("volume_mm: the lower corner must not exceed the upper one")
        if not 0 <= self.tau_px < np.inf:
            raise ValueError(f"tau_px is {self.tau_px}; a standard deviation is at least 0")
        count = len(self.parameters)
        object.__setattr__(self, "parameters", tuple(self.parameters))
        object.__setattr__(
            self, "parameter_cov", frozen_array(self.parameter_cov, (count, count), "parameter_cov")
        )

    def camera(self, name: str) -> Camera:
        """Return a camera by name.

        Raises
        ------
        InputError
            If the rig does not have it; the message lists those it has.
        """
        for camera in self.cameras:
            if camera.name == name:
                return camera
        known = ", ".join(camera.name for camera in self.cameras)
        raise InputError(
            f"camera {name!r} is not in the rig; it has {known}",
            remedy="use the rig's camera names",
        )

    def parameters_of(self, camera: str) -> tuple[list[str], list[int]]:
        """Return names and positions in `parameter_cov` of one camera's free parameters."""
        prefix = f"{camera}."
        found = [
            (i, name) for i, name in enumerate(self.parameters) if name.rpartition(".")[0] == camera
        ]
        return [name.removeprefix(prefix) for _, name in found], [i for i, _ in found]

    def to_json(self, path: Path | str) -> None:
        """Write the rig file; see `closerange.rig.rig_file`."""
        from closerange.rig.rig_file import write_rig  # noqa: PLC0415  # cycle

        write_rig(self, path)

    @property
    def trusted(self) -> bool:
        """False if the rig was judged untrustworthy, or its own uncertainty is not known."""
        return self.uncertainty_known and (
            self.trust is None or self.trust.verdict != "untrustworthy"
        )

    @property
    def uncertainty_known(self) -> bool:
        """Whether noise and covariance are such that positions get covariances."""
        known = bool(np.isfinite(self.parameter_cov).all())
        return known and 0 < self.noise_px < np.inf and self.dof > 0


def _micrometres(value_mm: float) -> str:
    value = 1000 * value_mm
    return f"{value:.0f} um" if value >= 10 else f"{value:.1f} um"
