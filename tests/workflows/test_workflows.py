"""The verbs, called from Python: each alone, and the demonstration as a whole."""

from __future__ import annotations

import json
import shutil
from importlib.resources import files
from pathlib import Path

import cv2
import numpy as np
import pytest

from closerange.errors import (
    CloseRangeWarning,
    DataError,
    DetectionError,
    FileError,
    InputError,
    SchemaError,
    UntrustedError,
)
from closerange.features.control import ControlPoints, read_control, write_control
from closerange.features.image_points import ImagePoints
from closerange.features.points_table import read_points, write_points
from closerange.features.target import Chessboard, Target
from closerange.geometry.transform import RigidTransform, rotation_from_vector
from closerange.images import Frame, read_image
from closerange.position.positions import Positions
from closerange.position.positions_table import read_positions
from closerange.rig.rig_file import read_rig, write_rig
from closerange.verification.acceptance import AcceptanceReport, Limits
from closerange.verification.control_check import ControlCheck
from closerange.verification.lengths import LengthCheck, Lengths
from closerange.verification.result_file import write_result
from closerange.verification.scenes import control_grid, observe, rig_a, rig_b
from closerange.workflows.calibrate import calibrate
from closerange.workflows.demo import demo
from closerange.workflows.detect import detect, read_crops
from closerange.workflows.measure import measure
from closerange.workflows.report import report
from closerange.workflows.run import run
from closerange.workflows.verify import verify

DEMO = Path(str(files("closerange.workflows") / "demo_data"))
PLATE, DISC = DEMO / "plate.toml", DEMO / "disc.toml"
HEIGHTS = ("z-50.0", "z+00.0", "z+50.0")
SIZES = {"left": (1280, 1024), "right": (1280, 1024)}


def plate(camera, height):
    return DEMO / f"calibration/{camera}_{height}.png"


# detect


def test_a_folder_is_all_of_its_images_in_natural_order(tmp_path):
    for name, height in (("im2.png", "z-50.0"), ("im10.png", "z+00.0"), ("im1.png", "z+50.0")):
        shutil.copy(plate("left", height), tmp_path / name)
    (tmp_path / "notes.txt").write_text("no image", encoding="utf-8")
    seen = []
    points = detect(tmp_path, target=PLATE, camera="left", progress=lambda *step: seen.append(step))
    assert tuple(dict.fromkeys(points.placement)) == ("im1", "im2", "im10")
    assert seen == [(1, 3), (2, 3), (3, 3)]
    assert points.size_px == {"left": (640, 512)}
    assert points.found.all()
    # x of the target grows with x of this camera's images, y the other way
    first = points.select(np.arange(9)).xy_px.reshape(3, 3, 2)
    assert (np.diff(first[..., 0], axis=1) > 0).all()
    assert (np.diff(first[..., 1], axis=0) > 0).all()


def test_frames_files_and_folders_may_be_mixed(tmp_path):
    shutil.copy(plate("left", "z+50.0"), tmp_path / "left_z+50.0.png")
    frame = read_image(plate("left", "z-50.0"), camera="left")
    images = [frame, str(plate("left", "z+00.0")), tmp_path]
    points = detect(images, target=PLATE, camera="left", placement_pattern="_(z.*)$")
    assert tuple(dict.fromkeys(points.placement)) == ("z-50.0", "z+00.0", "z+50.0")


def test_the_pattern_names_placement_and_reading():
    images = [DEMO / f"verify/p0{n}_left_r{r}.png" for n in (0, 1) for r in (0, 1)]
    pattern = r"^(p\d+)_left_r(?P<reading>\d+)$"
    points = detect(images, target=DISC, camera="left", placement_pattern=pattern)
    names = list(zip(points.placement, points.reading, strict=True))
    assert names == [("p00", "0"), ("p00", "1"), ("p01", "0"), ("p01", "1")]


def test_one_image_may_be_given_a_placement_name():
    points = detect(plate("left", "z+00.0"), target=PLATE, camera="left", placement="middle")
    assert set(points.placement) == {"middle"}


def test_one_placement_name_for_several_images_is_refused():
    images = [plate("left", height) for height in HEIGHTS]
    with pytest.raises(InputError, match="one placement name for 3 images") as caught:
        detect(images, target=PLATE, camera="left", placement="middle")
    assert "--placement-pattern" in caught.value.remedy


@pytest.mark.parametrize("pattern", ["(", "z", "(nothing)"])
def test_patterns_that_name_no_placement(pattern):
    with pytest.raises(InputError, match="placement pattern"):
        detect(plate("left", "z+00.0"), target=PLATE, camera="left", placement_pattern=pattern)


