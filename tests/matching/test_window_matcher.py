"""Window matches on rendered textures, plain faces and real speckle."""

import json
import warnings
from functools import cache

import cv2
import numpy as np
import pytest

from closerange.errors import InputError
from closerange.features.edges import find_edges
from closerange.flags import Flag
from closerange.geometry.transform import RigidTransform
from closerange.matching.pencil import Pencil
from closerange.matching.window_matcher import match_windows
from closerange.rig.camera import Camera
from closerange.rig.distortion import BrownIdeal
from closerange.verification.scenes import looking_at_origin
from closerange.verification.textured_planes import (
    TexturedPlane,
    render_planes,
    seen_points,
    visible,
)

SIZE = (240, 190)
VOLUME = [[-np.inf, -np.inf, -100.0], [np.inf, np.inf, 100.0]]


def camera(name, degrees):
    return looking_at_origin(
        name,
        angle_rad=np.radians(degrees),
        distance_mm=900.0,
        focal_px=1700.0,
        distortion=BrownIdeal(k1=-0.1),
        size_px=SIZE,
    )


LEFT, RIGHT = camera("left", -12.5), camera("right", 12.5)
PENCIL = Pencil.of(LEFT, RIGHT)


def turn(axis, degrees):
    return cv2.Rodrigues(np.radians(degrees) * np.eye(3)[axis])[0]


def plane(tilt=(0, 0), z=0.0, half=200.0, contrast=25.0, grey=110.0, seed=1, x=0.0, half_y=None):
    pose = turn(1, tilt[1]) @ turn(0, tilt[0])
    return TexturedPlane(
        np.array([x, 0.0, z]),
        pose @ [half, 0, 0],
        pose @ [0, half_y or half, 0],
        1.0,
        grey,
        contrast,
        seed,
    )


@cache
def flat():
    """Return one flat texture and its pictures, which most tests use."""
    scene = [plane()]
    return scene, pictures(scene)


def pictures(scene, noise=2.0, gain=0.8, offset=15.0, seed=1):
    return (
        render_planes(LEFT, scene, noise=noise, seed=seed).astype(np.float32),
        render_planes(RIGHT, scene, noise=noise, seed=seed + 1, gain=gain, offset=offset).astype(
            np.float32
        ),
    )


def edges_of(images):
    return tuple(find_edges(image.astype(np.uint8)) for image in images)


def no_edges(images):
    return tuple(edges.select(np.zeros(0, np.int64)) for edges in edges_of(images))


def matched(scene, images=None, count=80, **options):
    """Match random points that both see; return matches, errors along the curve, and points."""
    images = pictures(scene) if images is None else images
    points = np.random.default_rng(5).uniform(25, np.array(SIZE) - 25, (count, 2))
    xyz, _ = seen_points(LEFT, scene, points)
    truth = RIGHT.project(xyz)
    shown = visible(RIGHT, scene, xyz)
    shown &= ((truth > 20) & (truth < np.array(SIZE) - 21)).all(axis=1)
    shown &= np.abs(xyz[:, 2]) < 95
    # blur leaves open on which surface a point within a pixel of a step lies
    number = [seen_points(LEFT, scene, points + step)[1] for step in 1.5 * np.eye(2)]
    number += [seen_points(LEFT, scene, points - step)[1] for step in 1.5 * np.eye(2)]
    shown &= np.ptp(number, axis=0) == 0
    found = match_windows(PENCIL, images, no_edges(images), points[shown], VOLUME, **options)
    return found, np.einsum("ni,ni->n", found.xy_px - truth[shown], found.epipolar), xyz[shown]


