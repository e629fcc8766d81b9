"""A small rig, its residuals and verification results, all synthetic."""

from __future__ import annotations

import numpy as np
import pytest

from closerange.errors import CloseRangeWarning
from closerange.features.control import ControlPoints
from closerange.features.image_points import ImagePoints
from closerange.flags import Flag
from closerange.geometry.transform import RigidTransform, rotation_from_vector
from closerange.position.positions import Positions
from closerange.rig.camera import Camera
from closerange.rig.distortion import BrownIdeal
from closerange.rig.rig import Residuals, Rig, Trust
from closerange.verification.acceptance import AcceptanceReport
from closerange.verification.control_check import ControlCheck, compare_with_control
from closerange.verification.error_map import ErrorMap
from closerange.verification.judgement import Limits
from closerange.verification.lengths import LengthCheck, Lengths, length_test
from closerange.verification.single_point import single_point_test

NASTY = "a<b>&\"c'"
"""A point name that breaks any page that does not escape it."""


def _camera(name: str, turn: float) -> Camera:
    # looks down along -Z from 1 m above, turned about Y
    down = rotation_from_vector([np.pi, 0, 0])
    rotation = down @ rotation_from_vector([0, turn, 0])
    matrix = [[2000, 0, 320], [0, 2000, 240], [0, 0, 1]]
    pose = RigidTransform(rotation, [0, 0, 1000])
    return Camera(name, (640, 480), np.array(matrix, float), pose, BrownIdeal(k1=-0.1))


@pytest.fixture(scope="session")
def rig() -> Rig:
    """Two cameras, 27 control points each, one outlier and one check point."""
    cameras = (_camera("left", 0.2), _camera("right", -0.2))
    axis = np.array([-40.0, 0.0, 40.0])
    xyz = np.stack(np.meshgrid(axis, axis, axis, indexing="ij"), -1).reshape(-1, 3)
    noise = np.random.default_rng(3).normal(0, 0.02, (54, 2))
    noise[7] = (0.9, -0.4)
    flags = np.zeros(54, int)
    flags[7] = Flag.outlier
    fitted = np.ones(54, bool)
    fitted[[7, 30]] = False
    names = [NASTY, *(f"p{i}" for i in range(1, 27))]
    residuals = Residuals(
        camera=("left",) * 27 + ("right",) * 27,
        placement=("z0",) * 54,
        point=(*names, *names),
        xyz_mm=np.concatenate([xyz, xyz]),
        xy_px=np.concatenate([camera.project(xyz) for camera in cameras]),
        residual_px=noise,
        fitted=fitted,
        flags=flags,
    )
    parameters = tuple(f"{c.name}.{p}" for c in cameras for p in ("fx", "k1", "rx", "tz"))
    return Rig(
        cameras=cameras,
        volume_mm=[[-40, -40, -40], [40, 40, 40]],
        parameters=parameters,
        parameter_cov=np.diag([1.2, 0.01, 1e-4, 0.3] * 2) ** 2,
        noise_px=0.0203,
        dof=96,
        model="brown",
        residuals=residuals,
        trust=Trust("fair", [0.0041, 0.0042, 0.0093], [0.002, 0.002, 0.005], ("add 40 um <b>",)),
        report={
            "fixed": {"skew": "0: square pixels"},
            "choice": [{"model": "dlt", "score_px": 0.4}, {"model": "brown", "score_px": None}],
        },
    )


@pytest.fixture(scope="session")
def points(rig: Rig) -> ImagePoints:
    """Image points of the rig's residuals; the first is saturated, the second not found."""
    residuals = rig.residuals
    xy = residuals.xy_px.copy()
    xy[1] = np.nan
    flags = np.zeros(len(xy), int)
    flags[:2] = Flag.saturated, Flag.not_found
    ellipse = np.tile([12.0, 11.0, 0.4], (len(xy), 1))
    ellipse[5] = np.nan
    return ImagePoints.of(
        camera=residuals.camera,
        placement=residuals.placement,
        point=residuals.point,
        xy_px=xy,
        ellipse=ellipse,
        flags=flags,
    )


