"""The sweep of whole images against brute force and rendered truth; further views; texture."""

from functools import cache

import cv2
import numpy as np
import pytest

from closerange.features.edges import find_edges
from closerange.flags import Flag
from closerange.geometry.transform import RigidTransform
from closerange.matching import window_sweep
from closerange.matching.pencil import Pencil
from closerange.matching.texture import (
    believes_window,
    mostly_texture,
    texture_lines,
    wants_window,
)
from closerange.matching.window_images import ImagePair
from closerange.matching.window_matcher import match_windows
from closerange.matching.window_planes import SeedRays
from closerange.matching.window_search import Search, Spans, swept_level
from closerange.matching.window_smooth import JUMP, SLANT, UNIT, smoothed
from closerange.matching.window_sweep import sweep
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
VOLUME = np.array([[-np.inf, -np.inf, -60.0], [np.inf, np.inf, 60.0]])


def camera(name, degrees, scale=1):
    return looking_at_origin(
        name,
        angle_rad=np.radians(degrees),
        distance_mm=900.0,
        focal_px=1700.0 * scale,
        distortion=BrownIdeal(k1=-0.1),
        size_px=(SIZE[0] * scale, SIZE[1] * scale),
    )


LEFT, RIGHT = camera("left", -8.0), camera("right", 8.0)
PENCIL = Pencil.of(LEFT, RIGHT)


def plane(tilt=0.0, z=0.0, half=200.0, seed=1, grain=1.0):
    turn = cv2.Rodrigues(np.radians(tilt) * np.eye(3)[1])[0]
    return TexturedPlane(
        np.array([0, 0, z]), turn @ [half, 0, 0], turn @ [0, half, 0], grain, 110.0, 25.0, seed
    )


@cache
def pictures(name):
    scene = {
        "flat": [plane()],
        "tilted": [plane(35.0)],
        "step": [plane(seed=3), plane(z=25.0, half=18.0, seed=4)],
    }[name]
    images = tuple(
        np.asarray(render_planes(c, scene, noise=2.0, seed=k), np.float32)
        for k, c in enumerate((LEFT, RIGHT))
    )
    return scene, images


def pixels(step):
    x, y = np.meshgrid(np.arange(20.0, SIZE[0] - 20, step), np.arange(20.0, SIZE[1] - 20, step))
    return np.column_stack([x.ravel(), y.ravel()])


def no_edges(images):
    return tuple(
        find_edges(image.astype(np.uint8)).select(np.zeros(0, np.int64)) for image in images
    )


def least_way(cost):
    """Sum the least costs of all ways that end in each cell of a line, one cell after the other."""
    result = cost.astype(int)
    for line in range(1, len(cost)):
        for plane_ in range(cost.shape[1]):
            before = result[line - 1]
            ways = [before[plane_], before.min() + JUMP]
            ways += [before[p] + SLANT for p in (plane_ - 1, plane_ + 1) if 0 <= p < len(before)]
            result[line, plane_] += min(ways) - before.min()
    return result


def test_smoothing_is_the_least_way_along_rows_and_columns():
    cost = np.random.default_rng(0).integers(0, UNIT + 1, (5, 7, 9)).astype(np.uint8)
    expected = np.zeros(cost.shape, int)
    for column in range(7):
        expected[:, column] += least_way(cost[:, column])
        expected[:, column] += least_way(cost[::-1, column])[::-1]
    for row in range(5):
        expected[row] += least_way(cost[row])
        expected[row] += least_way(cost[row, ::-1])[::-1]
    assert np.array_equal(smoothed(cost), expected)
    # one byte holds every sum: the largest costs go through unharmed
    extreme = np.where(np.arange(9) == 4, 0, UNIT).astype(np.uint8) * np.ones((6, 6, 1), np.uint8)
    assert smoothed(extreme).max() <= 4 * (UNIT + JUMP)


def swept(name, **options):
    scene, images = pictures(name)
    points = pixels(4.0)
    rays = SeedRays.of(PENCIL, points)
    spans = Spans.of(PENCIL, rays, VOLUME)
    pair = ImagePair(images)
    return scene, points, sweep(PENCIL, pair, rays, (spans.low, spans.high), 1, **options)