@pytest.mark.parametrize("tilt", [(0, 0), (40, 0), (0, 40)])
def test_tilted_textures_are_found_with_honest_uncertainty(tilt):
    found, error, xyz = matched([plane(tilt, half=300.0)])
    kept = found.flags == 0
    assert kept.mean() > 0.95  # measured 0.98 to 1.0
    assert np.median(np.abs(error[kept])) < 0.03  # measured 0.014 to 0.018 px
    assert np.abs(error[kept]).max() < 0.2  # measured 0.11
    assert 0.9 < (np.abs(error[kept]) < 1.96 * found.std_px[kept]).mean() <= 1.0
    # a z of one is a standard deviation: neither half nor twice
    assert 0.6 < np.sqrt(np.mean((error[kept] / found.std_px[kept]) ** 2)) < 1.3
    assert np.median(np.linalg.norm(found.xyz_mm[kept] - xyz[kept], axis=1)) < 0.05


def test_points_lie_on_their_rays_and_describe_their_curve():
    found, _, _ = matched(*flat(), count=40)
    points = np.random.default_rng(5).uniform(25, np.array(SIZE) - 25, (40, 2))
    back = LEFT.project(found.xyz_mm)
    apart = np.linalg.norm(points[:, None] - back[None], axis=2).min(axis=0)
    assert apart.max() < 1e-6
    assert np.linalg.norm(found.epipolar, axis=1) == pytest.approx(np.ones(len(back)), abs=1e-12)
    further = RIGHT.project(found.xyz_mm + 0.1 * (found.xyz_mm - LEFT.centre_mm) / 900)
    direction = further - RIGHT.project(found.xyz_mm)
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    assert np.einsum("ni,ni->n", direction, found.epipolar).min() > 0.999


def test_a_calibration_that_is_off_shows_beside_the_curve():
    scene, images = flat()
    pose = RIGHT.camera_from_world
    moved = Camera(
        "right",
        SIZE,
        np.add(RIGHT.matrix_px, [[0, 0, 0], [0, 0, 0.3], [0, 0, 0]]),
        pose,
        RIGHT.distortion,
    )
    points = np.random.default_rng(2).uniform(60, np.array(SIZE) - 60, (40, 2))
    xyz, _ = seen_points(LEFT, scene, points)
    found = match_windows(Pencil.of(LEFT, moved), images, no_edges(images), points, VOLUME)
    # the true camera sees the points 0.3 px higher than the one that is believed
    assert np.median(np.linalg.norm(found.xy_px - RIGHT.project(xyz), axis=1)) < 0.06
    assert np.median(np.linalg.norm(found.xy_px - moved.project(found.xyz_mm), axis=1)) == (
        pytest.approx(0.3, abs=0.05)
    )


def test_two_depths():
    scene = [plane(seed=3), plane(z=25.0, half=18.0, seed=4)]
    found, error, _ = matched(scene, count=120)
    kept = found.flags == 0
    assert kept.mean() > 0.9  # measured 0.96
    assert (np.abs(error[kept]) < 0.5).all()  # also those whose window straddles the step


def test_hidden_points_are_not_made_up():
    scene = [plane(z=-40.0, seed=3), plane(z=40.0, half=12.0, half_y=200.0, seed=4)]
    images = pictures(scene)
    points = np.random.default_rng(7).uniform(25, np.array(SIZE) - 25, (400, 2))
    xyz, _ = seen_points(LEFT, scene, points)
    hidden = ~visible(RIGHT, scene, xyz)
    assert hidden.sum() > 20
    found = match_windows(PENCIL, images, no_edges(images), points[hidden], VOLUME)
    assert (found.flags == 0).mean() < 0.1  # measured 0.03


def test_repeated_texture_is_ambiguous():
    # a pattern that repeats every 12 px along the rows, on a plane across the axes
    x = np.arange(SIZE[0])
    row = 110 + 40 * np.sin(2 * np.pi * x / 12)
    column = 10 * np.sin(2 * np.pi * np.arange(SIZE[1]) / 9)
    image = (row[None, :] + column[:, None]).astype(np.float32)
    noise = np.random.default_rng(0).normal(0, 1, (2, *image.shape)).astype(np.float32)
    pair = (np.rint(image + noise[0]), np.rint(image + noise[1]))
    matrix = np.array([[1000.0, 0, 120], [0, 1000, 95], [0, 0, 1]])
    cameras = [
        Camera(name, SIZE, matrix, RigidTransform(np.eye(3), np.array([shift, 0.0, 0.0])))
        for name, shift in (("a", 0.0), ("b", -100.0))
    ]
    points = np.random.default_rng(1).uniform([110, 30], [220, 160], (30, 2))
    volume = [[-np.inf, -np.inf, 1000.0], [np.inf, np.inf, 2000.0]]  # 50 to 100 px of disparity
    found = match_windows(Pencil.of(*cameras), pair, no_edges(pair), points, volume)
    assert (found.flags & int(Flag.ambiguous) != 0).mean() > 0.9
    assert (found.flags == 0).sum() == 0


