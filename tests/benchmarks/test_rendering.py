"""The renderer of held-out scenes, as far as it needs no Blender."""

from __future__ import annotations

import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from scipy.special import ndtr

BENCHMARKS = Path(__file__).parents[2] / "benchmarks"
sys.path.insert(0, str(BENCHMARKS))

from matching.scene_truth import Kind, SceneTruth, read_cameras  # noqa: E402
from rendering.cameras import looking  # noqa: E402
from rendering.edges import edge_points  # noqa: E402
from rendering.folder import write_images, write_truth  # noqa: E402
from rendering.placing import apart, around, standing  # noqa: E402
from rendering.scene import GROUND_Z_MM, Light, Scene, ground  # noqa: E402
from rendering.scenes import SCENES  # noqa: E402
from rendering.sensor import Pinhole, Sensor, irradiance  # noqa: E402
from rendering.solids import (  # noqa: E402
    Finish,
    box,
    cut_below,
    cylinder,
    roof,
    tapered,
    turn,
    wedge,
)
from rendering.truth import cast, pixel_rays, visible  # noqa: E402

TARGET = (0.0, 0.0, -30.0)
BROWN = (-0.9, 3.0, 0.004, -0.003, 0.0)
PLAIN = Finish()


def view(name, right_deg, roll_deg, size=(160, 120)):
    return looking(
        name,
        size,
        640.0,
        centre_mm=around(600, right_deg, 4, TARGET),
        target_mm=TARGET,
        roll_deg=roll_deg,
        off_px=(3.3, -2.1),
        brown=BROWN,
    )


@pytest.fixture(scope="module")
def scene():
    return Scene(
        name="two_boxes",
        text="Two boxes.",
        views=(view("left", -13, 0), view("right", 12, 25)),
        solids=(
            standing(box("high", 30, 20, 40), -18, 4, 20, PLAIN),
            standing(box("low", 24, 24, 12), 22, -6, -30, PLAIN),
        ),
        grounds=(ground(PLAIN),),
        lights=(Light((0, 0, 500), (100, 100), 1.0),),
        heights_mm=(-53, 0),
        seed=1,
    )


@pytest.fixture(scope="module")
def folder(scene, tmp_path_factory):
    path = tmp_path_factory.mktemp("two_boxes")
    lines = write_truth(path, scene)
    light = [np.full((v.size_px[1], v.size_px[0]), 0.5) for v in scene.views]
    write_images(path, scene, light, 1.0)
    (path / "lines.txt").write_text("\n".join(lines), encoding="utf-8")
    return path


def brute_force(seer, surfaces, rays):
    """Nearest hit by solving for each ray and triangle."""
    corners = seer.in_camera(surfaces.corners_mm)
    depth = np.full(len(rays), np.inf)
    for a, b, c in corners:
        for row, (x, y) in enumerate(rays):
            matrix = np.column_stack([[x, y, 1.0], a - b, a - c])
            if abs(np.linalg.det(matrix)) < 1e-12:
                continue
            t, beta, gamma = np.linalg.solve(matrix, a)
            if t > 0 and beta >= 0 and gamma >= 0 and beta + gamma <= 1:
                depth[row] = min(depth[row], t)
    return depth


def test_a_camera_sees_its_target_at_the_principal_point_and_rolls_about_it():
    level, rolled = view("left", -13, 0), view("left", -13, 30)
    assert level.project([TARGET]) == pytest.approx(np.array([[82.8, 57.4]]), abs=1e-9)
    np.testing.assert_allclose(rolled.project([TARGET]), level.project([TARGET]), atol=1e-9)
    ways = [v.in_camera([[0, 10, -30]])[0, :2] for v in (level, rolled)]
    turned = np.rad2deg(np.diff([np.arctan2(y, x) for x, y in ways]))[0]
    assert turned == pytest.approx(30, abs=1e-9)
    assert ways[0][1] < 0  # world +Y is up, image rows go down


