import numpy as np
import pytest

from closerange.errors import InputError
from closerange.flags import Flag
from closerange.geometry.transform import RigidTransform, rotation_from_vector
from closerange.matching import literal_words
from closerange.matching.candidates import sweep_axis
from closerange.matching.literal import (
    LiteralMatcher,
    binary_images,
    match_literal,
)
from closerange.matching.literal_band import bands
from closerange.matching.literal_element import farthest_plane, footprint, strip_footprint
from closerange.matching.literal_words import (
    bits_to_words,
    count_bits,
    count_bits_by_halves,
    pack_blocks,
)
from closerange.matching.pencil import Pencil
from closerange.matching.search import (
    between_planes,
    epipolar_segment,
    sight_line,
    upper_plane_mapping,
)
from closerange.rig.camera import Camera
from closerange.rig.distortion import BrownIdeal
from closerange.verification.scenes import looking_at_origin

SIZE = (200, 160)
VOLUME = between_planes(-20.0, 20.0)
STRONG = BrownIdeal(k1=-0.35, k2=0.1, p1=0.004, p2=-0.003)


def _pair(lens=None, *, distance_2=500.0, roll=0.0, size=SIZE):
    """Two cameras that look down at the origin, the second one rolled."""
    first, second = (
        looking_at_origin(
            name,
            angle_rad=angle,
            distance_mm=distance,
            focal_px=700.0,
            distortion=lens,
            size_px=size,
        )
        for name, angle, distance in (("left", -0.2, 500.0), ("right", 0.25, distance_2))
    )
    return first, _turned(second, [0.01, -0.02, roll])


def _turned(camera, vector):
    pose, turn = camera.camera_from_world, rotation_from_vector(vector)
    return Camera(
        camera.name,
        camera.size_px,
        camera.matrix_px,
        RigidTransform(turn @ pose.rotation, turn @ pose.translation_mm),
        camera.distortion,
    )


def _random_masks(share=0.1, seed=3):
    rng = np.random.default_rng(seed)
    return tuple(rng.random(SIZE[::-1]) < share for _ in range(2))


def _seeds(count=25, seed=4):
    return np.random.default_rng(seed).uniform((-0.5, -0.5), (199.5, 159.5), (count, 2))


def _offsets(cameras, mask, seed, inside):
    """Different (row, column) of one element in view 2: a set, by the public mapping."""
    column, row = np.rint(seed).astype(int)
    reach = len(inside) // 2
    centre = upper_plane_mapping(*cameras, [seed], -20.0).xy_px[0]
    found = set()
    for down in range(-reach, reach + 1):
        for across in range(-reach, reach + 1):
            y, x = row + down, column + across
            within = 0 <= y < mask.shape[0] and 0 <= x < mask.shape[1]
            if within and inside[down + reach, across + reach] and mask[y, x]:
                found.add((x, y))
    if not found:
        return set()
    there = upper_plane_mapping(*cameras, list(found), -20.0).xy_px
    return {(round(y), round(x)) for x, y in there - centre}


def _mismatch(mask, offsets, x, y):
    height, width = mask.shape
    return sum(
        not (0 <= y + dy < height and 0 <= x + dx < width and mask[y + dy, x + dx])
        for dy, dx in offsets
    )


def _band_pixels(cameras, seed, band):
    """Pixels around the densely sampled segment, by their definition."""
    dense = epipolar_segment(*cameras, [seed], VOLUME, step_px=0.02)
    curve = dense.xy_px[0, : dense.count[0]]
    if not len(curve):
        return []
    axis = int(np.argmax(np.abs(curve[-1] - curve[0])))
    ends = np.rint(curve[[0, -1], axis]).astype(int)
    order = np.argsort(curve[:, axis])
    width, height = cameras[1].size_px
    found = []
    for along in range(
        ends[0], ends[1] + (1 if ends[1] >= ends[0] else -1), 1 if ends[1] >= ends[0] else -1
    ):
        middle = np.interp(along, curve[order, axis], curve[order, 1 - axis])
        for across in range(int(np.ceil(middle - band)), int(np.ceil(middle + band))):
            x, y = (along, across) if axis == 0 else (across, along)
            if 0 <= x < width and 0 <= y < height:
                found.append((x, y))
    return found