def test_a_plain_face_is_matched_by_the_edges_around_it():
    # turned: an edge along the rows of rays that make the picture would be off by a sixth of a px
    top = TexturedPlane(
        np.array([0.0, 0.0, 20.0]),
        turn(2, 17) @ [22.0, 0, 0],
        turn(2, 17) @ [0, 18.0, 0],
        1.0,
        160.0,
        0.0,
        1,
    )
    scene = [plane(contrast=0.0, grey=60.0), top]
    images = pictures(scene)
    centre = LEFT.project([[0.0, 0.0, 20.0], [8.0, -6.0, 20.0]])
    found = match_windows(PENCIL, images, edges_of(images), centre, VOLUME)
    assert found.flags.tolist() == [0, 0]
    assert found.xyz_mm[:, 2] == pytest.approx([20.0, 20.0], abs=0.05)  # measured 0.01 mm
    assert (found.std_px < 0.1).all()
    # a point of the plain ground beside it is not
    beside = LEFT.project([[45.0, 5.0, 0.0]])
    ground = match_windows(PENCIL, images, edges_of(images), beside, VOLUME)
    assert ground.flags[0] != 0


def test_a_blank_image_gives_no_match():
    blank = [np.full(SIZE[::-1], 90, np.float32)] * 2
    noisy = tuple(
        np.rint(image + np.random.default_rng(k).normal(0, 2, image.shape)).astype(np.float32)
        for k, image in enumerate(blank)
    )
    for images in (tuple(blank), noisy):
        found = match_windows(PENCIL, images, no_edges(images), [[120.0, 95.0]], VOLUME)
        assert found.flags.tolist() == [int(Flag.no_edge)]
        assert np.isnan(found.xyz_mm).all()


def test_saturated_windows_are_flagged():
    found, _, _ = matched([plane(contrast=70.0, grey=200.0)], count=60)
    assert (found.flags & int(Flag.saturated) != 0).mean() > 0.9


def test_points_without_a_search_have_their_reason():
    _, images = flat()
    points = [[-5.0, 10.0], [120.0, 300.0], [np.nan, 3.0], [120.0, 95.0]]
    found = match_windows(PENCIL, images, no_edges(images), points, VOLUME)
    assert found.flags[0] & int(Flag.outside_image)
    assert found.flags[1] & int(Flag.outside_image)
    assert found.flags[2] & int(Flag.not_found)
    assert found.flags[3] == 0
    assert np.isnan(found.xyz_mm[:3]).all()
    behind = [[-np.inf, -np.inf, 2000.0], [np.inf, np.inf, 3000.0]]
    hidden = match_windows(PENCIL, images, no_edges(images), points[3:], behind)
    assert hidden.flags[0] != 0
    assert np.isnan(hidden.xyz_mm).all()


def test_swapped_images_keep_nothing():
    # the second camera is rolled: in a pair that is its own mirror image no swap can be told
    scene = [plane()]
    pose = RIGHT.camera_from_world
    roll = turn(2, 20.0)
    rolled = Camera(
        "rolled",
        SIZE,
        RIGHT.matrix_px,
        RigidTransform(roll @ pose.rotation, roll @ pose.translation_mm),
        RIGHT.distortion,
    )
    images = tuple(
        render_planes(c, scene, noise=2.0, seed=k).astype(np.float32)
        for k, c in enumerate((LEFT, rolled))
    )
    points = np.random.default_rng(5).uniform(60, np.array(SIZE) - 60, (40, 2))
    pencil = Pencil.of(LEFT, rolled)
    right = match_windows(pencil, images, no_edges(images), points, VOLUME)
    swapped = match_windows(pencil, images[::-1], no_edges(images), points, VOLUME)
    assert (right.flags == 0).mean() > 0.9
    assert (swapped.flags == 0).mean() < 0.1