def test_projection_agrees_with_opencv_and_with_the_judge(scene, folder):
    xyz = np.random.default_rng(2).uniform(-40, 40, (200, 3))
    judge = read_cameras(folder)
    for own in scene.views:
        turn_vector = cv2.Rodrigues(own.rotation)[0]
        seen, _ = cv2.projectPoints(
            xyz, turn_vector, own.translation_mm, own.matrix, np.array(own.brown)
        )
        np.testing.assert_allclose(own.project(xyz), seen.reshape(-1, 2), atol=1e-9)
        np.testing.assert_allclose(own.project(xyz), judge[own.name].project(xyz), atol=1e-9)
        np.testing.assert_allclose(own.distorted_px(own.ideal(seen[:, 0])), seen[:, 0], atol=1e-9)


def test_rays_meet_what_they_meet_by_brute_force(scene):
    surfaces = scene.surfaces()
    rays = np.random.default_rng(3).uniform(-0.09, 0.09, (150, 2))
    depth, triangle = cast(scene.views[0], surfaces, rays)
    np.testing.assert_allclose(depth, brute_force(scene.views[0], surfaces, rays), rtol=1e-9)
    assert set(surfaces.owner[triangle]) == {0, 1, 2}


def test_no_ray_slips_between_triangles_that_share_an_edge():
    disc = cylinder("disc", 20, 10).moved(turn((1, 2, 0), 25), (0, 0, 0))
    only = Scene("", "", (), (disc,), (), (), (0, 1), 0).surfaces()
    seer = view("left", 0, 0)
    # rays exactly to the middle of the lid, where 192 triangles' edges come near, and on edges
    lid = disc.vertices_mm[list(disc.faces[1])]
    points = np.concatenate([lid[0] + s * (lid[2:-1] - lid[0]) for s in (0.1, 0.5, 0.9)])
    local = seer.in_camera(points)
    depth, _ = cast(seer, only, local[:, :2] / local[:, 2:])
    np.testing.assert_allclose(depth, local[:, 2], atol=1e-9)


def test_a_triangle_behind_the_camera_is_refused(scene):
    near = looking("near", (160, 120), 640.0, centre_mm=(0, 0, 100), target_mm=(900, 0, -40))
    with pytest.raises(ValueError, match="behind camera near"):
        cast(near, scene.surfaces(), np.zeros((1, 2)))


def test_the_judge_reads_depth_and_visibility_back(scene, folder):
    truth = SceneTruth(folder)
    left, right = scene.views
    rays = pixel_rays(left)
    depth, _ = cast(left, scene.surfaces(), rays)
    assert np.abs(truth.depth_mm.ravel() - depth).max() < 5e-5  # float32 at 600 mm
    seen = visible(right, scene.surfaces(), left.world(rays, depth))
    assert (truth.visible.ravel() != seen).sum() == 0
    assert 0.5 < seen.mean() < 0.99
    # by the judge's own second map the same points are seen, but for silhouettes
    assert truth.seen(left.world(rays, depth))[seen].mean() > 0.999


def test_edge_points_are_edges_for_the_judge(folder):
    truth = SceneTruth(folder)
    table = np.genfromtxt(folder / "edge_points.csv", delimiter=",", skip_header=1)
    found = truth.of(table[:, 9:11])
    assert len(table) > 200
    assert (found.kind == int(Kind.edge)).all()
    error = np.linalg.norm(found.xy_px - table[:, 11:13], axis=1)
    assert np.quantile(error, 0.95) < 0.01, f"{np.quantile(error, 0.95):.4f} px"
    assert truth.seen(found.xyz_mm).mean() > 0.999


def test_checks_of_a_folder_close_to_the_rounding_of_its_numbers(folder):
    lines = (folder / "lines.txt").read_text(encoding="utf-8").splitlines()
    exact = [float(line.split()[-2]) for line in lines if line.startswith("exact")]
    assert len(exact) == 2
    assert max(exact) < 5e-3
    for line in (line for line in lines if line.startswith("(a)")):
        assert float(line.split("max ")[1].split()[0]) < 5e-4
    backs = [line for line in lines if line.startswith("(b)")]
    assert len(backs) == 2
    assert all(float(line.split("p99 ")[1].split()[0]) < 2e-3 for line in backs), backs


