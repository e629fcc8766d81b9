"""What perspective and lens take a disc's image centre off: against rendered truth."""

from __future__ import annotations

import csv
import json

import cv2
import numpy as np
import pytest

from closerange.geometry.transform import RigidTransform
from closerange.rig.camera import Camera
from closerange.rig.disc_bias import DiscViews, disc_centre_bias, disc_normals, outline_centre
from closerange.rig.distortion import BrownIdeal
from closerange.verification.scenes import rig_b

SETS = ("A_calib_discs", "B_calib_discs_black")


def cameras_of(folder):
    """Read the true cameras of a rendered set (its own file, not ours)."""
    document = json.loads((folder / "cameras.json").read_text("utf-8"))
    return [
        Camera(
            name,
            (entry["width"], entry["height"]),
            np.array(entry["K"], dtype=float),
            RigidTransform(entry["R"], entry["t_mm"]),
            BrownIdeal(*entry["dist_k1_k2_p1_p2_k3"]),
        )
        for name, entry in document["cameras"].items()
    ]


def truth_of(folder, camera):
    """Columns of the true targets as seen by one camera."""
    with (folder / "targets.csv").open(encoding="utf-8", newline="") as stream:
        rows = [row for row in csv.DictReader(stream) if row["camera"] == camera.name]

    def columns(*names):
        return np.array([[float(row[name]) for name in names] for row in rows])

    return {
        "xyz": columns("X_mm", "Y_mm", "Z_mm"),
        "normal": columns("nx", "ny", "nz"),
        "radius": columns("radius_mm")[:, 0],
        "centre": columns("u_centre", "v_centre"),
        "area": columns("u_area", "v_area"),
    }


def outline(xyz, normal, radius, count=360):
    """Points on the rim of one disc."""
    normal = np.asarray(normal, float) / np.linalg.norm(normal)
    u = np.cross(normal, [1.0, 0, 0] if abs(normal[0]) < 0.9 else [0, 1.0, 0])
    u /= np.linalg.norm(u)
    turn = np.linspace(0, 2 * np.pi, count, endpoint=False)[:, None]
    return xyz + radius * (np.cos(turn) * u + np.sin(turn) * np.cross(normal, u))


def fitted_ellipse(camera, xyz, normal, radius, noise_px=0.0, rng=None):
    """OpenCV's ellipse of the seen rim: centre (2,), and a, b, angle (3,)."""
    edge = camera.project(outline(xyz, normal, radius))
    if rng is not None:
        edge = edge + rng.normal(0, noise_px, edge.shape)
    middle = edge.mean(axis=0)
    (x, y), (minor, major), degrees = cv2.fitEllipseDirect(
        (edge - middle).reshape(-1, 1, 2).astype(np.float32)
    )
    angle = np.deg2rad(degrees + 90)
    if minor > major:
        minor, major, angle = major, minor, np.deg2rad(degrees)
    return middle + np.array([x, y]), np.array([major / 2, minor / 2, angle])


def views(cameras, discs, **noise):
    """DiscViews of (xyz, normal, radius) and the fitted centres (M, C, 2)."""
    fits = [[fitted_ellipse(camera, *disc, **noise) for camera in cameras] for disc in discs]
    ellipse = np.array([[fit[1] for fit in row] for row in fits])
    centre = np.array([[fit[0] for fit in row] for row in fits])
    xyz = np.array([disc[0] for disc in discs])
    return DiscViews(xyz, ellipse, np.array([2.0 * disc[2] for disc in discs])), centre


def degrees_between(one, other):
    one, other = (np.asarray(v) / np.linalg.norm(v, axis=-1, keepdims=True) for v in (one, other))
    return np.rad2deg(np.arccos(np.clip(np.sum(one * other, axis=-1), -1, 1)))


@pytest.mark.parametrize("name", SETS)
def test_outline_centre_is_the_rendered_centre_of_area(shared, name):
    folder = shared / "data" / "rendered" / name
    for camera in cameras_of(folder):
        truth = truth_of(folder, camera)
        assert len(truth["xyz"]) >= 27
        np.testing.assert_allclose(camera.project(truth["xyz"]), truth["centre"], atol=1e-6)
        centre = outline_centre(camera, truth["xyz"], truth["normal"], truth["radius"])
        # biases reach 0.059 px; measured 5.6e-7 px, of which the table's last digit is 5e-7
        assert np.abs(truth["area"] - truth["centre"]).max() > 0.02
        np.testing.assert_allclose(centre, truth["area"], atol=1e-5)


@pytest.mark.parametrize("name", SETS)
def test_bias_from_the_ellipses_is_the_rendered_bias(shared, name):
    folder = shared / "data" / "rendered" / name
    cameras = cameras_of(folder)[:2]
    truth = [truth_of(folder, camera) for camera in cameras]
    first = truth[0]
    discs, _ = views(
        cameras, list(zip(first["xyz"], first["normal"], first["radius"], strict=True))
    )
    bias = disc_centre_bias(cameras, discs)
    expected = np.stack([part["area"] - part["centre"] for part in truth], axis=1)
    # measured 7e-5: the affine approximation of the attitude is good to (radius / depth)^2
    assert np.abs(bias - expected).max() < 0.001 * np.abs(expected).max()


