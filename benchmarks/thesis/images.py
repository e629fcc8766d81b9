"""The rendered experiments: image points and known positions of the demonstration data."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np

from closerange.features.control import ControlPoints, read_control
from closerange.features.image_points import ImagePoints
from closerange.workflows.detect import detect
from thesis.tables import FloatArray

CAMERAS = ("left", "right")

# The plate's heights by number of points, as chapter 2 and section 6.5 count them.
PLANES = {
    18: ("z-50.0", "z+50.0"),
    27: ("z-50.0", "z+00.0", "z+50.0"),
    54: ("z-50.0", "z-33.3", "z-16.7", "z+16.7", "z+33.3", "z+50.0"),
    63: ("z-50.0", "z-33.3", "z-16.7", "z+00.0", "z+16.7", "z+33.3", "z+50.0"),
}


def plate_control(data: Path) -> ControlPoints:
    """Return the known positions of the plate's 63 discs."""
    return read_control(data / "control.csv")


def plate_points(data: Path, estimator: str) -> ImagePoints:
    """Detect the plate's discs in both cameras' images."""
    left, right = (
        detect(
            sorted((data / "calibration").glob(f"{camera}_*.png")),
            target=data / "plate.toml",
            camera=camera,
            placement_pattern="_(z.*)$",
            estimator=estimator,
        )
        for camera in CAMERAS
    )
    return left + right


def single_control(data: Path) -> ControlPoints:
    """Return the 90 known positions of the single disc."""
    return read_control(data / "verify" / "truth.csv")


def single_points(data: Path, estimator: str) -> ImagePoints:
    """Detect the single disc at 90 positions with 3 readings in both cameras' images."""
    left, right = (
        detect(
            sorted((data / "verify").glob(f"p*_{camera}_r*.png")),
            target=data / "disc.toml",
            camera=camera,
            placement_pattern=rf"^(p\d+)_{camera}_r(?P<reading>\d+)$",
            estimator=estimator,
            crops=data / "verify" / "crops.csv",
        )
        for camera in CAMERAS
    )
    return left + right


def as_bare_points(points: ImagePoints) -> ImagePoints:
    """Forget ellipses and covariances: the points as the thesis had them."""
    count = len(points)
    return replace(
        points,
        cov_px2=np.full((count, 2, 2), np.nan),
        ellipse=np.full((count, 3), np.nan),
        disc_diameter_mm=np.full(count, np.nan),
    )


def with_check(control: ControlPoints, points: int) -> ControlPoints:
    """Mark all placements as check points that the experiment does not fit."""
    fitted = [placement in PLANES[points] for placement in control.placement]
    return replace(control, check=~np.array(fitted))


def diagonal_mm(xyz_mm: FloatArray) -> float:
    """Return the diagonal of the points' bounding box."""
    return float(np.linalg.norm(np.ptp(xyz_mm, axis=0)))
