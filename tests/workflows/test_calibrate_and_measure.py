"""The verbs `calibrate` and `measure`, called from Python."""

from __future__ import annotations

import numpy as np
import pytest

from closerange.errors import (
    CloseRangeWarning,
    InputError,
    UntrustedError,
)
from closerange.features.control import ControlPoints, write_control
from closerange.features.points_table import write_points
from closerange.features.target import Chessboard, Target
from closerange.files import sha256
from closerange.geometry.transform import RigidTransform, rotation_from_vector
from closerange.rig.rig_file import read_rig, write_rig
from closerange.verification.scenes import control_grid, observe, rig_a, rig_b
from closerange.workflows.calibrate import calibrate
from closerange.workflows.inputs import input_hashes
from closerange.workflows.measure import measure
from closerange.workflows.report import report
from closerange.workflows.verify import verify

SIZES = {"left": (1280, 1024), "right": (1280, 1024)}


@pytest.fixture(scope="module")
def seen():
    """What rig A sees of a 150 mm grid with noise of 0.05 px, and the grid."""
    control = control_grid(63, 150.0)
    rng = np.random.default_rng(0)
    return observe(rig_a().cameras, control, noise_px=0.05, rng=rng), control


def test_tables_and_types_give_the_same_rig(seen, tmp_path):
    points, control = seen
    for name in SIZES:
        write_points(points.of_camera(name), tmp_path / f"{name}.csv")
    write_control(control, tmp_path / "control.csv")
    tables = [tmp_path / "left.csv", tmp_path / "right.csv"]
    from_tables = calibrate(
        tables, control=tmp_path / "control.csv", image_size=SIZES, model="brown"
    )
    from_types = calibrate(points, control=control, model="brown")
    assert from_types.trusted
    for one, other in zip(from_tables.cameras, from_types.cameras, strict=True):
        assert one.size_px == other.size_px == (1280, 1024)
        np.testing.assert_array_equal(one.matrix_px, other.matrix_px)
    assert set(from_tables.provenance["inputs"]) == {"left.csv", "right.csv", "control.csv"}
    assert from_types.provenance["inputs"] == {}
    write_rig(from_tables, tmp_path / "rig.json")
    positions = measure(tmp_path / "rig.json", tables)
    np.testing.assert_allclose(positions.xyz_mm, measure(from_types, points).xyz_mm, atol=1e-9)
    error = positions.xyz_mm - control.xyz_mm[control.rows_for(positions.placement,
                                                               positions.point)]  # fmt: skip
    # 0.05 px are 16 um across and about three times that in depth; measured 0.030 mm
    assert np.sqrt(np.mean(np.sum(error**2, axis=1))) < 0.08


def test_calibration_reports_its_progress(seen):
    points, control = seen
    steps = []
    calibrate(points, control=control, progress=lambda *step: steps.append(step))
    assert steps == [(done, 5) for done in range(5)]  # five lens models to choose from


def test_inputs_of_one_name_are_told_apart(seen, tmp_path, monkeypatch):
    points, control = seen
    for name in SIZES:
        (tmp_path / name).mkdir()
        write_points(points.of_camera(name), tmp_path / name / "points.csv")
    write_control(control, tmp_path / "control.csv")
    monkeypatch.chdir(tmp_path / "left")
    rig = calibrate(
        ["points.csv", "../right/points.csv"],
        control=tmp_path / "control.csv",
        image_size=SIZES,
        model="brown",
    )
    above = tmp_path.name
    inputs = rig.provenance["inputs"]
    assert set(inputs) == {"left/points.csv", "right/points.csv", f"{above}/control.csv"}
    assert inputs["left/points.csv"] == sha256(tmp_path / "left/points.csv")
    assert inputs["right/points.csv"] == sha256(tmp_path / "right/points.csv")


def test_inputs_are_named_by_as_many_parts_as_needed(tmp_path):
    places = ["a/x/t.csv", "b/x/t.csv", "c.csv"]
    for place in places:
        (tmp_path / place).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / place).write_text(place)
    one = tmp_path / "c.csv"
    assert input_hashes([]) == {}
    assert input_hashes([one, str(one)]) == {"c.csv": sha256(one)}
    names = list(input_hashes([tmp_path / place for place in places]))
    assert names[:2] == ["a/x/t.csv", "b/x/t.csv"]
    assert names[2].endswith("/c.csv")
    assert names[2].count("/") == 2


