"""Good images that do not belong together: items 11 and 16 to 20 of the list of bad inputs."""

from __future__ import annotations

import shutil

import numpy as np
import pytest


def test_item_11_images_of_different_sizes(refused, looking, good, tmp_path, save, good_image):
    smaller = save(tmp_path / "smaller.png", good[16:-16, 16:-16])
    refused(looking(good_image, smaller), 2, "smaller.png", "640", "608")


def test_item_16_unequal_counts_list_the_orphans(project, run_refused):
    (project / "calibration" / "right_z+00.0.png").unlink()
    run_refused(2, "left 3, right 2", "left_z+00.0.png", "missing in right")


def test_item_17_natural_order_of_image_2_and_image_10(detected, good, tmp_path, save):
    folder = tmp_path / "images"
    folder.mkdir()
    for number in (10, 2, 1):
        save(folder / f"image{number}.png", np.roll(good, number, axis=1))
    _, rows = detected(folder)
    assert [row["placement"] for row in rows[::9]] == ["image1", "image2", "image10"]
    shifts = rows.xy[::9, 0] - rows.xy[0, 0]
    np.testing.assert_allclose(shifts, [0, 1, 9], atol=0.01)


def test_item_18_one_exposure_twice(project, run_refused):
    calibration = project / "calibration"
    shutil.copy(calibration / "left_z+00.0.png", calibration / "left_z+50.0.png")
    run_refused(2, "left_z+00.0.png", "left_z+50.0.png", "identical pixels", "occurs twice")


def test_item_18_one_exposure_twice_for_detect(refused, looking, tmp_path, good_image):
    first = good_image
    again = tmp_path / "again.png"
    shutil.copy(first, again)
    refused(looking(first, again), 2, "again.png", "identical pixels")


def test_item_19_one_image_for_both_cameras(project, run_refused):
    calibration = project / "calibration"
    shutil.copy(calibration / "left_z+00.0.png", calibration / "right_z+00.0.png")
    run_refused(2, "left_z+00.0.png", "right_z+00.0.png", "one image stands for two cameras")


def test_item_20_left_and_right_exchanged_in_one_placement(project, run_refused):
    calibration = project / "calibration"
    left, right = calibration / "left_z+00.0.png", calibration / "right_z+00.0.png"
    left.rename(calibration / "aside.png")
    right.rename(left)
    (calibration / "aside.png").rename(right)
    run_refused(1, "'z+00.0'", "exchanged")


@pytest.mark.parametrize("pattern", ["(", "z.*", "_(q)$", "(?P<reading>z.*)"])
def test_placement_pattern_that_cannot_be_used(refused, looking, pattern, good_image):
    args = [*looking(good_image), "--placement-pattern", pattern]
    refused(args, 2, "placement pattern")


def test_one_placement_name_for_two_images(refused, looking, demo_data):
    images = sorted((demo_data / "calibration").glob("left_*.png"))[:2]
    refused([*looking(*images), "--placement", "here"], 2, "2 images")
