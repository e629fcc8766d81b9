"""The verb `detect`, called from Python."""

from __future__ import annotations

import shutil
from importlib.resources import files
from pathlib import Path

import cv2
import numpy as np
import pytest

from closerange.errors import (
    CloseRangeWarning,
    DetectionError,
    InputError,
)
from closerange.features.target import Chessboard, Target
from closerange.images import Frame, read_image
from closerange.workflows.detect import detect, read_crops

DEMO = Path(str(files("closerange.workflows") / "demo_data"))


PLATE, DISC = DEMO / "plate.toml", DEMO / "disc.toml"


HEIGHTS = ("z-50.0", "z+00.0", "z+50.0")


def plate(camera, height):
    return DEMO / f"calibration/{camera}_{height}.png"


def test_a_folder_is_all_of_its_images_in_natural_order(tmp_path):
    for name, height in (("im2.png", "z-50.0"), ("im10.png", "z+00.0"), ("im1.png", "z+50.0")):
        shutil.copy(plate("left", height), tmp_path / name)
    (tmp_path / "notes.txt").write_text("no image", encoding="utf-8")
    seen = []
    points = detect(tmp_path, target=PLATE, camera="left", progress=lambda *step: seen.append(step))
    assert tuple(dict.fromkeys(points.placement)) == ("im1", "im2", "im10")
    assert seen == [(1, 3), (2, 3), (3, 3)]
    assert points.size_px == {"left": (640, 512)}
    assert points.found.all()
    # x of the target grows with x of this camera's images, y the other way
    first = points.select(np.arange(9)).xy_px.reshape(3, 3, 2)
    assert (np.diff(first[..., 0], axis=1) > 0).all()
    assert (np.diff(first[..., 1], axis=0) > 0).all()


def test_frames_files_and_folders_may_be_mixed(tmp_path):
    shutil.copy(plate("left", "z+50.0"), tmp_path / "left_z+50.0.png")
    frame = read_image(plate("left", "z-50.0"), camera="left")
    images = [frame, str(plate("left", "z+00.0")), tmp_path]
    points = detect(images, target=PLATE, camera="left", placement_pattern="_(z.*)$")
    assert tuple(dict.fromkeys(points.placement)) == ("z-50.0", "z+00.0", "z+50.0")


def test_the_pattern_names_placement_and_reading():
    images = [DEMO / f"verify/p0{n}_left_r{r}.png" for n in (0, 1) for r in (0, 1)]
    pattern = r"^(p\d+)_left_r(?P<reading>\d+)$"
    points = detect(images, target=DISC, camera="left", placement_pattern=pattern)
    names = list(zip(points.placement, points.reading, strict=True))
    assert names == [("p00", "0"), ("p00", "1"), ("p01", "0"), ("p01", "1")]


def test_one_image_may_be_given_a_placement_name():
    points = detect(plate("left", "z+00.0"), target=PLATE, camera="left", placement="middle")
    assert set(points.placement) == {"middle"}


def test_one_placement_name_for_several_images_is_refused():
    images = [plate("left", height) for height in HEIGHTS]
    with pytest.raises(InputError, match="one placement name for 3 images") as caught:
        detect(images, target=PLATE, camera="left", placement="middle")
    assert "--placement-pattern" in caught.value.remedy


@pytest.mark.parametrize("pattern", ["(", "z", "(nothing)"])
def test_patterns_that_name_no_placement(pattern):
    with pytest.raises(InputError, match="placement pattern"):
        detect(plate("left", "z+00.0"), target=PLATE, camera="left", placement_pattern=pattern)


def test_two_images_of_one_placement_name_the_second(tmp_path):
    for name in ("a_z1.png", "b_z1.png"):
        height = HEIGHTS[name > "b"]
        shutil.copy(plate("left", height), tmp_path / name)
    with pytest.raises(InputError, match=r"b_z1\.png: .*appears twice"):
        detect(tmp_path, target=PLATE, camera="left", placement_pattern="_(z1)$")


def test_the_same_exposure_twice_is_refused(tmp_path):
    for name in ("a.png", "b.png"):
        shutil.copy(plate("left", "z+00.0"), tmp_path / name)
    with pytest.raises(InputError, match=r"b\.png"):
        detect(tmp_path, target=PLATE, camera="left")


def test_no_image_at_all():
    with pytest.raises(InputError, match="no image was named"):
        detect([], target=PLATE, camera="left")


def test_crops_give_positions_in_the_full_image(tmp_path):
    """A crop of an image gives the points of the image, and forgets its own size."""
    whole = detect(plate("left", "z+00.0"), target=PLATE, camera="left", placement="p")
    pixels = read_image(plate("left", "z+00.0"), camera="left").pixels
    assert cv2.imwrite(str(tmp_path / "part.png"), pixels[20:500, 30:620])
    part = detect(
        tmp_path / "part.png", target=PLATE, camera="left", placement="p",
        crops={"part.png": (30.0, 20.0)},
    )  # fmt: skip
    assert part.size_px == {}
    # the crop changes only the background around the plate; measured 3e-5
    np.testing.assert_allclose(part.xy_px, whole.xy_px, atol=1e-3)
    table = tmp_path / "crops.csv"
    table.write_text("image,x0_px,y0_px\npart.png,30,20\n", encoding="utf-8")
    assert read_crops(table) == {"part.png": (30.0, 20.0)}
    again = detect(tmp_path / "part.png", target=PLATE, camera="left", placement="p", crops=table)
    np.testing.assert_array_equal(again.xy_px, part.xy_px)


def test_a_crop_without_a_row_is_refused():
    with pytest.raises(InputError, match="no row for 'left_z"):
        detect(plate("left", "z+00.0"), target=PLATE, camera="left", crops={"other.png": (0, 0)})


def test_a_missing_target_names_the_image():
    image = plate("left", "z+00.0")
    with pytest.raises(DetectionError) as caught:
        detect(image, target=Target.of(Chessboard(6, 7, 10.0)), camera="left")
    assert str(image) in caught.value.message


def test_a_board_of_half_turn_symmetry_is_warned_of():
    frame = Frame("left", np.tile(np.arange(256, dtype=np.uint8), (200, 1)), source="ramp")
    target = Target.of(Chessboard(6, 8, 10.0))
    with (
        pytest.warns(CloseRangeWarning, match="same after half a turn"),
        pytest.raises(DetectionError, match="ramp"),
    ):
        detect(frame, target=target, camera="left")