def test_two_images_of_one_placement_name_the_second(tmp_path):
    for name in ("a_z1.png", "b_z1.png"):
        height = HEIGHTS[name > "b"]
        shutil.copy(plate("left", height), tmp_path / name)
    with pytest.raises(InputError, match=r"b_z1\.png: .*appears twice"):
        detect(tmp_path, target=PLATE, camera="left", placement_pattern="_(z1)$")


def test_the_same_exposure_twice_is_refused(tmp_path):
    for name in ("a.png", "b.png"):
        shutil.copy(plate("left", "z+00.0"), tmp_path / name)
    with pytest.raises(InputError, match=r"b\.png"):
        detect(tmp_path, target=PLATE, camera="left")


def test_no_image_at_all():
    with pytest.raises(InputError, match="no image was named"):
        detect([], target=PLATE, camera="left")


def test_crops_give_positions_in_the_full_image(tmp_path):
    """A crop of an image gives the points of the image, and forgets its own size."""
    whole = detect(plate("left", "z+00.0"), target=PLATE, camera="left", placement="p")
    pixels = read_image(plate("left", "z+00.0"), camera="left").pixels
    assert cv2.imwrite(str(tmp_path / "part.png"), pixels[20:500, 30:620])
    part = detect(
        tmp_path / "part.png", target=PLATE, camera="left", placement="p",
        crops={"part.png": (30.0, 20.0)},
    )  # fmt: skip
    assert part.size_px == {}
    # the crop changes only the background around the plate; measured 3e-5
    np.testing.assert_allclose(part.xy_px, whole.xy_px, atol=1e-3)
    table = tmp_path / "crops.csv"
    table.write_text("image,x0_px,y0_px\npart.png,30,20\n", encoding="utf-8")
    assert read_crops(table) == {"part.png": (30.0, 20.0)}
    again = detect(tmp_path / "part.png", target=PLATE, camera="left", placement="p", crops=table)
    np.testing.assert_array_equal(again.xy_px, part.xy_px)


def test_a_crop_without_a_row_is_refused():
    with pytest.raises(InputError, match="no row for 'left_z"):
        detect(plate("left", "z+00.0"), target=PLATE, camera="left", crops={"other.png": (0, 0)})


def test_a_missing_target_names_the_image():
    image = plate("left", "z+00.0")
    with pytest.raises(DetectionError) as caught:
        detect(image, target=Target.of(Chessboard(6, 7, 10.0)), camera="left")
    assert str(image) in caught.value.message


def test_a_board_of_half_turn_symmetry_is_warned_of():
    frame = Frame("left", np.tile(np.arange(256, dtype=np.uint8), (200, 1)), source="ramp")
    target = Target.of(Chessboard(6, 8, 10.0))
    with (
        pytest.warns(CloseRangeWarning, match="same after half a turn"),
        pytest.raises(DetectionError, match="ramp"),
    ):
        detect(frame, target=target, camera="left")


# calibrate and measure


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
    assert rig.noise_px == pytest.approx(0.02, rel=0.2)  # known to 2 % from 1728 residuals
    positions = measure(rig, total.select([name == "p5" for name in total.placement]))
    truth = poses[5].apply(board.xyz_mm)[control.rows_for(positions.placement, positions.point)]
    error = np.linalg.norm(positions.xyz_mm - truth, axis=1)
    # 0.02 px are 5 um across; the world leans on one board of 120 mm; measured 0.03 mm
    assert error.max() < 0.2


# verify


def truth_and_positions():
    """Two points, three readings each, errors known."""
    truth = ControlPoints.of(["a", "b"], [[0.0, 0, 0], [30, 40, 0]])
    offsets = np.array([[0.01, 0, 0], [0.02, 0, 0], [0.03, 0, 0]])
    xyz = np.concatenate([truth.xyz_mm[0] + offsets, truth.xyz_mm[1] + offsets])
    positions = Positions(
        placement=("",) * 6, point=("a",) * 3 + ("b",) * 3, xyz_mm=xyz,
        cov_mm2=np.tile(np.eye(3) * 1e-4, (6, 1, 1)), residual_px=np.zeros(6),
        cameras=np.full(6, 2), flags=np.zeros(6, int), reading=("0", "1", "2") * 2,
    )  # fmt: skip
    return truth, positions


def test_the_three_kinds_of_verification():
    truth, positions = truth_and_positions()
    control = verify("control", positions, truth=truth)
    assert isinstance(control, ControlCheck)
    single = verify(
        "single-point", positions, truth=truth, cycle_time_s=1.5,
        limits=Limits.of(accuracy_mm=(0.05, 0.05, 0.05), repeatability_mm=None),
    )  # fmt: skip
    assert isinstance(single, AcceptanceReport)
    assert single.accuracy.max_mm[0] == pytest.approx(0.02)  # of the mean of three readings
    assert single.repeatability.pooled.std_mm[0] == pytest.approx(0.01)
    lengths = verify("lengths", positions, truth=Lengths.of(["a"], ["b"], [50.0]))
    assert isinstance(lengths, LengthCheck)
    assert lengths.used.sum() == 3
    assert lengths.max_mm == pytest.approx(0, abs=1e-12)  # both ends err alike


