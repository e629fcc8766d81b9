"""Foreign, exchanged and scaled images: said, with the reason where one is found."""

from __future__ import annotations

import warnings
from dataclasses import replace

import numpy as np
import pytest

from closerange.errors import CloseRangeWarning
from closerange.position.measure import measure_points
from closerange.position.suspicion import DoubtWarning
from closerange.verification.scenes import (
    SyntheticRig,
    looking_at_origin,
    observe,
    random_positions,
    rig_a,
    rig_b,
)

COUNT = 90


def three_cameras():
    pair = rig_b()
    third = looking_at_origin("third", angle_rad=0.05, distance_mm=360.0, focal_px=1300.0)
    return SyntheticRig("three", (*pair.cameras, third), pair.volume_mm, 0.05)


def seen(scene):
    """Return image points as a table holds them: without the size of their images."""
    rng = np.random.default_rng(8)
    truth = random_positions(COUNT, scene.volume_mm, rng)
    points = observe(scene.cameras, truth, noise_px=0.05, rng=rng)
    return replace(points, size_px={})


def renamed(points, **names):
    return replace(points, camera=tuple(names.get(name, name) for name in points.camera))


def scaled(points, factor):
    return replace(points, xy_px=(points.xy_px + 0.5) * factor - 0.5)


SCENES = {"A": rig_a, "B": rig_b, "three": three_cameras}


@pytest.mark.parametrize("name", SCENES)
def test_right_images_draw_no_doubt(name):
    scene = SCENES[name]()
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert measure_points(scene.true_rig(), seen(scene)).doubt == ""


@pytest.mark.parametrize("name", SCENES)
def test_exchanged_cameras_are_found_out(name):
    scene = SCENES[name]()
    points = renamed(seen(scene), left="right", right="left")
    with pytest.warns(DoubtWarning, match="'left' as 'right', 'right' as 'left', 90 of 90") as told:
        positions = measure_points(scene.true_rig(), points)
    assert positions.doubt == str(told[0].message)
    assert np.isfinite(positions.xyz_mm).all()  # the table is written all the same


def test_cameras_exchanged_in_a_ring_are_found_out():
    scene = three_cameras()
    points = renamed(seen(scene), left="right", right="third", third="left")
    with pytest.warns(DoubtWarning, match=r"'left' as 'third'.*90 of 90 points fit"):
        measure_points(scene.true_rig(), points)


@pytest.mark.parametrize(("factor", "said"), [(0.5, "times 2,"), (0.25, "times 4,")])
def test_images_of_another_size_are_found_out(factor, said):
    scene = rig_b()
    with pytest.warns(DoubtWarning, match=f"another size: with x_px, y_px {said} 90 of 90"):
        measure_points(scene.true_rig(), scaled(seen(scene), factor))


def test_foreign_images_are_grave_without_an_explanation():
    """Each point is paired with its neighbour in the table."""
    scene = rig_b()
    points = seen(scene)
    xy = points.xy_px.copy()
    xy[COUNT:] = np.roll(xy[COUNT:], 1, axis=0)
    with pytest.warns(DoubtWarning, match=r"rays of \d+ of 90 points.*neither exchanged cameras"):
        assert measure_points(scene.true_rig(), replace(points, xy_px=xy)).doubt


@pytest.mark.parametrize(("bad", "category"), [(17, None), (25, CloseRangeWarning)])
def test_a_minority_of_wrong_pairs_is_a_warning_at_most(bad, category):
    """17 of 90 are below the share that is doubted, 25 above it and below one half."""
    scene = rig_b()
    points = seen(scene)
    xy = points.xy_px.copy()
    xy[COUNT : COUNT + bad, 1] += 20.0
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        positions = measure_points(scene.true_rig(), replace(points, xy_px=xy))
    assert [entry.category for entry in caught] == ([category] if category else [])
    assert positions.doubt == ""
    assert np.count_nonzero(positions.flags) == bad


def test_two_blunders_among_three_points_are_not_enough():
    scene = rig_b()
    points = seen(scene).select([0, 1, 2, COUNT, COUNT + 1, COUNT + 2])
    xy = points.xy_px.copy()
    xy[3:5, 1] += 20.0
    positions = measure_points(scene.true_rig(), replace(points, xy_px=xy))
    assert positions.doubt == ""