# --- words -----------------------------------------------------------------------------------


def test_every_word_holds_the_block_to_the_lower_right_of_its_pixel():
    mask = np.random.default_rng(0).random((37, 45)) < 0.4
    words = pack_blocks(mask, 9)
    assert words.shape == (55, 63)
    padded = np.pad(mask, (9, 17))
    for y, x in [(0, 0), (3, 60), (9, 9), (20, 31), (45, 53), (54, 62), (40, 12)]:
        block = padded[y : y + 8, x : x + 8].astype(np.uint8).reshape(1, 64)
        assert words[y, x] == bits_to_words(block)[0, 0]
        assert count_bits(words[y, x]) == block.sum()


def test_bits_are_counted_alike_with_and_without_numpy_2():
    rng = np.random.default_rng(1)
    words = rng.integers(0, 2**64, 4000, dtype=np.uint64)
    words[:3] = 0, 2**64 - 1, 2**63
    by_text = [int(word).bit_count() for word in words]
    assert count_bits_by_halves(words).tolist() == by_text
    assert count_bits(words).tolist() == by_text


def test_without_numpy_2_the_matches_are_the_same(monkeypatch):
    matcher = LiteralMatcher(_pair(STRONG), _random_masks(), VOLUME)
    fast = matcher.match(_seeds(), footprint(15))
    monkeypatch.setattr(literal_words, "_COUNT", None)
    slow = matcher.match(_seeds(), footprint(15))
    assert np.array_equal(fast.mismatch, slow.mismatch, equal_nan=True)
    assert np.array_equal(fast.xy_px, slow.xy_px, equal_nan=True)


# --- footprints ------------------------------------------------------------------------------


def test_footprints():
    assert footprint(15).all()
    assert footprint(15).shape == (15, 15)
    disc = footprint(15, "disc")
    y, x = np.mgrid[-7:8, -7:8]
    assert (disc == (x**2 + y**2 <= 49)).all()
    cross = footprint(15, "cross")
    assert (cross == ((np.abs(x) <= 2) | (np.abs(y) <= 2))).all()
    assert footprint(3, "cross").all()
    strip = strip_footprint(15, (0.0, 1.0))
    assert (strip == (np.abs(x) <= 2)).all()
    slanted = strip_footprint(15, (np.sqrt(0.5), np.sqrt(0.5)))
    assert (slanted == slanted.T).all()
    assert slanted.sum() == pytest.approx(strip.sum(), rel=0.15)


@pytest.mark.parametrize("size", [0, 1, 2, 4, 16, -3, 15.5])
def test_elements_without_a_middle_pixel_or_surroundings_are_refused(size):
    with pytest.raises(InputError, match="odd whole number from 3"):
        footprint(size)
    with pytest.raises(InputError, match="odd whole number from 3"):
        strip_footprint(size, (1.0, 0.0))


def test_unknown_shapes_are_refused():
    with pytest.raises(InputError, match="square, disc, cross"):
        footprint(9, "star")


# --- the plane -------------------------------------------------------------------------------


def test_the_plane_is_the_face_farthest_from_the_cameras():
    box = np.array([[-60.0, -50.0, -40.0], [61.0, 51.0, 41.0]])
    first, second = _pair()
    assert farthest_plane(first, second, VOLUME) == (2, -20.0)  # the cameras look down
    assert sweep_axis(Pencil.of(first, second)) == 2
    for axis in range(3):
        for sense in (1, -1):
            turn = {
                0: rotation_from_vector([0, sense * np.pi / 2, 0]),
                1: rotation_from_vector([sense * np.pi / 2, 0, 0]),
                2: np.diag([1.0, sense, sense]),
            }[axis]
            views = []
            for camera in (first, second):
                pose = camera.camera_from_world
                moved = RigidTransform(pose.rotation @ turn, pose.translation_mm)
                views.append(Camera(camera.name, camera.size_px, camera.matrix_px, moved))
            found = farthest_plane(*views, box)
            assert found[0] == axis == sweep_axis(Pencil.of(*views))
            middle = np.mean([view.centre_mm for view in views], axis=0)
            assert found[1] == box[1 if middle[axis] < 0 else 0, axis]


