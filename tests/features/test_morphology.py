"""Erosion and dilation against the thesis' sets and figures, and against brute force."""

from __future__ import annotations

import itertools
import json
from pathlib import Path

import cv2
import numpy as np
import pytest
from numpy.testing import assert_array_equal

from closerange.errors import InputError
from closerange.features.morphology import (
    closing,
    dilate,
    dilation_residue,
    erode,
    erosion_residue,
    opening,
)
from closerange.features.structuring import StructuringElement

FIGURES = json.loads(
    (Path(__file__).parents[2] / "data/thesis/figs_4_1_to_4_8.json").read_text(encoding="utf-8")
)
ROD = StructuringElement.of_points(FIGURES["fig_4_2_element"])
IMAGE = np.array(FIGURES["fig_4_1_image"])
TYPES = [np.uint8, np.uint16, np.int16, np.float32, np.float64]


def brute(image, element, *, erosion, outside="neutral"):
    """Equations 4.5 and 4.6, written out pixel by pixel in float64."""
    rows, columns = image.shape
    out = np.full(image.shape, np.inf if erosion else -np.inf)
    heights = np.zeros(len(element)) if element.flat else element.heights
    for r, c in itertools.product(range(rows), range(columns)):
        found = []
        for (i, j), b in zip(element.offsets, heights, strict=True):
            y, x = (r + i, c + j) if erosion else (r - i, c - j)
            inside = 0 <= y < rows and 0 <= x < columns
            if inside or outside == "background":
                value = float(image[y, x]) if inside else 0.0
                found.append(value - b if erosion else value + b)
        if found:
            out[r, c] = min(found) if erosion else max(found)
    return out


def as_type(values, dtype):
    """Infinities of the brute force stand for the extremes of a whole-number type."""
    if np.dtype(dtype).kind == "f":
        return values.astype(dtype)
    limits = np.iinfo(dtype)
    return np.clip(values, limits.min, limits.max).astype(dtype)


def random_element(rng, *, flat=True, reach=4):
    """Any shape, holes and islands included, with any origin, also outside."""
    while not (mask := rng.random(rng.integers(1, 6, 2)) < 0.5).any():
        pass
    offsets = np.argwhere(mask) - rng.integers(-reach, reach + 1, 2)
    return StructuringElement(offsets, None if flat else rng.integers(-9, 10, len(offsets)))


def random_image(rng, dtype, shape):
    if np.dtype(dtype).kind == "f":
        return rng.normal(0, 100, shape).astype(dtype)
    limits = np.iinfo(dtype)
    return rng.integers(limits.min, limits.max, shape, dtype=dtype, endpoint=True)


@pytest.mark.parametrize("dtype", TYPES)
@pytest.mark.parametrize(
    ("operation", "figure"),
    [
        (erode, "fig_4_3_erosion"),
        (dilate, "fig_4_4_dilation"),
        (erosion_residue, "fig_4_5_erosion_residue"),
        (dilation_residue, "fig_4_8_dilation_residue"),
    ],
)
def test_figures_of_the_thesis(operation, figure, dtype):
    assert_array_equal(operation(IMAGE.astype(dtype), ROD), FIGURES[figure])


def test_worked_points_of_the_thesis():
    eroded, dilated = erode(IMAGE.astype(np.uint8), ROD), dilate(IMAGE.astype(np.uint8), ROD)
    assert (eroded[1, 1], eroded[2, 2], dilated[1, 1]) == (0, 100, 100)  # (2,2), (3,3), (2,2)


@pytest.mark.parametrize(("name", "operation"), [("erosion", erode), ("dilation", dilate)])
def test_sets_of_section_4_2(name, operation):
    example = FIGURES["sets_of_section_4_2"][name]
    image = np.zeros((8, 8), dtype=bool)
    image[tuple(np.transpose(example["A"]))] = True
    found = operation(image, StructuringElement.of_points(example["B"]), outside="background")
    assert {tuple(point) for point in np.argwhere(found).tolist()} == {
        tuple(point) for point in example["result"]
    }
    a, b = ({tuple(p) for p in example[key]} for key in "AB")
    if name == "erosion":
        grid = set(itertools.product(range(8), range(8)))
        expected = {x for x in grid if all((x[0] + i, x[1] + j) in a for i, j in b)}
    else:
        expected = {(x + i, y + j) for x, y in a for i, j in b}
    assert expected == {tuple(point) for point in example["result"]}