def test_tables_need_the_image_size(seen, tmp_path):
    points, control = seen
    write_points(points, tmp_path / "points.csv")
    with pytest.raises(InputError, match=r"image.size|size"):
        calibrate(tmp_path / "points.csv", control=control)


def test_a_rig_that_must_not_be_believed(tmp_path):
    """Noise of 20 px, as from wrongly paired points."""
    control = control_grid(63, 150.0)
    points = observe(rig_b().cameras, control, noise_px=20.0, rng=np.random.default_rng(0))
    with pytest.warns(CloseRangeWarning), pytest.raises(UntrustedError) as caught:
        calibrate(points, control=control, model="pinhole")
    assert "predicted error" in caught.value.message
    assert "--accept-untrusted" in caught.value.remedy
    with pytest.warns(CloseRangeWarning):
        rig = calibrate(points, control=control, model="pinhole", accept_untrusted=True)
    assert not rig.trusted
    assert rig.trust.verdict == "untrustworthy"
    write_rig(rig, tmp_path / "rig.json")
    assert not read_rig(tmp_path / "rig.json").trusted
    assert "untrustworthy" in report(tmp_path / "rig.json")


@pytest.mark.parametrize("free_poses", [False, True])
def test_a_volume_of_three_numbers_is_refused(seen, free_poses):
    points, control = seen
    with pytest.raises(InputError, match="is not two corners of three finite numbers"):
        calibrate(points, control=control, free_poses=free_poses, volume_mm=[1, 2, 3])


def test_free_poses_of_a_chessboard():
    """Eight unknown poses of a board; the world is the board of the first one."""
    board = Target.of(Chessboard(6, 9, 15.0))
    control = ControlPoints.of(board.point, board.xyz_mm)
    rng = np.random.default_rng(4)
    poses = [RigidTransform(np.eye(3), np.zeros(3))]
    tilts = [(0.4, 0.1), (-0.4, 0.2), (0.1, 0.5), (0.2, -0.5), (-0.3, -0.3), (0.5, 0.4), (0, 0.6)]
    for rx, ry in tilts:
        turn = rotation_from_vector([rx, ry, rng.uniform(-0.5, 0.5)])
        poses.append(RigidTransform(turn, rng.uniform([-20, -20, -30], [20, 20, 30])))
    total = None
    for number, pose in enumerate(poses):
        world = ControlPoints.of(board.point, pose.apply(board.xyz_mm), placement=f"p{number}")
        points = observe(rig_b().cameras, world, noise_px=0.02, rng=rng)
        total = points if total is None else total + points
    rig = calibrate(total, control=control, model="brown", free_poses=True)
    assert rig.trusted
    assert rig.provenance["options"] == {"model": "brown", "volume_mm": None, "free_poses": True}
    stated = [[-10.0, -10, -10], [10, 10, 10]]
    small = calibrate(total, control=control, free_poses=True, volume_mm=stated)
    np.testing.assert_array_equal(small.volume_mm, stated)
    assert small.provenance["options"]["volume_mm"] == stated
    assert rig.noise_px == pytest.approx(0.02, rel=0.2)  # known to 2 % from 1728 residuals
    positions = measure(rig, total.select([name == "p5" for name in total.placement]))
    truth = poses[5].apply(board.xyz_mm)[control.rows_for(positions.placement, positions.point)]
    error = np.linalg.norm(positions.xyz_mm - truth, axis=1)
    # 0.02 px are 5 um across; the world leans on one board of 120 mm; measured 0.03 mm
    assert error.max() < 0.2


def test_control_with_a_rig_tells_fitted_from_check_points(seen):
    points, control = seen
    check = np.arange(len(control)) % 7 == 3
    marked = ControlPoints.of(
        control.point, control.xyz_mm, placement=control.placement, check=check
    )
    rig = calibrate(points, control=marked, model="brown")
    positions = measure(rig, points)
    counts = {
        name: group.count
        for name, group in verify("control", positions, truth=marked, rig=rig).groups.items()
    }
    assert int(check.sum()) in counts.values()
    assert int((~check).sum()) in counts.values()
