"""The matching benchmark: its truth, its peers and its figures against what is known."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import cv2
import numpy as np
import pytest

BENCHMARKS = Path(__file__).parents[2] / "benchmarks"
sys.path.insert(0, str(BENCHMARKS))

from closerange.geometry.transform import RigidTransform, rotation_from_vector  # noqa: E402
from closerange.rig.camera import Camera  # noqa: E402
from closerange.rig.distortion import BrownIdeal  # noqa: E402
from matching import methods as methods_module  # noqa: E402
from matching.depth_contours import DepthContours  # noqa: E402
from matching.measures import FACE, figures, wrong_faces  # noqa: E402
from matching.method import Matches, UnavailableError  # noqa: E402
from matching.methods import methods  # noqa: E402
from matching.peers import semi_global, sift, zncc_sweep  # noqa: E402
from matching.run import run  # noqa: E402
from matching.scene_truth import Kind, PointTruth, SceneTruth, read_cameras  # noqa: E402
from matching.scenes import Scene  # noqa: E402

SCENES = ("A_blocks", "B_blocks", "A_spring", "A_parts")
SIZE = (320, 240)


def scene_folder(shared, name):
    return shared / "data" / "rendered" / name


@pytest.fixture(scope="module", params=SCENES)
def rendered(request, shared):
    folder = scene_folder(shared, request.param)
    table = np.genfromtxt(
        folder / "edge_points.csv", delimiter=",", names=True, dtype=None, encoding="utf-8"
    )
    return request.param, SceneTruth(folder), table


def test_mesh_edge_points_are_edges_at_their_listed_place(rendered):
    name, truth, table = rendered
    left = np.column_stack([table["u_left"], table["v_left"]])
    right = np.column_stack([table["u_right"], table["v_right"]])
    along = (
        truth.first.project_jacobian(np.column_stack([table["X_mm"], table["Y_mm"], table["Z_mm"]]))
        @ np.stack([table["dx"], table["dy"], table["dz"]], 1)[..., None]
    )
    tangent = along[..., 0] / np.linalg.norm(along[..., 0], axis=1, keepdims=True)
    found = truth.of(left, tangent)
    assert (found.kind == int(Kind.edge)).all()
    error = np.linalg.norm(found.xy_px - right, axis=1)
    # edges that cover each other within a hundredth of a pixel remain
    assert np.quantile(error, 0.98) < 0.01, f"{name}: {np.quantile(error, 0.98):.4f} px"
    assert truth.seen(found.xyz_mm).mean() > 0.999


def test_a_point_beside_an_edge_keeps_its_own_ray(rendered):
    _, truth, table = rendered
    left = np.column_stack([table["u_left"] + 0.3, table["v_left"] - 0.2])
    found = truth.of(left)
    back = truth.first.project(found.xyz_mm)
    assert np.abs(back - left).max() < 1e-6


def test_pixels_of_faces_agree_with_the_other_view(rendered):
    _, truth, _ = rendered
    rng = np.random.default_rng(3)
    height, width = truth.depth_mm.shape
    pixels = np.column_stack([rng.integers(9, width - 9, 3000), rng.integers(9, height - 9, 3000)])
    found = truth.of(pixels.astype(float))
    surface = found.kind == int(Kind.surface)
    occluded = found.kind == int(Kind.occluded)
    inside = truth.visible[pixels[:, 1], pixels[:, 0]]
    assert surface.sum() > 1000
    assert inside[surface].mean() > 0.99
    assert not inside[occluded].any()
    assert truth.seen(found.xyz_mm[surface]).mean() > 0.999


def test_outlines_are_found_without_names_of_objects(shared):
    contours = SceneTruth(scene_folder(shared, "A_blocks")).contours
    objects = np.load(scene_folder(shared, "A_blocks") / "truth_left.npz")["object_id"]
    cylinders = np.isin(objects, (4, 5))
    assert contours.curved.sum() > 60
    assert cylinders[contours.curved].mean() == 1.0
    assert cylinders[contours.round].mean() > 0.97
    spring = SceneTruth(scene_folder(shared, "A_spring")).contours
    wire = np.load(scene_folder(shared, "A_spring") / "truth_left.npz")["object_id"] == 2
    assert spring.round[wire].mean() > 0.95


def test_depth_of_a_ball_bends_and_that_of_a_box_does_not():
    y, x = np.mgrid[-40:41, -40:41] * 0.3
    inside = x**2 + y**2 < 10**2
    ball = np.where(inside, 1000 - np.sqrt(np.where(inside, 100 - x**2 - y**2, 0)), 1050.0)
    box = np.where((abs(x) < 8) & (abs(y) < 8), 1000 + 0.5 * x, 1050.0)
    found = DepthContours.of(ball)
    assert found.curved.sum() > 0.5 * found.near.sum()
    assert found.round[40, 40]
    found = DepthContours.of(box)
    assert found.near.any()
    assert not found.curved.any()
    assert not found.round[30:50, 30:50].any()


def plane_scene():
    """Two converged cameras with a lens see a textured plane, slightly tilted to the sweep."""
    matrix = np.array([[1500.0, 0, 160], [0, 1500, 120], [0, 0, 1]])
    cameras = []
    for name, turn in (("left", 0.12), ("right", -0.12)):
        rotation = rotation_from_vector([0.0, turn, 0.03]) @ np.diag([1.0, -1.0, -1.0])
        pose = RigidTransform(rotation, np.array([0.0, 0.0, 600.0]))
        cameras.append(Camera(name, SIZE, matrix, pose, BrownIdeal(k1=-0.2, p1=1e-3)))
    rng = np.random.default_rng(5)
    texture = cv2.GaussianBlur(rng.uniform(0, 255, (900, 900)).astype(np.float32), (0, 0), 3)
    texture = 128 + 8 * (texture - texture.mean())
    y, x = np.mgrid[: SIZE[1], : SIZE[0]]
    pixels = np.column_stack([x.ravel(), y.ravel()]).astype(float)
    images = []
    for camera in cameras:
        xyz = on_plane(camera, pixels)
        place = (xyz[:, :2] * 4 + 450).astype(np.float32).reshape(*x.shape, 2)
        image = cv2.remap(texture, place[..., 0], place[..., 1], cv2.INTER_LINEAR)
        images.append(np.clip(np.rint(image), 0, 255).astype(np.uint8))
    points = rng.uniform([60, 40], [260, 200], (150, 2))
    xyz = on_plane(cameras[0], points)
    truth = PointTruth(np.zeros(150, np.int64), xyz, cameras[1].project(xyz), np.zeros(150))
    volume = np.array([[-np.inf, -np.inf, -30.0], [np.inf, np.inf, 30.0]])
    return Scene("plane", tuple(images), tuple(cameras), volume, points, truth)


def on_plane(camera, pixels):
    normal, offset = np.array([0.05, -0.03, 1.0]), 4.0
    rays = camera.directions(pixels)
    way = (offset - normal @ camera.centre_mm) / (rays @ normal)
    return camera.centre_mm + way[:, None] * rays


@pytest.mark.parametrize(
    ("peer", "median_px", "share"),
    [(zncc_sweep, 0.03, 0.98), (semi_global, 0.25, 0.95), (sift, 0.3, 0.5)],
)
def test_peers_find_a_textured_plane(peer, median_px, share):
    scene = plane_scene()
    found, kept = peer.match(scene.images, scene.cameras, scene.xy_px, scene.volume_mm)
    error = np.linalg.norm(found - scene.truth.xy_px, axis=1)
    assert np.median(error[kept]) < median_px, f"{np.median(error[kept]):.3f} px"
    assert (error[kept] < 1).mean() > 0.97
    assert kept.mean() > share, f"{kept.mean():.2f}"


def matches_of(scene, noise_px, flags=None):
    rng = np.random.default_rng(1)
    first, second = scene.cameras
    step = second.project(scene.truth.xyz_mm + 0.1 * first.directions(scene.xy_px))
    way = step - scene.truth.xy_px
    way /= np.linalg.norm(way, axis=1, keepdims=True)
    error = noise_px * rng.normal(size=len(way))
    count = len(way)
    return Matches(
        scene.truth.xy_px + error[:, None] * way,
        np.zeros(count, np.int64) if flags is None else flags,
        np.ones(count, bool),
        np.broadcast_to(noise_px**2 * np.eye(2), (count, 2, 2)).copy(),
    ), error


def test_figures_of_known_errors():
    scene = plane_scene()
    matches, error = matches_of(scene, 0.05)
    got = figures(scene, matches)
    assert got.raw == 1.0
    assert got.raw_fine == pytest.approx((np.abs(error) < 0.1).mean())
    assert got.median_along_px == pytest.approx(np.quantile(np.abs(error), 0.5, method="lower"))
    inside = (np.abs(error) < 1.959964 * 0.05).mean()
    assert got.cover_px == pytest.approx(inside)
    assert got.cover_mm == pytest.approx(inside, abs=0.02)
    # px along the curve per mm of height: 0.05 px are that many mm
    mm = np.quantile(np.abs(error), 0.5) / (1500 / 600 * 2 * np.tan(0.12))
    assert got.height_median == pytest.approx(mm, rel=0.1)


def test_flagged_occluded_and_missing_points_count_as_they_should():
    scene = plane_scene()
    scene.truth.kind[:30] = int(Kind.occluded)
    flags = np.zeros(150, np.int64)
    flags[15:60] = 4  # half of the occluded, and 30 visible ones
    matches, _ = matches_of(scene, 0.01, flags)
    matches.xy_px[140:] = np.nan
    got = figures(scene, matches)
    assert (got.visible, got.occluded) == (120, 30)
    assert got.raw == pytest.approx(110 / 120)
    assert got.final.recall == pytest.approx(80 / 120)
    assert got.final.precision == pytest.approx(80 / 95)
    assert got.occluded_kept == pytest.approx(0.5)


def test_wrong_faces_are_connected_pieces():
    line = np.column_stack([np.arange(200.0), np.zeros(200)])
    wrong = np.zeros(200, bool)
    wrong[10 : 10 + FACE] = True
    assert wrong_faces(line, wrong) == 0
    wrong[10 + FACE] = True
    assert wrong_faces(line, wrong) == 1
    wrong[100:180] = True
    assert wrong_faces(line, wrong) == 2
    wrong[140:143] = False
    assert wrong_faces(line, wrong) == 3


def test_a_method_that_is_missing_is_named(monkeypatch):
    def missing(*_):
        raise UnavailableError("closerange.matching.literal cannot be imported")

    monkeypatch.setattr(methods_module, "_module", missing)
    scene = plane_scene()
    result = run(methods(["literal 15"])[0], scene, 1)
    assert result.figures is None
    assert "literal" in result.reason
    assert result.as_dict()["not_run"] == result.reason


def test_cameras_are_read_as_the_tables_state(shared):
    folder = scene_folder(shared, "A_blocks")
    table = np.genfromtxt(
        folder / "edge_points.csv", delimiter=",", names=True, dtype=None, encoding="utf-8"
    )
    xyz = np.column_stack([table["X_mm"], table["Y_mm"], table["Z_mm"]])
    shown = read_cameras(folder)["right"].project(xyz)
    assert np.abs(shown - np.column_stack([table["u_right"], table["v_right"]])).max() < 5e-4


def test_missing_data_are_a_message(tmp_path):
    done = subprocess.run(
        [sys.executable, BENCHMARKS / "bench_matching.py", "--shared", tmp_path / "nowhere"],
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 1
    assert "nowhere" in done.stderr
    assert "--shared" in done.stderr
    assert "Traceback" not in done.stderr