def test_one_isolated_pixel_shows_that_the_element_has_no_centre():
    image = np.zeros((5, 5), dtype=np.uint8)
    image[2, 2] = 100
    ring = np.zeros((5, 5), dtype=int)
    ring[1, 2] = ring[2, 1] = ring[2, 3] = ring[3, 2] = 100
    assert_array_equal(dilate(image, ROD), ring)  # the pixel itself is gone
    assert_array_equal(dilation_residue(image, ROD), ring - image)  # -100 in the middle
    assert_array_equal(erosion_residue(image, ROD), image)
    pit = 100 - image
    assert erosion_residue(pit, ROD)[2, 2] == -100
    cross = StructuringElement.disc(1)
    assert len(cross) == 5
    assert_array_equal(dilation_residue(image, cross), ring)  # with the centre never negative


def test_a_single_pixel_dilates_to_the_element_and_shows_what_is_reflected():
    corner = StructuringElement.of_points([(0, 0), (0, 1), (0, 2), (1, 0)])
    image = np.zeros((7, 7), dtype=bool)
    image[3, 3] = True
    found = {tuple(p) for p in (np.argwhere(dilate(image, corner)) - 3).tolist()}
    assert found == {(0, 0), (0, 1), (0, 2), (1, 0)}
    whole = dilate(image, corner)
    assert_array_equal(erode(whole, corner, outside="background"), image)  # it fits there only
    assert_array_equal(dilate(image, corner.reflected), whole[::-1, ::-1])


@pytest.mark.parametrize("outside", ["neutral", "background"])
@pytest.mark.parametrize("dtype", TYPES)
@pytest.mark.parametrize("erosion", [True, False])
def test_flat_elements_of_any_shape_and_origin_equal_brute_force(erosion, dtype, outside):
    rng = np.random.default_rng(1)
    operation = erode if erosion else dilate
    for _ in range(25):
        element = random_element(rng)
        image = random_image(rng, dtype, tuple(rng.integers(1, 9, 2)))
        expected = as_type(brute(image, element, erosion=erosion, outside=outside), dtype)
        found = operation(image, element, outside=outside)
        assert found.dtype == dtype
        assert_array_equal(found, expected)


@pytest.mark.parametrize("outside", ["neutral", "background"])
@pytest.mark.parametrize("erosion", [True, False])
def test_binary_images_equal_brute_force(erosion, outside):
    rng = np.random.default_rng(2)
    operation = erode if erosion else dilate
    for _ in range(40):
        element = random_element(rng)
        image = rng.random(tuple(rng.integers(1, 9, 2))) < 0.6
        expected = brute(image, element, erosion=erosion, outside=outside) > 0
        found = operation(image, element, outside=outside)
        assert found.dtype == bool
        assert_array_equal(found, expected)


@pytest.mark.parametrize("outside", ["neutral", "background"])
@pytest.mark.parametrize("dtype", TYPES)
@pytest.mark.parametrize("erosion", [True, False])
def test_elements_with_heights_equal_brute_force(erosion, dtype, outside):
    rng = np.random.default_rng(3)
    operation = erode if erosion else dilate
    for _ in range(20):
        element = random_element(rng, flat=False)
        if element.flat:  # all heights happened to be 0
            continue
        image = random_image(rng, dtype, tuple(rng.integers(1, 9, 2)))
        found = operation(image, element, outside=outside)
        assert found.dtype == np.float64
        assert_array_equal(found, brute(image, element, erosion=erosion, outside=outside))


def test_heights_are_subtracted_by_the_erosion_and_added_by_the_dilation():
    image = np.full((3, 3), 50, dtype=np.uint8)
    lone = StructuringElement.of_points([(0, 0)], heights=[60])
    assert (erode(image, lone) == -10).all()  # not cut off at 0
    assert (dilate(image, lone) == 110).all()