def readings(count: int, each: int) -> tuple[Positions, ControlPoints]:
    """Make repeated readings with known standard deviations of 2, 2 and 5 um."""
    rng = np.random.default_rng(11)
    truth = rng.uniform(-40, 40, (count, 3))
    error = rng.normal(0, 1, (count, each, 3)) * (0.002, 0.002, 0.005)
    total = count * each
    placement = [f"s{i}" for i in range(count)]
    positions = Positions(
        placement=tuple(name for name in placement for _ in range(each)),
        point=("disc",) * total,
        xyz_mm=(truth[:, None] + error).reshape(-1, 3),
        cov_mm2=np.broadcast_to(np.diag([0.003, 0.003, 0.006]) ** 2, (total, 3, 3)),
        residual_px=np.full(total, 0.01),
        cameras=np.full(total, 2),
        flags=np.zeros(total, int),
        reading=tuple(str(j) for _ in range(count) for j in range(each)),
        dof=96,
    )
    control = ControlPoints.of(point=["disc"] * count, placement=placement, xyz_mm=truth)
    return positions, control


@pytest.fixture(scope="session")
def positions() -> Positions:
    """25 readings at one position, one flagged, one not measured."""
    made, _ = readings(1, 25)
    xyz, flags = made.xyz_mm.copy(), made.flags.copy()
    cov, residual = made.cov_mm2.copy(), made.residual_px.copy()
    xyz[4] = cov[4] = residual[4] = np.nan
    flags[4], flags[9] = Flag.single_view, Flag.residual
    return Positions(
        made.placement,
        (NASTY,) * 25,
        xyz,
        cov,
        residual,
        made.cameras,
        flags,
        made.reading,
        made.dof,
    )


@pytest.fixture(scope="session")
def acceptance() -> AcceptanceReport:
    """Twelve positions, four readings; Z repeatability cannot hold its limit of 1 um."""
    measured, truth = readings(12, 4)
    limits = Limits.of(accuracy_mm=0.05, repeatability_mm=[0.05, 0.05, 0.001])
    with pytest.warns(CloseRangeWarning):
        return single_point_test(measured, truth, limits=limits, gauge_std_mm=0.02)


@pytest.fixture(scope="session")
def control_check() -> ControlCheck:
    """Nine points at two placements, one of them a check placement outside of the block."""
    measured, truth = readings(9, 1)
    fitted = [(f"s{i}", "disc") for i in range(6)]
    return compare_with_control(
        measured, truth, fitted=fitted, volume_mm=[[-30, -30, -30], [30, 30, 30]]
    )


@pytest.fixture(scope="session")
def length_check() -> LengthCheck:
    """One length of 80 mm, known exactly, and one that was not measured."""
    made, _ = readings(2, 1)
    xyz = np.array([[0, 0, 0], [80.004, 0, 0]])
    pair = Positions(
        ("", ""),
        ("a", "b"),
        xyz,
        made.cov_mm2,
        made.residual_px,
        made.cameras,
        made.flags,
        ("", ""),
    )
    with pytest.warns(CloseRangeWarning, match="not measured"):
        return length_test(pair, Lengths.of(["a", "a"], ["b", "q"], [80.0, 10.0]))


@pytest.fixture(scope="session")
def error_map() -> ErrorMap:
    """Five nodes a side; one node is not seen."""
    axis = np.linspace(-40, 40, 5)
    xyz = np.stack(np.meshgrid(axis, axis, axis, indexing="ij"), -1).reshape(-1, 3)
    std = np.column_stack(
        [0.003 + np.abs(xyz[:, 0]) / 2e4, np.full(125, 0.004), np.full(125, 0.01)]
    )
    std[0] = np.nan
    return ErrorMap(xyz, (5, 5, 5), std, std / 2)
