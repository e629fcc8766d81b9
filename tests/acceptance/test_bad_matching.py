"""Images, points, volumes and options with which no match can or may be made."""

from __future__ import annotations

import csv
import json
from collections import Counter
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from closerange.features.image_points import ImagePoints
from closerange.features.points_table import read_points
from closerange.flags import Flag
from closerange.matching.matches_table import read_matches
from closerange.rig.rig import Trust
from closerange.rig.rig_file import write_rig


@dataclass(frozen=True)
class Folder:
    """A rig, two images and a table of points, of which a test spoils its own copy."""

    path: Path
    scene: object

    @property
    def rig(self):
        return self.path / "rig.json"

    def image(self, name, pixels=None):
        """Write another image; its NAME=IMAGE argument."""
        place = self.path / f"{name}.png"
        if pixels is not None:
            assert cv2.imwrite(str(place), pixels)
        return f"{name}={place}"

    def match(self, *more, left=None, right=None):
        return ["match", self.rig, left or self.image("left"), right or self.image("right"), *more]

    def seeds(self, xy_px, **columns):
        """Write points of the left camera."""
        names = columns.pop("point", [f"p{i}" for i in range(len(xy_px))])
        columns.setdefault("camera", "left")
        points = ImagePoints.of(point=names, xy_px=xy_px, **columns)
        points.to_csv(self.path / "seeds.csv")
        return ["--points", self.path / "seeds.csv"]


@pytest.fixture
def folder(tmp_path, box_scene):
    made = Folder(tmp_path, box_scene)
    write_rig(box_scene.rig, made.rig)
    for name, pixels in box_scene.images.items():
        made.image(name, pixels)
    return made