def test_verify_reads_files(tmp_path):
    truth, positions = truth_and_positions()
    positions.to_csv(tmp_path / "positions.csv")
    write_control(truth, tmp_path / "truth.csv")
    (tmp_path / "lengths.csv").write_text("point_a,point_b,length_mm\na,b,49.9\n", encoding="utf-8")
    result = verify("single-point", tmp_path / "positions.csv", truth=tmp_path / "truth.csv")
    assert result.accuracy.max_mm[0] == pytest.approx(0.02)
    result = verify("lengths", tmp_path / "positions.csv", truth=tmp_path / "lengths.csv")
    assert result.bias_mm == pytest.approx(0.1)


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


def test_verification_refuses_what_does_not_fit():
    truth, positions = truth_and_positions()
    with pytest.raises(InputError, match="beauty") as caught:
        verify("beauty", positions, truth=truth)
    assert "control, single-point, lengths" in caught.value.remedy
    with pytest.raises(InputError, match="true positions given"):
        verify("lengths", positions, truth=truth)
    with pytest.raises(InputError, match="true lengths given"):
        verify("control", positions, truth=Lengths.of(["a"], ["b"], [50.0]))
    with pytest.raises(DataError):
        verify("control", positions, truth=ControlPoints.of(["c"], [[0.0, 0, 0]]))


# report


def test_report_refuses_what_is_no_stored_result(tmp_path):
    path = tmp_path / "other.json"
    for text in ('{"schema": "closerange.soup/1"}', "[]", "{}"):
        path.write_text(text, encoding="utf-8")
        with pytest.raises(SchemaError, match="no stored result"):
            report(path)
    path.write_text('{"schema": "closerange.run/1", "title": "half"}', encoding="utf-8")
    with pytest.raises(SchemaError, match="not a complete run"):
        report(path)


def test_report_of_each_kind_of_result(tmp_path):
    truth, positions = truth_and_positions()
    for kind, known, title in (
        ("control", truth, "Comparison with control points"),
        ("single-point", truth, "Single-point test"),
        ("lengths", Lengths.of(["a"], ["b"], [50.0]), "Length test"),
    ):
        path = tmp_path / f"{kind}.json"
        write_result(verify(kind, positions, truth=known), path)
        assert f"<title>{title}" in report(path)


# demo and run


@pytest.fixture(scope="module")
def shown(tmp_path_factory):
    """Run the demonstration, once for all tests."""
    steps = []
    folder = tmp_path_factory.mktemp("demo") / "results"
    result = demo(folder, announce=lambda *step: steps.append(step))
    return result, steps


def contents(folder):
    return {path.name: path.read_bytes() for path in sorted(folder.iterdir())}


def test_the_demonstration_writes_its_folder(shown):
    result, steps = shown
    stems = ("single-point", "bars-across", "bars-along")
    tables = [f"{stem}-{what}.csv" for stem in stems for what in ("points", "positions")]
    wanted = [*tables, *(f"{stem}-result.json" for stem in stems)]
    wanted += ["rig.json", "run.json", "report.html"]
    assert sorted(contents(result.folder)) == sorted(wanted)
    assert [path.name for path in result.folder.parent.iterdir()] == ["results"]
    assert result.warnings == ()
    assert ("calibrating", 1, 1) in steps
    assert all(0 <= done <= total for _, done, total in steps)


def test_figures_of_the_demonstration(shown):
    result = shown[0]
    assert result.rig.trust.verdict == "good"
    first = result.jobs[0]
    assert len(first.result.point) == 90
    assert len(first.positions) == 270
    truth = read_control(DEMO / "verify/truth.csv")
    positions = read_positions(result.folder / "single-point-positions.csv")
    rows = truth.rows_for(positions.placement, positions.point)
    error = positions.xyz_mm - truth.xyz_mm[rows]
    # a disc is found to about 0.01 px at worst: 0.003 mm here, three times that in depth
    assert np.sqrt(np.mean(np.sum(error**2, axis=1))) < 0.012  # measured 0.0037 mm
    stated = np.sqrt(np.einsum("mii->mi", positions.cov_mm2).mean(axis=0))
    ratio = np.sqrt(np.mean(error**2, axis=0)) / stated
    # of 90 positions alone the ratio scatters by 1 / sqrt(180) = 0.07; measured 1.03 1.18 0.90
    assert ((ratio > 0.8) & (ratio < 1.25)).all()


