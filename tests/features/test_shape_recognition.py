"""Crimmins and Brown: the theorem on sets, at all thresholds at once, and on rendered parts."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from numpy.testing import assert_array_equal

from closerange.errors import CloseRangeWarning, DetectionError, InputError
from closerange.features import shape_recognition
from closerange.features.shape_recognition import find_shapes, occurrences
from closerange.features.shape_teaching import teach_shape
from closerange.features.shapes import Shape
from closerange.features.structuring import StructuringElement
from closerange.flags import Flag

ELL = [(-30, -30), (30, -30), (30, -10), (-8, -10), (-8, 30), (-30, 30)]


def picture(*parts, size=160, noise=3.0, seed=0, psf=0.7):
    """Grey image of polygons and discs at places between pixels: (outline, x, y, roll, grey)."""
    factor = 8
    whole = np.full((size * factor, size * factor), 40.0, np.float32)
    for outline, x, y, roll, grey in parts:
        if np.isscalar(outline):
            turns = np.linspace(0, 2 * np.pi, 90, endpoint=False)
            points = outline * np.column_stack([np.cos(turns), np.sin(turns)])
        else:
            c, s = np.cos(roll), np.sin(roll)
            points = np.asarray(outline, float) @ np.array([[c, s], [-s, c]])
        corners = (points + np.array([x + 0.5, y + 0.5])) * factor - 0.5
        cv2.fillPoly(whole, [np.rint(corners).astype(int)], float(grey))
    image = cv2.resize(whole, (size, size), interpolation=cv2.INTER_AREA)
    if psf:
        image = cv2.GaussianBlur(image, (0, 0), psf)
    image = image + np.random.default_rng(seed).normal(0, noise, image.shape)
    return np.clip(np.rint(image), 0, 255).astype(np.uint8)


def brute_occurrences(image, shape, window):
    """A lies in the image, and no pixel of W - A belongs to it; outside nothing does."""
    found = np.zeros(image.shape, bool)
    a = {tuple(p) for p in shape.offsets.tolist()}
    around = {tuple(p) for p in window.offsets.tolist()} - a

    def inside(r, c):
        return 0 <= r < image.shape[0] and 0 <= c < image.shape[1] and bool(image[r, c])

    for r, c in np.ndindex(image.shape):
        found[r, c] = all(inside(r + i, c + j) for i, j in a) and not any(
            inside(r + i, c + j) for i, j in around
        )
    return found


def test_theorem_equals_its_meaning_for_random_sets():
    rng = np.random.default_rng(1)
    hits = 0
    for _ in range(150):
        cells = rng.random((3, 4))
        if not (cells < 0.15).any():
            continue
        shift = tuple(int(v) for v in rng.integers(-3, 4, 2))
        shape = StructuringElement.of_mask(cells < 0.15).shifted(*shift)
        window = StructuringElement.of_mask(cells < 0.35).shifted(*shift)
        image = rng.random((8, 9)) < 0.4
        found = occurrences(image, shape, window)
        assert_array_equal(found, brute_occurrences(image, shape, window))
        hits += int(found.sum())
    assert hits > 200  # the comparison was not of empty sets


def test_complement_keeps_larger_shapes_out_and_the_shape_smaller_ones():
    image = np.zeros((12, 40), bool)
    for size, column in ((3, 3), (5, 12), (7, 24)):
        image[2 : 2 + size, column : column + size] = True
    five = StructuringElement.box(5)
    assert_array_equal(np.argwhere(occurrences(image, five, StructuringElement.box(7))), [[4, 14]])
    # without a background the larger square is found too, at nine places
    assert occurrences(image, five, five).sum() == 10


def test_places_are_those_of_the_theorem_at_some_threshold():
    """The grey search equals the union of the theorem over all thresholds."""
    rng = np.random.default_rng(2)
    image = picture((9, 30, 33, 0, 120), (9, 62, 60.4, 0, 90), (7, 30, 66, 0, 150), size=90)
    taught = teach_shape(image, name="disc", at_px=(30, 33))
    _, inner, around = next(taught.stack())
    shape = StructuringElement(inner)
    window = StructuringElement(np.vstack([inner, around]))
    expected = np.zeros(image.shape, bool)
    gap = int(shape_recognition.MIN_STEP)
    for level in range(255 - gap):  # with a step: bright above level + gap, dark up to level
        fits = occurrences(image >= level + gap, shape, shape)
        fits &= occurrences(image <= level, StructuringElement(around), StructuringElement(around))
        expected |= fits
    found = np.zeros(image.shape, bool)
    places, contrasts = shape_recognition._fits(image, inner, around, 0.0)
    found[tuple(places.T)] = True
    assert_array_equal(found, expected)
    assert found.sum() > 10
    for place in places[rng.permutation(len(places))[:5]]:
        low = image[tuple((place + inner).T)].min()
        high = image[tuple((place + around).T)].max()
        assert contrasts[(places == place).all(axis=1)][0] == int(low) - int(high)
    assert len(window) == len(inner) + len(around)


def test_a_disc_is_found_between_pixels_and_others_of_another_size_are_not():
    taught = teach_shape(picture((20, 80, 80, 0, 150)), name="disc", at_px=(80, 80))
    assert taught.polarity == "bright"
    errors = []
    for seed in range(12):
        rng = np.random.default_rng(seed)
        x, y = 80 + rng.uniform(-20, 20, 2)
        (hit,) = find_shapes(picture((20, x, y, 0, 110), seed=seed), [taught])  # less light
        errors.append((hit.xy_px - [x, y]) / np.sqrt(np.diag(hit.cov_px2)))
        assert np.abs(hit.xy_px - [x, y]).max() < 1.0
        assert hit.flags == 0
    assert np.sqrt(np.mean(np.square(errors))) < 1  # the covariance is an upper bound
    for radius in (17, 18, 22, 23):
        for seed in range(5):
            x, y = 80 + np.random.default_rng(seed).uniform(-0.5, 0.5, 2)
            assert find_shapes(picture((radius, x, y, 0, 150), seed=seed), [taught]) == []


def test_gain_offset_and_depth_of_the_image_do_not_matter():
    image = picture((ELL, 80, 80, 0.0, 150))
    taught = teach_shape(image, name="ell", at_px=(70, 62))
    (first,) = find_shapes(image, [taught])
    (dim,) = find_shapes((image // 3 + 60).astype(np.uint8), [taught])
    (deep,) = find_shapes(image.astype(np.uint16) * 200, [taught])
    for other in (dim, deep):
        assert np.abs(other.xy_px - first.xy_px).max() < 0.3
    assert deep.contrast == 200 * first.contrast


def test_dark_shapes_and_holes():
    image = picture((40, 80, 80, 0, 190), (15, 90, 78, 0, 60))
    hole = teach_shape(image, name="hole", at_px=(90, 78))
    assert hole.polarity == "dark"
    plate = teach_shape(image, name="plate", at_px=(55, 80))
    assert plate.polarity == "bright"
    assert not plate.mask[38, 51]  # the hole is no part of the plate
    hits = find_shapes(image, [hole, plate])
    assert [hit.shape for hit in hits] == ["hole", "plate"]
    assert np.abs(hits[0].xy_px - [90, 78]).max() < 0.5
    assert not any(hit.flags for hit in hits)
    # a plate without the hole is another shape
    assert find_shapes(picture((40, 80, 80, 0, 190)), [plate]) == []


@pytest.mark.parametrize("roll_deg", [33, 200.5, 347])
def test_rolled_parts_are_found_when_asked_for(roll_deg):
    flat = picture((ELL, 80, 80, 0.0, 150))
    taught = teach_shape(flat, name="ell", at_px=(70, 62), rotation_step_deg=5)
    rolled = picture((ELL, 84.3, 78.6, np.radians(roll_deg), 150), seed=1)
    (hit,) = find_shapes(rolled, [taught])
    away = (np.degrees(hit.roll_rad) - roll_deg + 180) % 360 - 180
    assert abs(away) <= 3.5
    (home,) = find_shapes(flat, [taught])
    centre = home.xy_px - 80
    c, s = np.cos(np.radians(roll_deg)), np.sin(np.radians(roll_deg))
    expected = np.array([c * centre[0] - s * centre[1], s * centre[0] + c * centre[1]])
    assert np.abs(hit.xy_px - [84.3, 78.6] - expected).max() < 0.7
    fixed = Shape("ell", taught.mask, "bright", taught.contrast, taught.sharpness)
    assert find_shapes(rolled, [fixed]) == []


def test_several_of_one_kind_are_one_hit_each_from_top_to_bottom():
    places = [(30, 120.3), (120, 30), (75.5, 70), (130, 128)]
    image = picture(*((12, x, y, 0, 150) for x, y in places))
    taught = teach_shape(image, name="disc", at_px=(30, 120))
    hits = find_shapes(image, [taught])
    assert [round(hit.xy_px[1]) for hit in hits] == [30, 70, 120, 128]


def test_a_shape_at_the_image_border_is_flagged_and_a_cut_one_not_found():
    taught = teach_shape(picture((20, 80, 80, 0, 150)), name="disc", at_px=(80, 80))
    (hit,) = find_shapes(picture((20, 21, 80, 0, 150)), [taught])
    assert hit.flags == Flag.at_border
    assert find_shapes(picture((20, 12, 80, 0, 150)), [taught]) == []


def test_two_shapes_that_fit_at_one_place_are_ambiguous():
    image = picture((20, 80, 80, 0, 150))
    twins = [teach_shape(image, name=name, at_px=(80, 80)) for name in ("a", "b")]
    assert [hit.flags for hit in find_shapes(image, twins)] == [Flag.ambiguous] * 2


@pytest.mark.parametrize(
    "image",
    [
        np.full((160, 160), 90, np.uint8),
        picture(noise=8),
        np.clip(200 - np.hypot(*np.mgrid[-80:80, -80:80]) * 2, 0, 255).astype(np.uint8),
        np.tile(np.arange(160, dtype=np.uint8), (160, 1)),
    ],
    ids=["blank", "noise", "hill", "slope"],
)
def test_nothing_is_found_where_there_is_nothing(image):
    taught = teach_shape(picture((20, 80, 80, 0, 150)), name="disc", at_px=(80, 80))
    assert find_shapes(image, [taught]) == []


def test_hot_and_dead_pixels_do_not_hide_a_shape():
    image = picture((20, 80, 80, 0, 150))
    taught = teach_shape(image, name="disc", at_px=(80, 80))
    spots = np.random.default_rng(3).integers(10, 150, (40, 2)) // 3 * 3
    image[spots[:, 0], spots[:, 1]] = np.where(np.arange(40) % 2, 0, 255)
    assert len(find_shapes(image, [taught])) == 1


def test_an_image_smaller_than_the_shape_holds_none():
    taught = teach_shape(picture((20, 80, 80, 0, 150)), name="disc", at_px=(80, 80))
    assert find_shapes(picture((20, 15, 15, 0, 150), size=30), [taught]) == []


def test_weak_shapes_and_coarse_rolls_are_warned_of():
    with pytest.warns(CloseRangeWarning, match="rim is .* px away"):
        teach_shape(
            picture((ELL, 80, 80, 0, 150)), name="ell", at_px=(70, 62), rotation_step_deg=30
        )
    half = [(-40, -40), (0, -40), (0, 40), (-40, 40)]
    shaded = picture((30, 80, 80, 0, 150), (half, 80, 80, 0, 40), (30, 80, 80, 0, 62))
    shaded[:, 80:] = picture((30, 80, 80, 0, 150))[:, 80:]  # its left half is hardly lit
    disc = np.hypot(*(np.mgrid[0:160, 0:160] - 80)) < 30
    with pytest.warns(CloseRangeWarning, match="faintest border"):
        teach_shape(shaded, name="weak", mask=disc)


@pytest.mark.parametrize(
    ("options", "error", "named"),
    [
        ({"at_px": (-1, 5)}, InputError, "not in the image"),
        ({"at_px": (np.nan, 5)}, InputError, "not in the image"),
        ({}, InputError, "a place or by a mask"),
        ({"mask": np.ones((3, 3))}, InputError, r"the image \(160, 160\)"),
        ({"mask": np.zeros((160, 160))}, DetectionError, "brighter or darker"),
        ({"at_px": (5, 5), "polarity": "bright"}, DetectionError, "brighter or darker"),
        ({"at_px": (80, 80), "margin_px": 30}, DetectionError, "brighter or darker"),
    ],
)
def test_what_cannot_be_taught_is_refused(options, error, named):
    with pytest.raises(error, match=named) as refused:
        teach_shape(picture((20, 80, 80, 0, 150)), name="disc", **options)
    assert refused.value.remedy


def test_bad_searches_are_refused():
    image = picture((20, 80, 80, 0, 150))
    disc = teach_shape(image, name="disc", at_px=(80, 80))
    with pytest.raises(InputError, match="twice"):
        find_shapes(image, [disc, disc])
    with pytest.raises(InputError, match="least_sharpness"):
        find_shapes(image, [disc], least_sharpness=2)
    with pytest.raises(InputError, match="float64"):
        find_shapes(image.astype(float), [disc])
    with pytest.raises(InputError, match="no set"):
        occurrences(image, StructuringElement.box(3), StructuringElement.box(5))


A_PLACES = {
    "cyl7507": (305, 263),
    "cyl2506": (426, 382),
    "box5044": (440, 105),
    "box4418": (285, 95),
    "box2519": (140, 235),
}


def read(shared, name):
    return cv2.imread(str(shared / "data/rendered" / name), cv2.IMREAD_GRAYSCALE)


def test_the_blocks_of_the_rendered_scene(shared):
    image = read(shared, "A_blocks/left.png")
    shapes = [teach_shape(image, name=name, at_px=at) for name, at in A_PLACES.items()]
    hits = find_shapes(image, shapes)
    # each is found once, where it was taught, and the smaller disc (radius 48 px) is not taken
    # for the larger (53 px) nor the other way round
    assert [hit.shape for hit in hits] == list(A_PLACES)
    assert not any(hit.flags for hit in hits)
    for hit, at in zip(hits, A_PLACES.values(), strict=True):
        assert np.abs(hit.xy_px - at).max() < 6
    discs = shapes[:2]
    assert [hit.shape for hit in find_shapes(read(shared, "A_blocks/third.png"), discs)] == [
        "cyl7507",
        "cyl2506",
    ]
    # other exposures, other places, one disc after the other taken away
    assert len(find_shapes(read(shared, "A_pick/left_f0.png"), discs)) == 2
    assert [hit.shape for hit in find_shapes(read(shared, "A_pick/left_f3.png"), discs)] == [
        "cyl2506"
    ]
    for empty in ("A_pick/left_f5.png", "A_parts/left.png", "A_spring/left.png"):
        assert find_shapes(read(shared, empty), shapes) == []


def test_the_parts_of_the_rendered_scene(shared):
    image = read(shared, "A_parts/left.png")
    places = {"hole": (148, 190), "bore": (427, 307), "cliphole": (206, 339)}
    shapes = [teach_shape(image, name=name, at_px=at) for name, at in places.items()]
    with pytest.warns(CloseRangeWarning, match="'clip'"):
        shapes.append(teach_shape(image, name="clip", at_px=(205, 370)))
    with pytest.warns(CloseRangeWarning, match="'block'"):
        shapes.append(teach_shape(image, name="block", at_px=(150, 235)))
    # three holes of radius 20, 17 and 15 px: each is itself only
    for view in ("left", "right", "third"):
        hits = find_shapes(read(shared, f"A_parts/{view}.png"), shapes[:3])
        assert [hit.shape for hit in hits] == list(places), view
        assert not any(hit.flags for hit in hits)
    hits = find_shapes(image, shapes)
    assert [hit.shape for hit in hits] == [*places, "clip", "block"]
    assert find_shapes(read(shared, "A_blocks/left.png"), shapes) == []


@pytest.mark.parametrize("margin_px", [float("nan"), -1.0, 500.0])
def test_a_margin_that_is_none_is_refused_as_such(margin_px):
    image = np.zeros((60, 60), np.uint8)
    image[20:40, 20:40] = 200
    with pytest.raises(InputError, match="possible are 0 to 64 px"):
        teach_shape(image, name="square", at_px=(30, 30), margin_px=margin_px)