@pytest.fixture(scope="session")
def on_edges(box_scene):
    """Give a few points on edges that match well."""
    from closerange import Frame, match  # noqa: PLC0415

    frames = {name: Frame(name, pixels) for name, pixels in box_scene.images.items()}
    matches = match(box_scene.rig, frames, edges=True)
    rows = np.flatnonzero(matches.clean)[:: int(matches.clean.sum()) // 12]
    return matches.xy_px[rows, 0]


def summary(run, args, code, output):
    outcome = run(*args, "-o", output, "--json")
    assert outcome.code == code, outcome.stderr
    return json.loads(outcome.stdout), outcome.stderr


def wrong(scene, matches):
    """Return how far unflagged matches lie from the truth, px."""
    left, right = scene.rig.cameras
    seeds, found = matches.xy_px[matches.clean, 0], matches.xy_px[matches.clean, 1]
    height = scene.nearest_height(left, seeds)
    direction = left.directions(seeds)
    way = (height - left.centre_mm[2]) / direction[:, 2]
    truth = right.project(left.centre_mm + way[:, None] * direction)
    return np.linalg.norm(truth - found, axis=1)


def test_the_good_folder_matches_and_goes_straight_into_measure(folder, run, tmp_path):
    told, _ = summary(run, folder.match("--ply", tmp_path / "w.ply"), 0, tmp_path / "m.csv")
    assert told["unflagged"] >= 0.5 * told["points"]
    assert told["vertices"] >= 0.95 * told["unflagged"]
    assert told["lines"] >= 0.8 * told["vertices"]
    matches = read_matches(tmp_path / "m.csv")
    assert (wrong(folder.scene, matches) < 1.0).mean() >= 0.99
    counted = Counter(
        bit.name for flags in matches.point_flags for bit in Flag if bit in Flag(int(flags))
    )
    assert told["flags"] == dict(counted)
    outcome = run("measure", folder.rig, tmp_path / "m.csv", "-o", tmp_path / "p.csv")
    assert outcome.code == 0
    with (tmp_path / "p.csv").open(encoding="utf-8") as stream:
        rows = list(csv.DictReader(stream))
    clean = [row for row in rows if not row["flags"]]
    assert len(clean) >= 0.95 * told["unflagged"]


@pytest.mark.parametrize("which", ["left", "right"])
@pytest.mark.parametrize(
    ("grey", "noise"), [(0, 0.0), (255, 0.0), (120, 2.0)], ids=["black", "saturated", "blank"]
)
def test_a_uniform_image_is_refused(folder, refused, which, grey, noise):
    rng = np.random.default_rng(0)
    pixels = np.clip(rng.normal(grey, noise, (256, 320)).round(), 0, 255).astype(np.uint8)
    folder.image(which, pixels)
    refused(folder.match(), 1, f"{which}.png", "uniform", once=True)


def test_an_image_without_edges_is_refused(folder, refused):
    """A soft slope is no uniform image, but has nothing to be matched."""
    slope = np.tile(np.linspace(20, 200, 320), (256, 1))
    rng = np.random.default_rng(1)
    folder.image("left", np.rint(slope + rng.normal(0, 2, slope.shape)).astype(np.uint8))
    refused(folder.match(), 1, "'left' has no edges", once=True)
    refused(folder.match("--corners"), 1, "'left' has no corners", once=True)


def test_a_second_image_without_edges_gives_flagged_rows(folder, run, tmp_path):
    slope = np.tile(np.linspace(20, 200, 320), (256, 1))
    rng = np.random.default_rng(1)
    folder.image("right", np.rint(slope + rng.normal(0, 2, slope.shape)).astype(np.uint8))
    told, errors = summary(run, folder.match(), 1, tmp_path / "m.csv")
    assert told["unflagged"] == 0 < told["points"]
    assert "without a flag" in errors
    matches = read_matches(tmp_path / "m.csv")
    assert not matches.clean.any()


def test_a_blurred_image_makes_no_match_up(folder, run, tmp_path):
    """Focus lost in one view: fewer matches, none of them wrong."""
    folder.image("right", cv2.GaussianBlur(folder.scene.images["right"], (0, 0), 4.0))
    run(*folder.match(), "-o", tmp_path / "m.csv")
    matches = read_matches(tmp_path / "m.csv")
    error = wrong(folder.scene, matches)
    assert len(error) < 0.5 * len(matches)
    assert (error < 1.5).mean() >= 0.95 if len(error) else True


def test_saturated_parts_are_flagged(folder, run, tmp_path):
    bright = {
        name: np.clip(pixels.astype(float) * 1.6, 0, 255).astype(np.uint8)
        for name, pixels in folder.scene.images.items()
    }
    for name, pixels in bright.items():
        folder.image(name, pixels)
    run(*folder.match(), "-o", tmp_path / "m.csv")
    matches = read_matches(tmp_path / "m.csv")
    pixel = np.rint(matches.xy_px[:, 0]).astype(int)
    near = cv2.dilate((bright["left"] == 255).astype(np.uint8), np.ones((5, 5), np.uint8))
    beside = near[pixel[:, 1], pixel[:, 0]] > 0
    assert 0.2 < beside.mean() < 1.0
    assert ((matches.flags[:, 0] & Flag.saturated) != 0).tolist() == beside.tolist()


def test_images_of_another_size_are_refused(folder, refused):
    folder.image("right", folder.scene.images["right"][:, :300])
    refused(folder.match(), 2, "right.png", "300x256", "320x256", once=True)


def test_swapped_images_are_suspected_and_all_matches_flagged(folder, run, tmp_path):
    left, right = folder.scene.images["left"], folder.scene.images["right"]
    folder.image("left", right)
    folder.image("right", left)
    told, errors = summary(run, folder.match(), 1, tmp_path / "m.csv")
    assert "seem exchanged" in errors
    assert "seem exchanged" in told["doubt"]
    assert told["unflagged"] == 0
    matches = read_matches(tmp_path / "m.csv")
    found = matches.found[:, 1]
    assert (matches.flags[found, 1] & Flag.ambiguous).all()


def test_one_image_given_for_both_cameras_is_refused(folder, refused):
    folder.image("right", folder.scene.images["left"])
    refused(folder.match(), 2, "identical pixels", once=True)


def test_one_image_alone_and_one_camera_twice_are_refused(folder, refused):
    args = ["match", folder.rig, folder.image("left")]
    refused(args, 2, "1 image", "NAME=IMAGE", once=True)
    twice = ["match", folder.rig, folder.image("left"), f"left={folder.path / 'right.png'}"]
    refused(twice, 2, "'left'", "two images", once=True)


def test_unknown_cameras_missing_files_and_malformed_arguments_are_refused(folder, refused):
    args = ["match", folder.rig, folder.image("left")]
    refused([*args, f"middle={folder.path / 'right.png'}"], 2, "'middle'", "left, right", once=True)
    refused([*args, f"right={folder.path / 'none.png'}"], 2, "none.png", once=True)
    refused([*args, str(folder.path / "right.png")], 2, "NAME=IMAGE", once=True)
    refused([*args, "=right.png"], 2, "NAME=IMAGE", once=True)


@pytest.mark.parametrize(
    ("volume", "words"),
    [
        ((-40, -40, 900, 40, 40, 1000), "behind it"),
        ((500, 500, -20, 600, 600, 20), "outside of its image"),
    ],
)
def test_a_volume_out_of_view_is_refused(folder, refused, volume, words):
    refused(folder.match("--volume", *volume), 1, "does not see the volume", words, once=True)


def test_volumes_that_are_none_are_refused(folder, refused):
    refused(folder.match("--z", 30, -30), 2, "30.0 to -30.0", once=True)
    refused(folder.match("--z", "nan", 3), 2, "not finite", once=True)
    box = ("--volume", -9, -9, -9, 9, 9, 9)
    refused(folder.match("--z", -30, 30, *box), 2, "--z and --volume", once=True)


@pytest.mark.parametrize("size", [0, 1, -5, 14, 301])
def test_an_empty_or_oversized_element_is_refused(folder, refused, size):
    refused(folder.match("--method", "literal", "--element", size), 2, str(size), once=True)


def test_options_that_contradict_each_other_are_refused(folder, refused):
    seeds = folder.seeds([[100.0, 100.0]])
    refused(folder.match("--edges", "--corners"), 2, "edges and corners", once=True)
    refused(folder.match(*seeds, "--edges"), 2, "points and edges", once=True)
    refused(folder.match("--element", 15), 2, "default method", once=True)
    refused(folder.match("--method", "magic"), 2, "'magic'", "literal", once=True)
    refused(folder.match("--corners", "--method", "literal"), 2, "corners", once=True)


def test_points_outside_and_without_a_position_stay_as_flagged_rows(
    folder, run, tmp_path, on_edges
):
    xy = [*on_edges, (-30.0, 40.0), (5000.0, 9.0), (np.nan, np.nan)]
    names = [*(f"good{i}" for i in range(len(on_edges))), "out", "far", "lost"]
    flags = [0] * (len(xy) - 1) + [int(Flag.not_found)]
    args = folder.match(*folder.seeds(xy, point=names, flags=flags))
    told, _ = summary(run, args, 0, tmp_path / "m.csv")
    assert told["points"] == len(xy)
    matches = read_matches(tmp_path / "m.csv")
    assert matches.point == tuple(names)
    np.testing.assert_array_equal(matches.xy_px[:, 0], xy)
    assert matches.clean[: len(on_edges)].mean() >= 0.7
    assert list(matches.flags[-3:, 0]) == [Flag.outside_image, Flag.outside_image, Flag.not_found]
    assert list(matches.flags[-3:, 1]) == [Flag.outside_image, Flag.outside_image, Flag.not_found]
    assert np.isnan(matches.xy_px[-3:, 1]).all()
    outcome = run("measure", folder.rig, tmp_path / "m.csv", "-o", tmp_path / "p.csv")
    assert outcome.code == 0, outcome.stderr


@pytest.mark.parametrize("method", ["default", "literal"])
def test_only_hopeless_points_exit_with_1_and_a_table(folder, run, tmp_path, method):
    seeds = folder.seeds([(-30.0, 40.0), (3.0, 3.0)])
    told, _ = summary(run, folder.match(*seeds, "--method", method), 1, tmp_path / "m.csv")
    assert told["unflagged"] == 0
    matches = read_matches(tmp_path / "m.csv")
    assert (matches.flags[:, 1] != 0).all()


def test_a_point_with_half_a_position_and_no_flag_is_refused(folder, refused):
    args = folder.match(*folder.seeds([[100.0, 100.0]]))
    place = folder.path / "seeds.csv"
    place.write_text("camera,point,x_px,y_px\nleft,a,nan,100\n", encoding="utf-8")
    refused(args, 2, "seeds.csv", "x_px", once=True)


def test_an_empty_table_of_points_is_refused(folder, refused):
    args = folder.match(*folder.seeds([[100.0, 100.0]]))
    (folder.path / "seeds.csv").write_text("camera,point,x_px,y_px\n", encoding="utf-8")
    refused(args, 2, "seeds.csv", "without rows", once=True)


def test_points_of_several_cameras_placements_or_readings_are_refused(folder, refused):
    xy = [[100.0, 100.0], [120.0, 100.0]]
    both = folder.seeds(xy, camera=["left", "right"])
    refused(folder.match(*both), 2, "2 cameras", "left, right", once=True)
    foreign = folder.seeds(xy, camera="third")
    refused(folder.match(*foreign), 2, "'third'", once=True)
    several = folder.seeds(xy, placement=["a", "b"])
    refused(folder.match(*several), 2, "2 placements", "--placement", once=True)
    refused(folder.match(*several, "--placement", "c"), 2, "'c'", once=True)
    repeated = folder.seeds(xy, point=["p", "p"], reading=["1", "2"])
    refused(folder.match(*repeated), 2, "2 readings", once=True)


def test_one_placement_of_several_may_be_chosen_and_all_columns_are_kept(
    folder, run, tmp_path, on_edges
):
    count = len(on_edges)
    cov = np.tile([[0.02, 0.005], [0.005, 0.01]], (count, 1, 1))
    flags = np.where(np.arange(count) == 0, int(Flag.low_contrast), 0)
    seeds = folder.seeds(
        [*on_edges, (9.0, 9.0)],
        placement=["now"] * count + ["then"],
        reading="7",
        cov_px2=[*cov, np.full((2, 2), np.nan)],
        flags=[*flags, 0],
    )
    run(*folder.match(*seeds, "--placement", "now"), "-o", tmp_path / "m.csv")
    rows = read_points(tmp_path / "m.csv").of_camera("left")
    assert set(rows.placement) == {"now"}
    assert set(rows.reading) == {"7"}
    np.testing.assert_array_equal(rows.xy_px, on_edges)
    np.testing.assert_array_equal(rows.cov_px2, cov)
    np.testing.assert_array_equal(rows.flags, flags)
    matches = read_matches(tmp_path / "m.csv")
    assert matches.flags[0, 1] & Flag.low_contrast, "a match carries the flags of its point"


def test_two_cameras_at_one_place_are_refused(folder, refused, box_scene):
    left = box_scene.rig.cameras[0]
    write_rig(replace(box_scene.rig, cameras=(left, replace(left, name="right"))), folder.rig)
    refused(folder.match("--z", -30, 30), 2, "'left'", "'right'", "0 mm apart", once=True)


def test_two_answers_that_fit_as_well_are_never_given_unflagged(folder, run, tmp_path):
    """Equal stripes a few pixels apart: every one of them fits every other."""
    rng = np.random.default_rng(3)
    stripe = np.where((np.arange(320) // 6) % 2, 60.0, 180.0)
    for name in ("left", "right"):
        picture = np.full((256, 320), 60.0)
        picture[100:150] = np.roll(stripe, 5 if name == "right" else 0)
        soft = cv2.GaussianBlur(picture, (0, 0), 0.7)
        folder.image(name, np.rint(soft + rng.normal(0, 1.5, soft.shape)).astype(np.uint8))
    outcome = run(*folder.match("--z", -40, 40), "-o", tmp_path / "m.csv")
    matches = read_matches(tmp_path / "m.csv")
    assert len(matches) > 1500
    assert matches.clean.mean() < 0.02
    assert "match without a flag" in outcome.stderr  # as a warning, or as the error


def test_an_untrusted_rig_marks_every_match(folder, run, tmp_path, box_scene):
    nothing = np.full(3, 5.0)
    trust = Trust("untrustworthy", nothing, nothing, ("one plane",))
    write_rig(replace(box_scene.rig, trust=trust), folder.rig)
    told, _ = summary(run, folder.match(), 1, tmp_path / "m.csv")
    matches = read_matches(tmp_path / "m.csv")
    found = matches.found[:, 1]
    assert found.any()
    assert (matches.flags[found, 1] & Flag.untrusted).all()
    assert not (matches.flags[:, 0] & Flag.untrusted).any()
    assert told["views"]["left"]["unflagged"] == told["points"]


def test_images_of_16_bits_and_of_colour_match_as_grey_ones_do(folder, run, tmp_path):
    """Colours become grey as Y = 0.299 R + 0.587 G + 0.114 B, with a warning."""
    told, _ = summary(run, folder.match(), 0, tmp_path / "m8.csv")
    for name, pixels in folder.scene.images.items():
        folder.image(name, pixels.astype(np.uint16) * 250)
    deep, _ = summary(run, folder.match(), 0, tmp_path / "m16.csv")
    assert abs(deep["unflagged"] - told["unflagged"]) <= 0.02 * told["points"]
    for name, pixels in folder.scene.images.items():
        folder.image(name, cv2.merge([pixels, pixels, pixels]))
    colour, errors = summary(run, folder.match(), 0, tmp_path / "mc.csv")
    assert colour["unflagged"] == told["unflagged"]
    assert "colour" in errors


def test_an_output_that_is_an_input_is_refused_before_the_work(folder, run):
    outcome = run(*folder.match(), "-o", folder.path / "right.png")
    assert outcome.code == 2
    assert "destroy the input" in outcome.stderr