def test_bars_of_the_demonstration(shown):
    checks = [job.result for job in shown[0].jobs[1:]]
    assert [int(check.used.sum()) for check in checks] == [5, 2]
    assert max(check.max_mm for check in checks) < 0.015  # measured 0.0085 mm


def test_the_run_document_repeats_the_report(shown):
    folder = shown[0].folder
    document = json.loads((folder / "run.json").read_text(encoding="utf-8"))
    assert document["schema"] == "closerange.run/1"
    assert [entry["job"] for entry in document["results"]] == [job.name for job in shown[0].jobs]
    inputs = document["provenance"]["inputs"]
    assert {"closerange.toml", "control.csv", "bars/crops.csv"} < set(inputs)
    assert len(inputs["calibration/left_z+00.0.png"]) == 64
    html = report(folder / "run.json")
    assert html == (folder / "report.html").read_text(encoding="utf-8")
    assert document["title"] in html
    for name in ("rig.json", "single-point-result.json"):
        assert report(folder / name).rstrip().endswith("</html>")


def test_tables_of_the_demonstration_can_be_measured_again(shown):
    folder = shown[0].folder
    points = read_points(folder / "bars-across-points.csv")
    assert isinstance(points, ImagePoints)
    again = measure(folder / "rig.json", points)
    stored = read_positions(folder / "bars-across-positions.csv")
    assert again.keys() == stored.keys()
    np.testing.assert_allclose(again.xyz_mm, stored.xyz_mm, atol=1e-9)


def test_a_second_demonstration_leaves_the_first_alone(shown):
    folder = shown[0].folder
    before = contents(folder)
    with pytest.raises(FileError, match="exists and is not empty") as caught:
        demo(folder)
    assert "--overwrite" in caught.value.remedy
    assert contents(folder) == before


@pytest.fixture
def small(tmp_path):
    """Copy a project of three heights and one bar out of the demonstration."""
    folder = tmp_path / "small"
    for name in ("calibration", "bars"):
        (folder / name).mkdir(parents=True)
    names = [f"calibration/{camera}_{z}.png" for camera in ("left", "right") for z in HEIGHTS]
    names += ["bars/bar0_left.png", "bars/bar0_right.png", "bars/crops.csv"]
    for name in [*names, "bar_across.toml", "plate.toml", "control.csv"]:
        shutil.copy(DEMO / name, folder / name)
    project = folder / "closerange.toml"
    project.write_text(
        """
schema = "closerange.project/1"
[calibration]
target = "plate.toml"
control = "control.csv"
model = "pinhole"
placement_pattern = "_(z.*)$"
images = { left = ["calibration/left_*.png"], right = ["calibration/right_*.png"] }
[[job]]
name = "one bar"
target = "bar_across.toml"
placement_pattern = '^(bar\\d+)_'
images = { left = ["bars/*_left.png"], right = ["bars/*_right.png"] }
crops = "bars/crops.csv"
""",
        encoding="utf-8",
    )
    return project


def test_overwriting_replaces_all_and_repeats_every_byte(small):
    first = run(small)
    assert first.folder == small.parent / "results"
    assert first.jobs[0].result is None
    before = contents(first.folder)
    (first.folder / "left-over.txt").touch()
    second = run(small, overwrite=True)
    after = contents(second.folder)
    assert sorted(after) == sorted(before)
    for name in ("rig.json", "one-bar-points.csv", "one-bar-positions.csv", "run.json"):
        assert after[name] == before[name], name
    assert not [path for path in small.parent.iterdir() if path.name.startswith(".")]


@pytest.mark.parametrize("overwrite", [False, True])
def test_a_foreign_folder_is_left_alone(small, tmp_path, overwrite):
    foreign = tmp_path / "photographs"
    foreign.mkdir()
    (foreign / "holiday.jpg").write_bytes(b"x")
    with pytest.raises(FileError, match="photographs"):
        run(small, output=foreign, overwrite=overwrite)
    assert contents(foreign) == {"holiday.jpg": b"x"}


def test_a_file_in_the_place_of_the_folder(small, tmp_path):
    (tmp_path / "results").write_text("x", encoding="utf-8")
    with pytest.raises(FileError, match="is a file"):
        run(small, output=tmp_path / "results", overwrite=True)


def test_the_folder_of_the_project_is_never_replaced(small):
    (small.parent / "run.json").write_text("{}", encoding="utf-8")
    before = sorted(small.parent.rglob("*"))
    for folder in (small.parent, small.parent.parent):
        with pytest.raises(FileError, match="the project lies in it"):
            run(small, output=folder, overwrite=True)
    assert sorted(small.parent.rglob("*")) == before


def test_a_run_that_fails_writes_nothing(small):
    (small.parent / "control.csv").write_text("point,x_mm\n", encoding="utf-8")
    with pytest.raises(InputError):
        run(small)
    assert not (small.parent / "results").exists()
