"""Parts of the window matcher against exact projection, finite differences and brute force."""

import numpy as np
import pytest

from closerange.matching.pencil import Pencil
from closerange.matching.window_images import clipped_share, pyramid, saturation
from closerange.matching.window_information import HALF_WIDTHS, Information, chosen_sizes
from closerange.matching.window_mapping import WindowMapping
from closerange.matching.window_planes import SeedRays, segment_warps, tilt_hypotheses
from closerange.matching.window_scores import grid, independent_values, scores, shape_weights
from closerange.matching.window_texture import refining_scale
from closerange.rig.distortion import BrownIdeal
from closerange.verification.scenes import looking_at_origin


def cameras(size=(280, 220), angle=0.22):
    return [
        looking_at_origin(
            name,
            angle_rad=turn,
            distance_mm=900.0,
            focal_px=1700.0,
            distortion=BrownIdeal(k1=-0.2, p1=0.001),
            size_px=size,
        )
        for name, turn in (("left", -angle), ("right", angle))
    ]


LEFT, RIGHT = cameras()
PENCIL = Pencil.of(LEFT, RIGHT)
POINTS = np.array([[140.3, 110.8], [60.0, 50.5], [220.9, 170.1]])
TILT = np.array([[0.0, 0.0], [0.5, -0.3], [-0.7, 0.4]])


def through_plane(xyz, normal, pixels):
    """Carry pixels through the plane with a normal through a point, by plain geometry."""
    ray = LEFT.directions(pixels)
    way = ((xyz - LEFT.centre_mm) @ normal) / (ray @ normal)
    return RIGHT.project(LEFT.centre_mm + way[:, None] * ray)


def normals():
    # the sweep axis is Z, the line between the cameras runs along X
    along = (RIGHT.centre_mm - LEFT.centre_mm) * [1, 1, 0]
    along /= np.linalg.norm(along)
    return np.array([0, 0, 1.0]) + TILT @ np.stack([along, np.cross([0, 0, 1.0], along)])


def test_planes_are_linear_in_the_inverse_of_the_depth():
    rays = SeedRays.of(PENCIL, POINTS)
    omega = 1 / np.array([880.0, 900.0, 930.0])
    assert LEFT.depth_mm(rays.at(omega)) == pytest.approx(1 / omega)
    assert LEFT.project(rays.at(omega)) == pytest.approx(POINTS, abs=1e-8)
    step = 1e-7
    numeric = (RIGHT.project(rays.at(omega + step)) - RIGHT.project(rays.at(omega - step))) / (
        2 * step
    )
    assert rays.pace(omega) == pytest.approx(numeric, rel=1e-4)


def test_slopes_and_warps_follow_the_plane():
    rays = SeedRays.of(PENCIL, POINTS)
    omega = 1 / np.array([880.0, 900.0, 930.0])
    xyz = rays.at(omega)
    warps = segment_warps(rays, omega[:, None], np.ones(3, np.int64), TILT)[:, 0]
    slope = rays.slope(omega, TILT)
    for row, normal in enumerate(normals()):
        pixels = POINTS[row] + np.array([[1.0, 0], [-1, 0], [0, 1], [0, -1]])
        there = through_plane(xyz[row], normal, pixels)
        numeric = np.column_stack([there[0] - there[1], there[2] - there[3]]) / 2
        assert warps[row, row] == pytest.approx(numeric, abs=2e-4)
        ray = LEFT.directions(pixels)
        way = ((xyz[row] - LEFT.centre_mm) @ normal) / (ray @ normal)
        depth = LEFT.depth_mm(LEFT.centre_mm + way[:, None] * ray)
        change = np.array([1 / depth[0] - 1 / depth[1], 1 / depth[2] - 1 / depth[3]]) / 2
        assert slope[row] == pytest.approx(change, rel=2e-3, abs=1e-9)