@pytest.mark.parametrize("name", ["flat", "tilted"])
def test_the_surface_is_swept_to_a_plane_and_a_half(name):
    scene, points, found = swept(name)
    xyz, _ = seen_points(LEFT, scene, points)
    truth = 1 / LEFT.depth_mm(xyz)
    inner = (np.abs(xyz[:, 2]) < 55) & (found.step > 0)
    first = np.abs(found.place[:, 0] - truth)[inner] / found.step
    assert (first < 1.5).mean() > 0.97  # measured 1.0 and 0.98
    any_place = np.nanmin(np.abs(found.place - truth[:, None]), axis=1)[inner] / found.step
    assert (any_place < 1.5).mean() > 0.99
    assert (found.prior.max(axis=1) == 0.0).all()


def test_bands_change_next_to_nothing(monkeypatch):
    _, _, whole = swept("step")
    monkeypatch.setattr(window_sweep, "MOST_CELLS", 60 * 120 * 40)
    _, _, banded = swept("step")
    apart = np.abs(whole.omega - banded.omega) / whole.step
    assert (apart == 0).mean() > 0.95  # measured 0.97
    assert (apart < 1.5).mean() > 0.98


def test_many_points_are_swept_few_are_not_and_both_find_the_same():
    scene, images = pictures("step")
    points = pixels(3.0)
    rays = SeedRays.of(PENCIL, points)
    spans = Spans.of(PENCIL, rays, VOLUME)
    search = Search(PENCIL, ImagePair(images), VOLUME, 0.1)
    assert search.swept(rays, spans).there is not None
    few = np.arange(0, len(points), 60)
    assert search.swept(rays.select(few), spans.select(few)).there is None
    found = match_windows(PENCIL, images, no_edges(images), points, VOLUME)
    alone = match_windows(PENCIL, images, no_edges(images), points[few], VOLUME)
    xyz, _ = seen_points(LEFT, scene, points)
    truth = RIGHT.project(xyz)
    sure = visible(RIGHT, scene, xyz)
    sure &= ((truth > 15) & (truth < np.array(SIZE) - 16)).all(axis=1)
    # blur leaves open on which surface a point within a pixel of a step lies
    number = [seen_points(LEFT, scene, points + step)[1] for step in 1.5 * np.eye(2)]
    number += [seen_points(LEFT, scene, points - step)[1] for step in 1.5 * np.eye(2)]
    sure &= np.ptp(number, axis=0) == 0
    error = np.abs(np.einsum("ni,ni->n", found.xy_px - truth, found.epipolar))
    kept = found.flags == 0
    assert kept[sure].mean() > 0.95  # measured 0.99
    assert (error[sure & kept] < 0.5).mean() > 0.995  # measured 1.0
    assert np.median(error[sure & kept]) < 0.03  # measured 0.02 px
    assert (error[sure & kept] < 1.96 * found.std_px[sure & kept]).mean() > 0.9
    both = kept[few] & (alone.flags == 0) & sure[few]
    assert np.linalg.norm(found.xy_px[few] - alone.xy_px, axis=1)[both].max() < 0.2  # measured 0.12


def repeated(third):
    """Return three views of a pattern that repeats every 12 px; 72 px of disparity in two."""
    x, y = np.meshgrid(np.arange(SIZE[0]), np.arange(SIZE[1]))
    distance = 1000.0 * 100 / 72
    cameras, images = [], []
    for seed, (name, shift) in enumerate((("a", 0.0), ("b", 100.0), ("c", third))):
        matrix = np.array([[1000.0, 0, 120], [0, 1000, 95], [0, 0, 1]])
        pose = RigidTransform(np.eye(3), np.array([-shift, 0.0, 0.0]))
        cameras.append(Camera(name, SIZE, matrix, pose))
        there = x + 1000.0 * shift / distance
        grey = 110 + 40 * np.sin(2 * np.pi * there / 12) + 10 * np.sin(2 * np.pi * y / 9)
        noise = np.random.default_rng(seed).normal(0, 1, grey.shape)
        images.append(np.rint(grey + noise).astype(np.float32))
    return cameras, images, np.array([[-np.inf, -np.inf, 1000.0], [np.inf, np.inf, 2000.0]])