def test_no_points_and_no_difference_between_runs():
    _, images = flat()
    edges = no_edges(images)
    assert len(match_windows(PENCIL, images, edges, np.zeros((0, 2)), VOLUME).flags) == 0
    points = np.random.default_rng(3).uniform(40, 150, (30, 2))
    first, second = (match_windows(PENCIL, images, edges, points, VOLUME) for _ in range(2))
    assert np.array_equal(first.xy_px, second.xy_px, equal_nan=True)
    assert np.array_equal(first.std_px, second.std_px, equal_nan=True)


def test_a_fixed_window_is_kept_to():
    scene, images = flat()
    small, error_small, _ = matched(scene, images=images, half_width_px=6, count=60)
    large, error_large, _ = matched(scene, images=images, half_width_px=18, count=60)
    assert set(small.half_width_px.tolist()) == {6.0}
    assert np.std(error_large) < 0.6 * np.std(error_small)
    assert np.median(large.std_px) < 0.6 * np.median(small.std_px)


def test_mistakes_are_named():
    _, images = flat()
    edges = no_edges(images)
    with pytest.raises(InputError, match=r"'right'.*190 rows of 240"):
        match_windows(PENCIL, (images[0], images[1][:-1]), edges, [[1.0, 1.0]], VOLUME)
    with pytest.raises(InputError, match="windows of 2 px"):
        match_windows(PENCIL, images, edges, [[1.0, 1.0]], VOLUME, half_width_px=2)
    with pytest.raises(InputError, match="windows of 200 px"):
        match_windows(PENCIL, images, edges, [[1.0, 1.0]], VOLUME, half_width_px=200)
    with pytest.raises(InputError, match="uncertainty of epipolar"):
        match_windows(PENCIL, images, edges, [[1.0, 1.0]], VOLUME, epipolar_px=0.0)


def test_real_speckle_agrees_with_another_program(shared):
    folder = shared / "data" / "dice-gt4-stereo"
    document = json.loads((folder / "calibration.json").read_text(encoding="utf-8"))
    cameras = [
        Camera(
            str(c["id"]),
            tuple(c["image_size"]),
            np.array([[c["fx"], c["skew"], c["cx"]], [0, c["fy"], c["cy"]], [0, 0, 1]]),
            RigidTransform(
                turn(2, c["gamma_deg"]) @ turn(1, c["beta_deg"]) @ turn(0, c["alpha_deg"]),
                np.array([c["tx"], c["ty"], c["tz"]]),
            ),
            BrownIdeal(k1=c["k1"], k2=c["k2"], k3=c["k3"]),
        )
        for c in document["cameras"]
    ]
    gold = np.genfromtxt(folder / "matches.csv", delimiter=",", names=True)[::3]
    images = tuple(
        cv2.imread(str(folder / f"gt4_cam{k}.png"), cv2.IMREAD_GRAYSCALE).astype(np.float32)
        for k in (0, 1)
    )
    small = np.zeros((40, 40), np.uint8)
    nothing = tuple(find_edges(small) for _ in range(2))
    volume = [[-np.inf, -np.inf, -430.0], [np.inf, np.inf, -310.0]]
    points = np.column_stack([gold["x0"], gold["y0"]])
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        found = match_windows(Pencil.of(*cameras), images, nothing, points, volume)
    apart = found.xy_px - np.column_stack([gold["x1"], gold["y1"]])
    kept = found.flags == 0
    assert kept.mean() > 0.9  # measured 0.97; two of all 123 points lie outside of the other image
    assert np.median(np.linalg.norm(apart[kept], axis=1)) < 0.05  # measured 0.017 px
    assert np.linalg.norm(apart[kept], axis=1).max() < 1.0