@pytest.mark.parametrize("scale", [1, 2])
def test_the_mapping_of_a_window_is_exact_to_a_thousandth_of_a_pixel(scale):
    rays = SeedRays.of(PENCIL, POINTS)
    omega = 1 / np.array([880.0, 900.0, 930.0])
    mapping = WindowMapping.of(rays, 20, scale)
    pace = np.linalg.norm(rays.pace(omega), axis=1)
    # slopes per ideal px, so that the whole window lies on one plane: fitted to its nodes
    slope = np.empty((3, 2))
    for row, normal in enumerate(normals()):
        ray = mapping.node_ray[row]
        nodes = (ray @ normal) / ((rays.at(omega)[row] - LEFT.centre_mm) @ normal)
        slope[row] = np.linalg.lstsq(mapping.away[row], nodes - omega[row], rcond=None)[0]
        assert mapping.away[row] @ slope[row] + omega[row] == pytest.approx(nodes, rel=1e-9)
    place, back = (
        part.transpose(0, 2, 1).astype(float)
        for part in mapping.apply(omega, slope, pace, np.tile([0.0, 1.0], (3, 1)))[:2]
    )
    affine_misses = 0.0
    for row, normal in enumerate(normals()):
        pixels = (mapping.corner[row] + mapping.offset) * float(scale)
        true = through_plane(rays.at(omega)[row], normal, pixels)
        assert np.abs(place[row] * scale - true).max() < (2e-3 if scale == 1 else 2e-2)
        linear = np.column_stack([np.ones(len(pixels)), mapping.offset])
        rest = true - linear @ np.linalg.lstsq(linear, true, rcond=None)[0]
        affine_misses = max(affine_misses, np.abs(rest).max())
    assert affine_misses > 0.05  # what parabolas are for
    # a step `back` in the first view does what a shift of 1 px along the curve does
    moved, _, _ = mapping.apply(omega + 0.1 / pace, slope, pace, np.tile([0.0, 1.0], (3, 1)))
    moved = moved.transpose(0, 2, 1)
    side = 41
    for row in range(3):
        by_x = np.gradient(place[row].reshape(side, side, 2), axis=1).reshape(-1, 2)
        by_y = np.gradient(place[row].reshape(side, side, 2), axis=0).reshape(-1, 2)
        made = by_x * back[row][:, :1] + by_y * back[row][:, 1:]
        assert (moved[row] - place[row]) / 0.1 == pytest.approx(made, abs=2e-2)


def test_tilts_are_tried_only_where_they_matter():
    omega = np.full(3, 1 / 900.0)
    assert len(tilt_hypotheses(SeedRays.of(PENCIL, POINTS), omega, 5)) == 9
    near = cameras(angle=0.01)
    assert len(tilt_hypotheses(SeedRays.of(Pencil.of(*near), POINTS), omega, 5)) == 1


def test_scores_are_correlations():
    rng = np.random.default_rng(0)
    first = rng.normal(100, 20, (220, 280)).astype(np.float32)
    second = rng.normal(100, 20, (220, 280)).astype(np.float32)
    rays = SeedRays.of(PENCIL, POINTS.round())
    omega = np.full((3, 2), 1 / 900.0)
    omega[:, 1] = np.nan
    likely, _ = scores(rays, omega, (first, second), 1, np.zeros((1, 2)))
    assert np.isneginf(likely[:, 1]).all()
    weights = shape_weights(grid(), 2.5)
    warp = segment_warps(rays, omega[:, :1], np.ones(3, np.int64), np.zeros((1, 2)))[:, 0, 0]
    for row in range(3):
        x, y = POINTS.round().astype(int)[row]
        here = first[y - 5 : y + 6, x - 5 : x + 6].ravel().astype(float)
        place = RIGHT.project(rays.at(omega[:, 0]))[row] + grid() @ warp[row].T
        low = np.floor(place).astype(int)
        part = place - low
        there = sum(
            second[low[:, 1] + j, low[:, 0] + i]
            * (part[:, 0] if i else 1 - part[:, 0])
            * (part[:, 1] if j else 1 - part[:, 1])
            for i in (0, 1)
            for j in (0, 1)
        )
        for shape, weight in enumerate(weights):
            cov = np.cov(here, there, aweights=weight)
            rho = cov[0, 1] / np.sqrt(cov[0, 0] * cov[1, 1])
            expected = -0.5 * independent_values(weights)[shape] * np.log(1 - rho * abs(rho))
            # OpenCV before 5 interpolates in steps of 1/32 px
            assert likely[row, 0, shape] == pytest.approx(expected, abs=0.15)


