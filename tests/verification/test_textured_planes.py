"""Rendered planes: their pictures against geometry and each other."""

import numpy as np
import pytest

from closerange.rig.distortion import BrownIdeal
from closerange.verification.scenes import looking_at_origin
from closerange.verification.textured_planes import (
    TexturedPlane,
    render_planes,
    seen_points,
    visible,
)


def camera(angle=0.2):
    return looking_at_origin(
        "c",
        angle_rad=angle,
        distance_mm=900.0,
        focal_px=700.0,
        distortion=BrownIdeal(k1=-0.1),
        size_px=(120, 90),
    )


def plane(z=0.0, half=300.0, grey=100.0, contrast=0.0, seed=1):
    return TexturedPlane(
        np.array([0.0, 0.0, z]),
        np.array([half, 0.0, 0.0]),
        np.array([0.0, half, 0.0]),
        2.0,
        grey,
        contrast,
        seed,
    )


def test_plain_planes_have_their_grey_and_the_nearer_hides():
    picture = render_planes(camera(), [plane(), plane(z=50.0, half=20.0, grey=180.0)])
    assert picture[5, 5] == 100
    near = camera().project([[0.0, 0.0, 50.0]])[0]
    assert picture[round(near[1]), round(near[0])] == 180


def test_gain_offset_and_noise():
    scene = [plane()]
    assert np.all(render_planes(camera(), scene, gain=0.5, offset=20.0) == 70)
    noisy = render_planes(camera(), scene, noise=4.0, seed=3)
    assert np.std(noisy) == pytest.approx(4.0, rel=0.05)
    assert np.array_equal(noisy, render_planes(camera(), scene, noise=4.0, seed=3))


def test_texture_has_its_contrast_and_is_the_same_in_both_views():
    scene = [plane(contrast=20.0)]
    first, second = camera(-0.2), camera(0.2)
    pictures = [render_planes(c, scene, blur_px=0.3) for c in (first, second)]
    assert np.std(pictures[0]) == pytest.approx(20.0, rel=0.25)  # 17 after blur and pixels
    xy = np.random.default_rng(0).uniform(10, [110, 80], (300, 2)).round()
    xyz, number = seen_points(first, scene, xy)
    there = np.rint(second.project(xyz)).astype(int)
    inside = ((there >= 0) & (there < [120, 90])).all(axis=1) & (number == 0)
    here = xy[inside].astype(int)
    there = there[inside]
    pair = pictures[0][here[:, 1], here[:, 0]], pictures[1][there[:, 1], there[:, 0]]
    # rounding to whole pixels of 1.3 mm leaves this much of a texture with 2 mm grains
    assert np.corrcoef(*pair)[0, 1] > 0.9


def test_points_seen_lie_on_their_ray_and_plane():
    scene = [plane(), plane(z=50.0, half=20.0)]
    xy = np.array([[5.0, 5.0], [60.0, 44.5], [np.nan, 0.0]])
    xyz, number = seen_points(camera(), scene, xy)
    assert number.tolist() == [0, 1, -1]
    assert xyz[:2, 2] == pytest.approx([0.0, 50.0], abs=1e-9)
    assert camera().project(xyz[:2]) == pytest.approx(xy[:2], abs=1e-6)
    assert np.isnan(xyz[2]).all()


def test_visibility():
    scene = [plane(), plane(z=50.0, half=20.0)]
    points = np.array([[0.0, 0.0, 0.0], [0.0, 0.0, 50.0], [100.0, 0.0, 0.0]])
    assert visible(camera(0.0), scene, points).tolist() == [False, True, True]
