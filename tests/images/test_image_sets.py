"""Which images belong together, and which must not."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from closerange.errors import InputError
from closerange.images import (
    Frame,
    check_duplicates,
    group_images,
    placement_and_reading,
    placement_name,
)

RNG = np.random.default_rng(5)


def paths(*names):
    return [Path(name) for name in names]


def frame(camera="left", source="a.png", time_s=None, shape=(8, 6), dtype=np.uint8):
    return Frame(camera, RNG.integers(0, 256, shape).astype(dtype), time_s, source)


@pytest.mark.parametrize(
    ("name", "pattern", "expected"),
    [
        ("left/pose07.png", None, ("pose07", "")),
        ("left_07.tif", r"(\d+)$", ("07", "")),
        ("p12_left_r3.png", r"(p\d+)_.*_r(?P<reading>\d+)", ("p12", "3")),
        ("r3_p12.png", r"r(?P<reading>\d+)_(p\d+)", ("p12", "3")),
        ("z=1.5.left.png", r"(.*)\.left", ("z=1.5", "")),
    ],
)
def test_placement_comes_from_the_file_name(name, pattern, expected):
    assert placement_and_reading(name, pattern) == expected
    assert placement_name(Path(name), pattern) == expected[0]


@pytest.mark.parametrize(
    ("pattern", "words"),
    [
        (r"(\d+", "no regular expression"),
        (r"\d+", "no group"),
        (r"(?P<reading>\d+)", "no group for the placement"),
        (r"pose(\d+)", "finds nothing in 'left07'"),
        (r"left(\d*)x?(a)?|(b)", None),
        (r"left07(.*)", "finds nothing"),
        (r"(left)\d(?P<reading>x)?", "finds nothing"),
    ],
)
def test_bad_patterns_are_refused(pattern, words):
    if words is None:
        assert placement_name("left07.png", pattern) == "07"
        return
    with pytest.raises(InputError, match=words) as error:
        placement_name("left07.png", pattern)
    assert error.value.remedy


def test_sets_are_grouped_in_natural_order():
    sets = group_images(
        {
            "left": paths("l/image10.png", "l/image2.png"),
            "right": paths("r/image2.tif", "r/image10.tif"),
        }
    )
    assert [one.placement for one in sets] == ["image2", "image10"]
    assert sets[1].paths == {"left": Path("l/image10.png"), "right": Path("r/image10.tif")}
    assert [one.reading for one in sets] == ["", ""]


def test_readings_make_sets_of_their_own():
    pattern = r"(p\d+)_\w_r(?P<reading>\d+)"
    left = paths("p2_l_r0.png", "p1_l_r10.png", "p1_l_r9.png")
    right = paths("p1_r_r9.png", "p1_r_r10.png", "p2_r_r0.png")
    sets = group_images({"l": left, "r": right}, pattern=pattern)
    keys = [(one.placement, one.reading) for one in sets]
    assert keys == [("p1", "9"), ("p1", "10"), ("p2", "0")]
    assert {path.stem.replace("_l_", "_r_") for path in (sets[1].paths["l"],)} == {"p1_r_r10"}


def test_orphans_are_all_listed():
    cameras = {
        "left": paths("l/a.png", "l/b.png", "l/c.png"),
        "right": paths("r/a.png", "r/c.png", "r/d.png"),
    }
    with pytest.raises(InputError) as error:
        group_images(cameras)
    text = error.value.message
    assert "l/b.png (placement 'b' of left) is missing in right" in text.replace("\\", "/")
    assert "r/d.png (placement 'd' of right) is missing in left" in text.replace("\\", "/")
    assert "left 3, right 3" in text
    assert "l/a.png" not in text


def test_names_without_anything_in_common_lead_to_the_pattern():
    cameras = {"left": paths("left01.png"), "right": paths("right01.png")}
    with pytest.raises(InputError) as error:
        group_images(cameras)
    assert "pattern" in error.value.remedy
    assert r"(\d+)$" in error.value.remedy
    assert len(group_images(cameras, pattern=r"(\d+)$")) == 1


def test_many_orphans_are_counted_not_flooded():
    cameras = {"left": paths(*(f"{n}.png" for n in range(50))), "right": paths("0.png")}
    with pytest.raises(InputError, match="and 41 more"):
        group_images(cameras)


def test_two_images_of_one_placement_are_refused():
    with pytest.raises(InputError, match=r"a\.png and .*a\.tif are both placement 'a'"):
        group_images({"left": paths("a.png", "a.tif")})
    with pytest.raises(InputError, match="no camera"):
        group_images({})
    with pytest.raises(InputError, match="no images"):
        group_images({"left": [], "right": []})


def test_identical_pixels_are_refused_within_and_across_cameras():
    one, two = frame(source="1.png"), frame(source="2.png")
    check_duplicates([one, two])
    again = Frame("left", one.pixels.copy(), None, "3.png")
    with pytest.raises(InputError, match=r"1\.png .*3\.png .*occurs twice"):
        check_duplicates([one, two, again])
    other = Frame("right", one.pixels[::1].copy(order="F"), None, "4.png")
    with pytest.raises(InputError, match=r"1\.png \(camera 'left'\) .*4\.png .*two cameras"):
        check_duplicates([one, other])
    changed = one.pixels.copy()
    changed[3, 2] ^= 1
    check_duplicates([one, Frame("right", changed, None, "5.png")])
    # the same bytes in another shape or depth are another image
    check_duplicates([one, Frame("left", one.pixels.reshape(6, 8)), frame(dtype=np.uint16)])