@pytest.mark.parametrize("count", [30, 1500])
def test_a_third_view_tells_which_repeat_is_the_one(count):
    # 137 mm make 98.6 px: another repeat of the second view is no repeat of the third
    cameras, images, volume = repeated(137.0)
    points = np.random.default_rng(1).uniform([125, 30], [220, 160], (count, 2))
    pair, pencil = tuple(images[:2]), Pencil.of(*cameras[:2])
    alone = match_windows(pencil, pair, no_edges(pair), points, volume)
    assert (alone.flags & int(Flag.ambiguous) != 0).mean() > 0.9
    other = [(cameras[2], images[2])]
    found = match_windows(pencil, pair, no_edges(pair), points, volume, others=other)
    right = np.abs(points[:, 0] - found.xy_px[:, 0] - 72) < 1
    assert right.mean() > 0.95  # measured 1.0
    assert (found.flags == 0).mean() > 0.9  # measured 1.0
    # one that sees nothing of it says nothing
    blank = [(cameras[2], np.full_like(images[2], 90.0))]
    silent = match_windows(pencil, pair, no_edges(pair), points[:30], volume, others=blank)
    assert (silent.flags & int(Flag.ambiguous) != 0).mean() > 0.9


def test_windows_follow_the_scale_in_mm():
    widths = []
    for scale in (1, 2):
        cameras = camera("left", -8.0, scale), camera("right", 8.0, scale)
        images = tuple(
            np.asarray(render_planes(c, [plane(grain=2.0)], noise=2.0, seed=k), np.float32)
            for k, c in enumerate(cameras)
        )
        points = scale * (pixels(40.0) + 0.5) - 0.5
        found = match_windows(Pencil.of(*cameras), images, no_edges(images), points, VOLUME)
        assert (found.flags == 0).mean() > 0.9
        widths.append(np.nanmedian(found.half_width_mm))
        depth = LEFT.depth_mm(found.xyz_mm)
        assert found.half_width_mm == pytest.approx(
            found.half_width_px * depth / (1700.0 * scale), rel=1e-9
        )
    # twice the resolution: within the step of one root of two
    assert 1 / 1.5 < widths[1] / widths[0] < 1.5


def test_large_images_are_swept_on_a_coarser_level():
    small, large = (ImagePair((np.zeros((side, side), np.float32),) * 2) for side in (500, 1500))
    assert (swept_level(small), swept_level(large)) == (1, 2)


def test_texture_is_many_edges_of_many_ways():
    rng = np.random.default_rng(2)
    speckle = cv2.GaussianBlur(rng.normal(110, 200, (200, 200)).astype(np.float32), (0, 0), 2.0)
    stripes = np.tile(110 + 60 * np.sin(np.arange(200) / 2.0), (200, 1))
    corner = np.full((200, 200), 60.0)
    corner[100:, 100:] = 160
    told = {}
    for name, image in (("speckle", speckle), ("stripes", stripes), ("corner", corner)):
        told[name] = texture_lines(find_edges(np.clip(image, 0, 255).astype(np.uint8)))
    assert np.median(told["speckle"]) > 5
    assert mostly_texture(told["speckle"])
    assert np.median(told["stripes"]) == 0
    assert told["corner"].max() < 3
    assert not mostly_texture(told["corner"])
    assert not mostly_texture(np.zeros(0))


def test_each_point_is_given_to_the_better_witness():
    lines = np.array([8.0, 8.0, 4.0, 4.0, 1.5, 0.5])
    bad, turned = int(Flag.poor_fit), int(Flag.inconsistent)
    flags = np.array([0, bad, bad, 0, bad, bad])
    assert wants_window(lines, flags, textured=False).tolist() == [1, 1, 1, 0, 0, 0]
    assert wants_window(lines, flags, textured=True).tolist() == [1, 1, 1, 0, 1, 1]
    # a single corner of plain parts is not worth its time
    rare = np.r_[8.0, np.zeros(50)]
    assert not wants_window(rare, np.zeros(51, np.int64), textured=False).any()
    there = np.zeros((6, 2))
    nowhere = np.full((6, 2), np.nan)
    good = np.zeros(6, np.int64)
    assert believes_window(lines, (flags, there), (good, there)).tolist() == [1, 1, 1, 0, 1, 1]
    # both in doubt: on texture the window, elsewhere the one that returns; never no place at all
    doubt, away = np.full(6, bad), np.full(6, turned)
    assert believes_window(lines, (doubt, there), (doubt, there)).all()
    assert believes_window(lines, (doubt, there), (away, there)).tolist() == [1, 1, 0, 0, 0, 0]
    assert believes_window(lines, (away, there), (away, there)).all()
    assert not believes_window(lines, (away, there), (away, nowhere)).any()
    # a lone edge along the epipolar curve is all that its window sees
    open_ = np.full(6, int(Flag.aperture))
    assert believes_window(lines, (open_, there), (good, there)).tolist() == [1, 1, 1, 1, 1, 0]