def test_an_axis_without_limits_has_no_farthest_face():
    first, second = _pair()
    slab = np.array([[-30.0, -np.inf, -np.inf], [30.0, np.inf, np.inf]])
    assert farthest_plane(first, second, slab)[0] == 0


# --- against brute force ---------------------------------------------------------------------


@pytest.mark.parametrize("lens", [None, STRONG])
@pytest.mark.parametrize("band", [0.5, 1.0, 1.7])
def test_the_band_is_what_its_definition_says(lens, band):
    for roll in (0.3, 1.4, -2.0):
        cameras = _pair(lens, roll=roll)
        seeds = _seeds(20)
        found = bands(cameras[1], sight_line(cameras[0], seeds, VOLUME), band)
        total = 0
        for row, seed in enumerate(seeds):
            got = list(zip(found.column[row], found.row[row], strict=True))
            got = [pixel for pixel, valid in zip(got, found.valid[row], strict=True) if valid]
            wanted = _band_pixels(cameras, seed, band)
            total += len(wanted)
            # 32 px of a bent curve are taken for straight: pixels at the rim may differ
            assert len(set(got) ^ set(wanted)) <= (0 if lens is None else 0.1 * len(wanted))
            assert (found.flags[row] == 0) == bool(wanted)
            assert len(set(got)) == len(got)
        assert total > 300


