"""Whole targets in whole images: rows, names, flags, warnings."""

from __future__ import annotations

import csv
from collections import defaultdict

import cv2
import numpy as np
import pytest

from closerange.errors import CloseRangeWarning, DetectionError
from closerange.features.detect import detect_target
from closerange.features.target import Charuco, Chessboard, DiscGrid, Target
from closerange.flags import Flag
from closerange.images.frame import Frame

PLAIN = Target.of(DiscGrid(3, 3, (45, 45), 16))
MARKED = Target.of(
    DiscGrid(9, 12, (10, 10), 5.8, "dark-on-white", mark_discs=((6, 3, 8), (6, 8, 8), (2, 3, 8)))
)


def truth_of(folder):
    """Ellipse centres by image and target number."""
    images = defaultdict(dict)
    with (folder / "targets.csv").open() as stream:
        for row in csv.DictReader(stream):
            place = (float(row["u_ellipse"]), float(row["v_ellipse"]))
            images[row["image"]][int(row["target"])] = place
    return images


def frame_of(path):
    return Frame("left", cv2.imread(str(path), cv2.IMREAD_GRAYSCALE), source=path.name)


@pytest.mark.parametrize(
    ("name", "target", "images", "row"),
    [
        ("A_calib_discs", PLAIN, 7, lambda k: k),
        (
            "B_calib_discs_black",
            Target.of(DiscGrid(3, 3, (45, 45), 14, "dark-on-white")),
            5,
            lambda k: k,
        ),
        # this set counts its rows from the bottom
        ("A_calib_grid", MARKED, 2, lambda k: (8 - k // 12) * 12 + k % 12),
    ],
)
def test_rendered_targets_are_found_and_named(shared, name, target, images, row):
    folder = shared / "data" / "rendered" / name
    truth = truth_of(folder)
    for image in sorted(truth)[:: max(1, len(truth) // images)][:images]:
        points = detect_target(frame_of(folder / image), target)
        assert points.point == target.point
        assert points.found.all()
        assert not points.flags.any()
        error = [points.xy_px[row(k)] - place for k, place in truth[image].items()]
        assert len(error) == len(target)
        # the next disc is 27 px away or more; centres are good to hundredths of a pixel
        assert np.abs(error).max() < 0.1, (image, np.abs(error).max())


def test_single_discs_in_crops(shared):
    folder = shared / "data" / "rendered" / "A_verify" / "single"
    target = Target.of(DiscGrid(1, 1, (20, 20), 10))
    truth = truth_of(folder)
    with (folder / "crops.csv").open() as stream:
        rows = list(csv.DictReader(stream))[::45]
    for row in rows:
        points = detect_target(frame_of(folder / row["image"]), target)
        place = points.shifted([float(row["x0"]), float(row["y0"])]).xy_px[0]
        assert np.abs(place - truth[row["image"].rsplit("_", 1)[0]][0]).max() < 0.05


def drawn(target, *, scale=4.0, size=(640, 512), shift=(0.0, 0.0), low=40.0, high=190.0, blur=0.8):
    """Face-on view of white discs on dark ground, drawn 8 times finer and averaged."""
    fine = np.full((size[1] * 8, size[0] * 8), low, np.float32)
    for (x, y, _), diameter in zip(target.xyz_mm, target.diameters_mm, strict=True):
        centre = (np.array([x, -y]) * scale + np.array(size) / 2 + shift + 0.5) * 8 - 0.5
        radius = diameter / 2 * scale * 8
        fixed = tuple(round(value * 16) for value in centre)
        cv2.circle(fine, fixed, round(radius * 16), high, -1, cv2.LINE_8, 4)
    image = cv2.GaussianBlur(cv2.resize(fine, size, interpolation=cv2.INTER_AREA), (0, 0), blur)
    image += np.random.default_rng(0).normal(0, 1.0, image.shape)
    return np.clip(np.rint(image), 0, 255).astype(np.uint8)


def test_rows_carry_names_sizes_and_diameters():
    grid = Target.of(DiscGrid(3, 3, (45, 45), 16, mark_discs=((0, 1, 22.0),)))
    points = detect_target(Frame("c.1", drawn(grid)), grid, placement="p 7", reading="02")
    assert set(points.camera) == {"c.1"}
    assert set(points.placement) == {"p 7"}
    assert set(points.reading) == {"02"}
    assert points.size_px == {"c.1": (640, 512)}
    assert points.disc_diameter_mm.tolist() == [16.0, 22.0] + [16.0] * 7
    expected = grid.xyz_mm[:, :2] * [4, -4] + [320, 256]
    assert np.abs(points.xy_px - expected).max() < 0.05
    assert np.abs(points.ellipse[:, 0] / (2 * grid.diameters_mm) - 1).max() < 0.02
    assert (np.linalg.eigvalsh(points.cov_px2) > 0).all()
    assert (np.linalg.eigvalsh(points.noise_cov_px2) > 0).all()


def test_border_centroids_state_no_noise():
    points = detect_target(Frame("a", drawn(PLAIN)), PLAIN, estimator="border-centroid")
    assert np.isfinite(points.cov_px2).all()
    assert np.isnan(points.noise_cov_px2).all()


def test_a_missing_inner_disc_is_a_row_without_position():
    image = drawn(PLAIN)
    image[200:312, 264:376] = 40
    points = detect_target(Frame("a", image), PLAIN)
    assert points.point == PLAIN.point
    assert points.flags[4] == Flag.not_found
    assert np.isnan(points.xy_px[4]).all()
    assert np.isnan(points.cov_px2[4]).all()
    assert np.isnan(points.noise_cov_px2[4]).all()
    assert points.found.sum() == 8
    assert not np.delete(points.flags, 4).any()


def test_a_disc_cut_by_the_border_is_dropped_with_a_warning():
    with pytest.warns(CloseRangeWarning, match=r"plate\.png: 3 of 9 points are cut") as caught:
        points = detect_target(
            Frame("a", drawn(PLAIN, shift=(128.0, 0.0)), source="plate.png"), PLAIN
        )
    assert len(caught) == 1
    cut = np.array([False, False, True] * 3)
    assert ((points.flags & Flag.at_border) != 0).tolist() == cut.tolist()
    assert points.found.tolist() == (~cut).tolist()


def test_saturation_above_one_percent_flags_every_row():
    with pytest.warns(CloseRangeWarning, match="saturated, the limit is 1%"):
        points = detect_target(Frame("a", drawn(PLAIN, high=300.0)), PLAIN)
    assert ((points.flags & Flag.saturated) != 0).all()
    assert points.found.all()


def test_blur_is_one_warning():
    soft = drawn(PLAIN, scale=1.0, blur=5.0)
    with pytest.warns(CloseRangeWarning, match="points are blurred; focus the lens") as caught:
        points = detect_target(Frame("a", soft), PLAIN)
    assert len(caught) == 1
    assert ((points.flags & Flag.blurred) != 0).any()
    assert points.found.all()


@pytest.mark.parametrize(
    "target",
    [
        PLAIN,
        MARKED,
        Target.of(Chessboard(6, 9, 25)),
        Target.of(Charuco(4, 5, 54, 40, "DICT_4X4_50")),
    ],
    ids=lambda target: target.kind,
)
def test_an_even_image_holds_no_target(target):
    frame = Frame("a", np.full((240, 320), 128, np.uint8), source="grey.png")
    with pytest.raises(DetectionError, match=r"grey\.png") as caught:
        detect_target(frame, target)
    assert caught.value.message.count("grey.png") == 1
    assert caught.value.remedy


def test_points_without_pattern_are_refused_with_the_way_out():
    target = Target.of_points(("a",), [[0, 0, 0]])
    with pytest.raises(DetectionError, match="no pattern") as caught:
        detect_target(Frame("a", np.zeros((20, 20), np.uint8)), target)
    assert "points table" in caught.value.remedy


def test_a_real_chessboard_becomes_rows(shared):
    path = shared / "data" / "opencv-stereo-chessboard" / "left01.jpg"
    points = detect_target(frame_of(path), Target.of(Chessboard(6, 9, 25)), placement="01")
    assert points.found.all()
    assert points.point[9] == "r1c0"
    assert np.isnan(points.ellipse).all()
    assert np.isnan(points.disc_diameter_mm).all()