def test_an_origin_far_outside_the_element_is_a_shift():
    rng = np.random.default_rng(4)
    image = rng.integers(0, 256, (20, 30), dtype=np.uint8)
    far = StructuringElement.box(3).shifted(7, -9)
    assert_array_equal(
        erode(image, far)[:12, 10:], erode(image, StructuringElement.box(3))[7:19, 1:21]
    )
    beyond = StructuringElement.box(3).shifted(10_000, 0)  # nothing of it ever meets the image
    assert (erode(image, beyond) == 255).all()
    assert (dilate(image, beyond) == 0).all()
    assert (erode(image, beyond, outside="background") == 0).all()


def test_an_element_larger_than_the_image_takes_the_extremes():
    image = np.arange(20, dtype=np.uint8).reshape(4, 5)
    assert (erode(image, StructuringElement.box(99)) == 0).all()
    assert (dilate(image, StructuringElement.box(99)) == 19).all()


def test_symmetric_elements_agree_with_opencv_itself():
    rng = np.random.default_rng(5)
    image = rng.integers(0, 2**16, (40, 50), dtype=np.uint16)
    kernel = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (7, 5))
    element = StructuringElement.of_mask(kernel)
    assert_array_equal(erode(image, element), cv2.erode(image, kernel))
    assert_array_equal(dilate(image, element), cv2.dilate(image, kernel))
    assert_array_equal(opening(image, element), cv2.morphologyEx(image, cv2.MORPH_OPEN, kernel))
    assert_array_equal(closing(image, element), cv2.morphologyEx(image, cv2.MORPH_CLOSE, kernel))


@pytest.mark.parametrize("flat", [True, False])
def test_opening_and_closing_hold_their_laws_for_every_origin(flat):
    rng = np.random.default_rng(6)
    for _ in range(60):
        element = random_element(rng, flat=flat)
        image = rng.integers(0, 256, (9, 11), dtype=np.uint8)
        opened, closed = opening(image, element), closing(image, element)
        assert (opened <= image).all()
        assert (closed >= image).all()
        assert_array_equal(opening(opened, element), opened)
        assert_array_equal(closing(closed, element), closed)


def test_erosion_and_dilation_are_dual():
    """The erosion of the complement is the complement of the dilation by the reflected set."""
    rng = np.random.default_rng(7)
    for _ in range(30):
        element = random_element(rng)
        image = rng.integers(0, 256, (8, 9), dtype=np.uint8)
        assert_array_equal(erode(255 - image, element), 255 - dilate(image, element.reflected))


def test_residues_of_binary_images_are_set_differences():
    block = np.zeros((6, 6), dtype=bool)
    block[1:5, 1:5] = True
    box = StructuringElement.box(3)
    inner, outer = erosion_residue(block, box), dilation_residue(block, box)
    assert (inner.sum(), outer.sum()) == (12, 20)
    assert not (inner & outer).any()
    assert_array_equal(inner, block & ~erode(block, box))


@pytest.mark.parametrize(
    ("dtype", "wide"), [(np.uint8, np.int16), (np.uint16, np.int32), (np.int16, np.int32)]
)
def test_residues_do_not_overflow(dtype, wide):
    limits = np.iinfo(dtype)
    image = np.array([[limits.min, limits.max, limits.min]], dtype=dtype)
    found = dilation_residue(image, StructuringElement.of_points([(0, -1), (0, 1)]))
    assert found.dtype == wide
    full = int(limits.max) - int(limits.min)
    assert_array_equal(found, [[full, -full, full]])


@pytest.mark.parametrize(
    ("image", "element", "named"),
    [
        (np.zeros((2, 2, 3), np.uint8), ROD, "shape"),
        (np.zeros((0, 4), np.uint8), ROD, "shape"),
        (np.zeros((2, 2), np.int64), ROD, "int64"),
        (np.array([[1.0, np.nan]]), ROD, "NaN"),
        (np.ones((2, 2), bool), StructuringElement.of_points([(0, 0)], [3.0]), "binary"),
    ],
)
def test_bad_images_are_refused(image, element, named):
    with pytest.raises(InputError, match=named) as refused:
        erode(image, element)
    assert refused.value.remedy


def test_an_unknown_border_rule_is_refused():
    with pytest.raises(InputError, match="mirror"):
        erode(np.zeros((2, 2), np.uint8), ROD, outside="mirror")