def test_a_box_has_points_in_the_middle_of_every_millimetre():
    table = edge_points(box("box", 12, 7, 5))
    assert len(table.xyz_mm) == 4 * (12 + 7 + 5)
    assert table.convex.all()
    along_x = np.abs(table.direction[:, 0]) > 0.5
    x, y, z = table.xyz_mm[along_x].T
    np.testing.assert_allclose(np.unique(x.round(9)), np.arange(-5.5, 6))
    assert set(np.abs(y).round(9)) == {3.5}
    assert set(z.round(9)) == {0, 5}


def test_round_rims_have_points_facets_and_reentrant_edges_are_told_apart():
    rims = edge_points(cylinder("disc", 10, 6))
    assert set(rims.xyz_mm[:, 2].round(9)) == {0, 6}  # none along the 192 facets
    assert len(rims.xyz_mm) == pytest.approx(2 * 2 * np.pi * 10, abs=2)
    outline = [(0, 0), (0, 10), (-10, 10), (-10, -10), (10, -10), (10, 0)]
    angle = edge_points(tapered("angle", "angle", outline, outline, (0, 8)))
    inner = np.linalg.norm(angle.xyz_mm[:, :2], axis=1) < 0.1
    assert inner.sum() == 8
    assert (angle.convex == ~inner).all()


def test_an_open_body_is_refused():
    whole = box("box", 12, 7, 5)
    with pytest.raises(ValueError, match="box is not closed"):
        edge_points(replace(whole, faces=whole.faces[:-1]))


def volume(solid):
    a, b, c = solid.vertices_mm[solid.triangles].transpose(1, 0, 2)
    return np.einsum("ij,ij->", a, np.cross(b, c)) / 6


def test_shapes_are_closed_and_face_outwards():
    assert volume(box("", 4, 5, 6)) == pytest.approx(120)
    assert volume(wedge("", 4, 5, 6, 2)) == pytest.approx(80)
    assert volume(roof("", 4, 5, 6, 2, 1.0)) == pytest.approx(4 * 5 * 4)
    assert volume(cylinder("", 3, 5)) == pytest.approx(45 * np.pi, rel=1e-3)


def test_what_is_cut_off_and_what_remains_make_up_the_whole():
    body = wedge("", 30, 20, 24, 6).moved(turn((1, 0.4, 0), 37), (0, 0, -5))
    above = cut_below(body, 1.5)
    below = cut_below(body.moved(np.diag([1, -1, -1]), (0, 0, 0)), -1.5)
    assert above.vertices_mm[:, 2].min() == 1.5
    assert volume(above) + volume(below) == pytest.approx(volume(body), rel=1e-9)
    assert min(volume(above), volume(below)) > 0.1 * volume(body)
    assert edge_points(above).convex.all()
    assert volume(cut_below(body, -100)) == pytest.approx(volume(body))


def test_noise_and_black_level_are_those_of_the_sensor():
    sensor, rng = Sensor(), np.random.default_rng(5)
    for fraction in (0.0, 0.1, 0.6):
        grey = sensor.numbers(np.full((300, 300), fraction), rng).astype(float)
        dn_per_electron = 249 / 12000
        sigma = np.hypot(np.sqrt(fraction * 12000 + 14**2) * dn_per_electron, np.sqrt(1 / 12))
        if fraction:
            assert grey.mean() == pytest.approx(6 + 249 * fraction, abs=0.05)
            assert grey.std() == pytest.approx(sigma, rel=0.03)
        else:
            assert np.median(grey) == 6
    assert sensor.numbers(np.full((2, 2), 3.0), rng).min() == 255


def test_gamma_is_undone():
    sensor = Sensor(gamma=2.2, read_noise_e=0.0, full_well_e=1e9)
    grey = sensor.numbers(np.array([[0.2, 0.5, 0.9]]), np.random.default_rng(0))
    assert grey[0, 1] == round(6 + 249 * 0.5 ** (1 / 2.2))
    np.testing.assert_allclose(sensor.linear(grey)[0], 6 + 249 * np.array([0.2, 0.5, 0.9]), atol=1)