@pytest.mark.parametrize("lens", [None, STRONG])
@pytest.mark.parametrize(
    ("inside", "share"),
    [
        (footprint(3), 0.3),
        (footprint(9, "disc"), 0.1),
        (footprint(15), 0.1),
        (footprint(15), 0.6),
        (strip_footprint(21, (0.6, 0.8)), 0.2),
        (footprint(59), 0.03),
    ],
)
def test_counts_equal_brute_force_exactly(lens, inside, share):
    cameras, masks = _pair(lens, roll=0.4), _random_masks(share)
    matcher = LiteralMatcher(cameras, masks, VOLUME, band_px=1.0)
    seeds = _seeds(12)
    search = matcher.search(seeds)
    elements, places = matcher.elements(search, inside), search.places
    hits = matcher.scan(elements, places)
    found = matcher.match(seeds, inside)
    compared = 0
    for row, seed in enumerate(seeds):
        offsets = _offsets(cameras, masks[0], seed, inside)
        assert found.pixels[row] == len(offsets)
        valid = np.flatnonzero(places.valid[row])
        if not offsets or not len(valid):
            assert np.isnan(found.mismatch[row])
            continue
        counts = [
            _mismatch(masks[1], offsets, int(places.column[row, i]), int(places.row[row, i]))
            for i in valid
        ]
        assert (len(offsets) - hits[row, valid].astype(int)).tolist() == counts
        assert hits[row, ~places.valid[row]].sum() == 0
        best = min(counts)
        tied = [i for i, count in zip(valid, counts, strict=True) if count == best]
        if best < len(offsets):
            middle = tied[(len(tied) - 1) // 2]
            pixel = [places.column[row, middle], places.row[row, middle]]
            assert found.xy_px[row].tolist() == pixel
            assert (found.mismatch[row], found.ties[row]) == (best, len(tied))
            away = [
                np.hypot(places.column[row, i] - pixel[0], places.row[row, i] - pixel[1])
                for i in tied
            ]
            assert bool(found.flags[row] & Flag.ambiguous) == (max(away) > 1.5)
            compared += 1
    assert compared >= 6


def test_the_whole_image_is_scanned_exactly():
    cameras, masks = _pair(), _random_masks(0.1)
    matcher = LiteralMatcher(cameras, masks, VOLUME)
    seed = np.array([[101.3, 80.6]])
    found = matcher.match(seed, footprint(15), whole_image=True)
    offsets = _offsets(cameras, masks[0], seed[0], footprint(15))
    counts = np.array(
        [[_mismatch(masks[1], offsets, x, y) for x in range(200)] for y in range(160)]
    )
    assert found.mismatch[0] == counts.min()
    assert found.ties[0] == (counts == counts.min()).sum()
    x, y = found.xy_px[0].astype(int)
    assert counts[y, x] == counts.min()
    # the segment is part of the image
    assert matcher.match(seed, footprint(15)).mismatch[0] >= counts.min()


# --- what the thesis says --------------------------------------------------------------------


def _scene(cameras, height_mm, seed=5):
    """Masks of random dots on a horizontal plane, as both cameras see them."""
    rng = np.random.default_rng(seed)
    first = rng.random(SIZE[::-1]) < 0.04
    row, column = np.nonzero(first)
    there = upper_plane_mapping(*cameras, np.column_stack([column, row]), height_mm).xy_px
    x, y = np.rint(there).astype(int).T
    second = np.zeros_like(first)
    inside = (x >= 1) & (y >= 1) & (x < SIZE[0] - 1) & (y < SIZE[1] - 1)
    for down in (-1, 0, 1):  # rounding moves a pixel by up to one
        for across in (-1, 0, 1):
            second[y[inside] + down, x[inside] + across] = True
    return first, second


@pytest.mark.parametrize("height", [-20.0, -5.0, 12.0])
def test_points_of_a_plane_are_found_where_the_plane_puts_them(height):
    cameras = _pair(STRONG, roll=0.3)
    masks = _scene(cameras, height)
    seeds = np.random.default_rng(6).uniform((40, 30), (160, 130), (60, 2))
    truth = upper_plane_mapping(*cameras, seeds, height).xy_px
    inner = ((truth > 25) & (truth < np.array(SIZE) - 25)).all(axis=1)
    assert inner.sum() > 25
    found = LiteralMatcher(cameras, masks, VOLUME).match(seeds[inner], footprint(25))
    away = np.linalg.norm(found.xy_px - truth[inner], axis=1)
    # dots widened by a pixel leave a pixel of play along the segment; 0.73, 0.5, 0.6 found
    assert np.median(away) < 0.9
    assert away.max() < 2.0
    assert (found.mismatch <= 0.1 * found.pixels).all()  # rounding twice, and other heights' scale


def test_if_not_equal_smaller_holds_only_if_the_second_camera_is_near_enough():
    """Section 5.5 says that the element mapped by Z_upper is never too large.

    Its size in view 2 is that of a patch of the ray's width, seen from camera 2: it grows with
    d1 / d2. Towards camera 1 the distance d1 falls by 1 per mm and d2 only by the cosine of the
    angle between the rays, so at the object, nearer than Z_upper, the true element is the
    smaller one, unless d2 is below about d1 times that cosine.
    """
    pixels = np.array([[x, y] for x in (50.0, 100.0, 150.0) for y in (40.0, 80.0, 120.0)])
    excess = {}
    for distance in (250.0, 350.0, 420.0, 500.0, 700.0):
        cameras = _pair(distance_2=distance)
        area = {
            z: np.abs(np.linalg.det(upper_plane_mapping(*cameras, pixels, z).jacobian))
            for z in (-20.0, 20.0)
        }
        excess[distance] = np.sqrt(area[-20.0] / area[20.0]) - 1  # mapped over true, as a length
    # measured: -8.5 %, -3.5 %, -1.4 %, +0.2 %, +2.6 % over a depth of 40 mm
    assert (excess[250.0] < -0.02).all()
    assert (excess[350.0] < 0).all()
    assert (excess[700.0] > 0.01).all()  # the claim is wrong here
    assert np.median(excess[500.0]) > 0  # and, barely, for cameras at equal distances
    assert np.abs(excess[500.0]).max() < 0.02  # 0.15 px at the rim of 15 x 15
    medians = [float(np.median(part)) for part in excess.values()]
    assert medians == sorted(medians)


# --- flags and bad input ---------------------------------------------------------------------


def test_an_element_without_edges_has_no_match():
    masks = _random_masks()
    nothing = np.zeros_like(masks[0])
    for pair in ((nothing, masks[1]), (masks[0], nothing), (nothing, nothing)):
        found = LiteralMatcher(_pair(), pair, VOLUME).match(_seeds(), footprint(15))
        assert np.isnan(found.xy_px).all()
        assert np.isnan(found.mismatch).all()
        without = found.flags[(found.flags & Flag.outside_image) == 0]
        assert len(without) > 10
        assert (without & Flag.no_edge).all()
        whole = LiteralMatcher(_pair(), pair, VOLUME).match(
            _seeds(2), footprint(15), whole_image=True
        )
        assert np.isnan(whole.xy_px).all()
        assert (whole.flags & Flag.no_edge).all()


@pytest.mark.parametrize("level", [0, 37, 255])
@pytest.mark.parametrize("original", [False, True])
def test_blank_and_saturated_images_have_no_edges(level, original):
    blank = np.full(SIZE[::-1], level, np.uint8)
    image = blank.copy()
    image[60:100, 80:120] = 200 if level < 100 else 20
    assert not binary_images((blank, blank), original=original)[0].any()
    for pair in ((blank, image), (blank, blank), (image, blank)):
        found = match_literal(pair, _pair(), [[80, 80], [100, 60]], VOLUME, original=original)
        assert np.isnan(found.xy_px).all()
        assert (found.flags == Flag.no_edge).all()


def test_original_images_are_thresholded_on_demand():
    image = np.full(SIZE[::-1], 20, np.uint8)
    image[60:100, 80:120] = 200
    edges, _ = binary_images((image, image))
    patch, _ = binary_images((image, image), original=True)
    assert (patch == (image > 100)).all()
    assert edges[60, 100]
    assert not edges[80, 100]


def test_seeds_that_do_not_exist():
    seeds = [[-0.6, 10], [np.nan, 3], [1e9, -1e9], [np.inf, 0], [100, 80]]
    matcher = LiteralMatcher(_pair(), _random_masks(), VOLUME)
    for whole in (False, True):
        found = matcher.match(seeds, footprint(9), whole_image=whole)
        assert np.isnan(found.xy_px[:4]).all()
        assert found.flags[0] & Flag.outside_image
        assert found.flags[1] == Flag.not_found
        assert found.flags[2] & Flag.outside_image
        assert found.flags[3] == Flag.not_found
        assert np.isfinite(found.xy_px[4]).all()
    assert len(matcher.match(np.empty((0, 2)), footprint(9))) == 0
    assert len(matcher.match([], footprint(9), whole_image=True)) == 0


def test_ties_choose_the_middle_and_are_flagged_when_apart():
    cameras = _pair()
    first = np.zeros(SIZE[::-1], np.bool_)
    first[80, 100] = True  # one pixel
    places = bands(cameras[1], sight_line(cameras[0], [[100.0, 80.0]], VOLUME), 0.5)
    line = [(int(y), int(x)) for y, x in zip(places.row[0], places.column[0], strict=True)]
    assert places.valid[0].all()

    def match(marks):
        second = np.zeros_like(first)
        for mark in marks:
            second[line[mark]] = True
        return LiteralMatcher(cameras, (first, second), VOLUME).match([[100, 80]], footprint(3))

    for marks, chosen, flag in (
        ([5], 5, Flag.none),
        ([5, 6], 5, Flag.none),
        ([5, 6, 7], 6, Flag.none),  # a run of three is one answer to within a pixel
        ([5, 6, 7, 8], 6, Flag.ambiguous),
        ([3, 12], 3, Flag.ambiguous),
        ([3, 12, 20], 12, Flag.ambiguous),
    ):
        found = match(marks)
        assert found.xy_px[0].tolist() == list(line[chosen][::-1])
        assert (found.mismatch[0], found.ties[0]) == (0, len(marks))
        assert found.flags[0] == flag


def test_an_element_that_is_cut_by_a_border_is_flagged():
    matcher = LiteralMatcher(_pair(), _random_masks(0.3), between_planes(-2, 2))
    found = matcher.match([[6.0, 80], [7, 80], [100, 80], [100, 153]], footprint(15))
    assert found.flags[0] & (Flag.at_border | Flag.outside_image)
    assert not found.flags[2] & Flag.at_border
    assert found.flags[3] & (Flag.at_border | Flag.outside_image)
    # pixels beyond image 1 do not exist, those beyond image 2 are missing
    inside = footprint(15)
    cameras, masks = _pair(), _random_masks(0.3)
    seed = np.array([100.0, 157.0])
    offsets = _offsets(cameras, masks[0], seed, inside)
    assert found.pixels[2] > len(offsets) > 0


def test_oversized_elements_are_refused():
    matcher = LiteralMatcher(_pair(), _random_masks(), VOLUME)
    with pytest.raises(InputError, match="161 px in an image of 160 px"):
        matcher.match([[100, 80]], np.ones((161, 161), np.bool_))
    matcher.match([[100, 80]], np.ones((159, 159), np.bool_))
    with pytest.raises(InputError, match="161 px"):
        match_literal([np.zeros(SIZE[::-1], np.uint8)] * 2, _pair(), [[1, 1]], VOLUME, side_px=161)


def test_an_element_that_view_2_magnifies_beyond_its_image_is_flagged():
    first, _ = _pair()
    near = looking_at_origin("near", angle_rad=0.3, distance_mm=40.0, focal_px=1400.0, size_px=SIZE)
    matcher = LiteralMatcher((first, near), _random_masks(0.3), between_planes(-1, 1))
    found = matcher.match([[100.0, 80.0]], footprint(59))
    assert found.flags[0] & Flag.outside_image
    assert np.isnan(found.xy_px).all()
    assert np.isfinite(matcher.match([[100.0, 80.0]], footprint(3)).xy_px).all()


@pytest.mark.parametrize("inside", [np.ones((3, 5)), np.zeros((5, 5)), np.ones(5), np.ones((4, 4))])
def test_footprints_that_are_none_are_refused(inside):
    matcher = LiteralMatcher(_pair(), _random_masks(), VOLUME)
    with pytest.raises(InputError, match="an element of"):
        matcher.match([[100, 80]], inside.astype(np.bool_))


def test_images_of_another_size_are_refused():
    good, wrong = np.zeros(SIZE[::-1], np.bool_), np.zeros(SIZE, np.bool_)
    with pytest.raises(InputError, match="'right' has 160x200 px, the camera 200x160"):
        LiteralMatcher(_pair(), (good, wrong), VOLUME)
    grey = np.zeros(SIZE, np.uint8)
    with pytest.raises(InputError, match="'left' has 160x200 px"):
        match_literal((grey, grey), _pair(), [[1, 1]], VOLUME)


@pytest.mark.parametrize("band", [0.0, 0.4, np.nan, 1001.0])
def test_bands_that_are_none_are_refused(band):
    matcher = LiteralMatcher(_pair(), _random_masks(), VOLUME, band_px=band)
    with pytest.raises(InputError, match="half-width"):
        matcher.match([[100, 80]], footprint(3))


def test_a_volume_that_view_2_does_not_see_is_flagged():
    first, second = _pair()
    away = _turned(second, [0.0, 0.9, 0.0])
    found = LiteralMatcher((first, away), _random_masks(), VOLUME).match(_seeds(), footprint(15))
    assert (found.flags & (Flag.outside_image | Flag.outside_volume)).all()
    assert np.isnan(found.xy_px).all()


def test_matches_become_rows():
    matcher = LiteralMatcher(_pair(), _random_masks(), VOLUME)
    found = matcher.match([[100.0, 80.0], [np.nan, 1], [-5, 3]], footprint(15))
    rows = found.to_correspondences(("left", "right"), ("a", "b", "c"), "p")
    assert rows.placement == ("p", "p", "p")
    assert rows.mismatch[0] == found.mismatch[0]
    assert rows.matched.tolist() == [True, False, False]
    assert np.isnan(rows.cov_px2[:, 0]).all()  # the seed's own is not known here
    assert np.array_equal(rows.cov_px2[0, 1], np.eye(2) / 3)
    assert np.isnan(rows.cov_px2[1:, 1]).all()
    assert rows.flags[1].tolist() == [Flag.not_found, Flag.not_found]
    assert rows.xy_px[2, 0].tolist() == [-5, 3]
    assert len(rows.to_image_points()) == 6


def test_progress_is_told():
    told = []
    matcher = LiteralMatcher(_pair(), _random_masks(), VOLUME)
    matcher.match(
        _seeds(3),
        footprint(3),
        whole_image=True,
        progress=lambda done, all_: told.append((done, all_)),
    )
    assert told == [(1, 3), (2, 3), (3, 3)]


@pytest.mark.parametrize("side_px", [10**20 + 1, 999_999])
def test_an_element_larger_than_the_image_is_refused_before_it_is_made(box_scene, side_px):
    images = list(box_scene.images.values())
    with pytest.raises(InputError, match="in an image of 256 px"):
        match_literal(
            images,
            box_scene.rig.cameras,
            [[100.0, 100.0]],
            box_scene.rig.volume_mm,
            side_px=side_px,
        )