@pytest.mark.parametrize(
    "normal", [[0, 0, 1], [0.5, 0.2, 1], [-0.6, 0.1, 1], [0.1, -0.7, 1], [0.9, 0.9, 1]]
)
def test_attitude_of_tilted_discs(normal):
    cameras = rig_b().cameras
    places = np.array([[0.0, 0, 0], [50, -40, 30], [-60, 55, -45]])
    discs, _ = views(cameras, [(xyz, normal, 5.0) for xyz in places])
    # measured 0.007 degrees
    assert (degrees_between(disc_normals(cameras, discs), normal) < 0.05).all()


def test_the_normal_looks_towards_the_cameras():
    cameras = rig_b().cameras
    discs, _ = views(cameras, [(np.zeros(3), [-0.3, 0.2, -1.0], 5.0)])
    assert degrees_between(disc_normals(cameras, discs)[0], [0.3, -0.2, 1.0]) < 0.5


def test_apparent_size_does_not_matter():
    """Blooming makes discs look 5 % larger in one exposure: the attitude stays."""
    cameras = rig_b().cameras
    discs, _ = views(cameras, [(np.zeros(3), [0.4, 0.3, 1.0], 5.0)])
    ellipse = discs.ellipse.copy()
    ellipse[..., :2] *= 1.05
    larger = DiscViews(discs.xyz_mm, ellipse, discs.diameter_mm)
    one, two = disc_normals(cameras, discs), disc_normals(cameras, larger)
    assert degrees_between(one, two)[0] < 0.01


def test_bias_from_noisy_ellipses_is_right_within_ten_percent():
    """Edge noise of 0.2 px on 360 points, a good detector's: 0.015 px in the semi-axes."""
    cameras = rig_b().cameras
    rng = np.random.default_rng(5)
    made = [
        (rng.uniform(-50, 50, 3), [*rng.uniform(-0.5, 0.5, 2), 1.0], rng.uniform(6, 9))
        for _ in range(40)
    ]
    exact, centre = views(cameras, made)
    expected = centre - np.stack([camera.project(exact.xyz_mm) for camera in cameras], axis=1)
    noisy, _ = views(cameras, made, noise_px=0.2, rng=rng)
    error = disc_centre_bias(cameras, noisy) - expected
    rms = np.sqrt(np.mean(expected**2))
    assert rms > 0.05  # there is something to correct
    assert np.sqrt(np.mean(error**2)) < 0.1 * rms  # measured 0.5 %


def test_a_third_view_without_ellipse_is_corrected_too():
    """The attitude from two views holds for the third, whose ellipse was not measured."""
    pair = rig_b().cameras
    cameras = [*pair, pair[0].moved({"tx": 40.0})]
    disc = (np.array([5.0, 10, 0]), [0.4, 0.3, 1.0], 8.0)
    discs, centre = views(cameras, [disc])
    ellipse = discs.ellipse.copy()
    ellipse[0, 2] = np.nan
    bias = disc_centre_bias(cameras, DiscViews(discs.xyz_mm, ellipse, discs.diameter_mm))
    expected = centre[0, 2] - cameras[2].project(disc[0])[0]
    assert np.linalg.norm(expected) > 0.03
    np.testing.assert_allclose(bias[0, 2], expected, atol=0.05 * np.linalg.norm(expected))


@pytest.mark.parametrize("lost", ["one ellipse", "diameter", "position"])
def test_what_is_not_known_gives_no_bias(lost):
    cameras = rig_b().cameras
    whole, _ = views(cameras, [(np.zeros(3), [0.4, 0.3, 1.0], 5.0)] * 2)
    xyz, ellipse = whole.xyz_mm.copy(), whole.ellipse.copy()
    diameter = whole.diameter_mm.copy()
    if lost == "one ellipse":
        ellipse[0, 1] = np.nan
    elif lost == "diameter":
        diameter[0] = np.nan
    else:
        xyz[0] = np.nan
    discs = DiscViews(xyz, ellipse, diameter)
    bias = disc_centre_bias(cameras, discs)
    assert (bias[0] == 0).all()
    assert (np.abs(bias[1]).max(axis=1) > 1e-3).all()
    assert np.isnan(disc_normals(cameras, discs)[0]).all()


def test_no_discs():
    cameras = rig_b().cameras
    nothing = DiscViews(np.empty((0, 3)), np.empty((0, 2, 3)), np.empty(0))
    assert disc_centre_bias(cameras, nothing).shape == (0, 2, 2)


def test_a_disc_behind_the_camera_has_no_image():
    camera = rig_b().cameras[0]
    behind = camera.centre_mm * 2
    ends = outline_centre(camera, behind[None], np.array([[0.0, 0, 1]]), np.array([5.0]))
    assert np.isnan(ends).all()