def blurred_edge(place_px, count):
    """Light of pixels right of an edge: Gaussian, pixel square, and fine pixel."""
    within = (np.arange(48) + 0.5) / 48 - 0.5
    fine, pixel = np.meshgrid(within / 3, within)
    at = np.arange(count)[:, None] - place_px + (fine + pixel).ravel()
    return ndtr(at / 0.7).mean(axis=1)


@pytest.mark.parametrize("brown", [(0.0,) * 5, BROWN])
def test_an_edge_lands_where_the_lens_puts_it(brown):
    seer = replace(view("left", 0, 0, size=(120, 90)), brown=brown)
    pinhole = Pinhole.covering(seer, 3)
    columns, rows = pinhole.size
    edge = 0.0413  # ideal x of a vertical edge, right of it is light
    begins = edge * pinhole.focal + pinhole.principal[0] + 0.5
    share = np.clip(np.arange(1, columns + 1) - begins, 0, 1)  # exact coverage of each pixel
    picture = np.broadcast_to(share, (rows, columns)).astype(np.float32)
    seen = irradiance(picture, pinhole, seer, 3, 0.7)
    assert seen.shape == (90, 120)
    y = np.linspace(-0.09, 0.09, 2001)
    curve = seer.distorted_px(np.column_stack([np.full(2001, edge), y]))
    for row in (5, 44, 84):
        place = np.interp(row, curve[:, 1], curve[:, 0])
        slope = (blurred_edge(place + 0.01, 120) - blurred_edge(place - 0.01, 120)) / 0.02
        shift = slope @ (seen[row] - blurred_edge(place, 120)) / (slope @ slope)
        assert abs(shift) < 0.002, f"{shift:.4f} px in row {row}"


def test_blur_is_gaussian_and_keeps_light():
    seer = view("left", 0, 0, size=(60, 48))
    flat = replace(seer, brown=(0.0, 0.0, 0.0, 0.0, 0.0))
    pinhole = Pinhole.covering(flat, 3)
    picture = np.zeros(pinhole.size[::-1], np.float32)
    picture[pinhole.size[1] // 2, pinhole.size[0] // 2] = 9.0
    seen = irradiance(picture, pinhole, flat, 3, 0.7)
    assert seen.sum() == pytest.approx(1, abs=1e-3)
    u, profile = np.arange(60), seen.sum(axis=0)
    spread = np.sqrt(profile @ (u - profile @ u) ** 2)
    assert spread == pytest.approx(np.sqrt(0.7**2 + 1 / 12), abs=0.01)


@pytest.mark.parametrize("name", ["C_pins", "D_texture", "D_clutter", "E_wedges"])
def test_scenes_lie_within_all_images_and_bodies_do_not_cut_each_other(name):
    held = SCENES[name]()
    assert held.name == name
    for seer in held.views:
        for body in held.solids:
            assert seer.inside(seer.project(body.vertices_mm)).all(), f"{seer.name}, {body.name}"
    for number, body in enumerate(held.solids):
        assert volume(body) > 0
        assert body.vertices_mm[:, 2].min() >= GROUND_Z_MM
        for other in held.solids[:number]:
            on_top = other.name == "plate" and name == "C_pins"
            assert on_top or apart(other, body, 0.1), f"{other.name}, {body.name}"


def test_without_blender_it_says_what_to_install(tmp_path):
    script = BENCHMARKS / "rendering" / "render.py"
    code = (
        "import runpy, sys; sys.modules['bpy'] = None; "
        f"sys.argv = ['render.py', '--out', {str(tmp_path)!r}]; "
        f"runpy.run_path({str(script)!r}, run_name='__main__')"
    )
    run = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert run.returncode == 2
    assert "pip install 'bpy==4.2.*'" in run.stderr
    assert len(run.stderr.strip().splitlines()) == 1