def test_halves_are_halves():
    x, y = grid().T
    whole, core, right, left, below, above = shape_weights(grid(), 2.5)
    assert right + left == pytest.approx(whole)
    assert below + above == pytest.approx(whole)
    assert (right[x > 1] > 0.85 * whole[x > 1]).all()
    assert (above[y > 1] < 0.15 * whole[y > 1]).all()
    assert (core <= whole + 1e-12).all()


def test_information_predicts_the_scatter_of_shifts():
    # a row of sinusoids in noise: the least-squares shift has the variance that information says
    rng = np.random.default_rng(1)
    x = np.arange(200)
    clean = np.tile(100 + 12 * np.sin(2 * np.pi * x / 20), (200, 1))
    noisy = (clean + rng.normal(0, 2, clean.shape)).astype(np.float32)
    told = Information.of(noisy, np.array([[100.0, 100.0]]), (20,)).along(np.array([[1.0, 0.0]]))
    slope = 12 * 2 * np.pi / 20 * np.cos(2 * np.pi * x / 20)
    weight = np.exp(-((x - 100) ** 2) / 200)[:, None] * np.exp(-((x - 100) ** 2) / 200)[None, :]
    expected = (weight * slope**2).sum() / 4
    assert told[0, 0] == pytest.approx(expected, rel=0.15)
    across = Information.of(noisy, np.array([[100.0, 100.0]]), (20,)).along(np.array([[0.0, 1.0]]))
    assert across[0, 0] < 0.02 * told[0, 0]


def test_sizes_follow_the_texture():
    width = np.array(HALF_WIDTHS, float)[:, None]
    even = np.array([[200.0, 20.0, 1.0, 0.01]]) * width**2
    chosen = chosen_sizes(even, HALF_WIDTHS)
    # noise 1 / (root(info) h) px falls, 0.003 h px grows: they meet at h = root(333 / root(info))
    assert [HALF_WIDTHS[k] if k >= 0 else 0 for k in chosen] == [5, 10, 20, 0]
    # a border that comes into view at 28 px is no texture, unless its half holds it too
    rim = np.where(width >= 20, 5000.0, 0.5)
    assert HALF_WIDTHS[chosen_sizes(rim, HALF_WIDTHS)[0]] == 40
    rim = np.where(width >= 28, 5000.0, 0.5)
    assert chosen_sizes(rim, HALF_WIDTHS)[0] == -1
    assert chosen_sizes(even[:1] / 25 * 5.0, (5,), 0.5).tolist() == [0, 0, 0, -1]


def test_large_windows_are_refined_in_smaller_images():
    assert [refining_scale(width) for width in (5, 20, 21, 28, 40, 41, 80)] == [1, 1, 2, 2, 2, 4, 4]


def test_pyramids_keep_places():
    y, x = np.mgrid[:64, :96].astype(np.float32)
    levels = pyramid([x + 3 * y], 2)
    assert [level.shape for level in levels] == [(64, 96), (32, 48), (16, 24)]
    assert levels[2][5, 7] == pytest.approx(4 * 7 + 3 * 4 * 5, abs=1e-3)


def test_clipped_pixels_are_counted():
    grey = np.full((50, 60), 100, np.float32)
    assert saturation(grey) == np.inf
    grey[20:30, 20:30] = 255
    assert saturation(grey) == 255
    share = clipped_share(grey, np.array([[24.0, 24.0], [50.0, 10.0]]), np.array([2.0, 5.0]))
    assert share.tolist() == [1.0, 0.0]
    assert saturation(np.full((4, 4), 4095, np.float32)) == 4095
