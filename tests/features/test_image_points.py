"""Image points as a type."""

from __future__ import annotations

import numpy as np
import pytest

from closerange.errors import InputError
from closerange.features.image_points import ImagePoints
from closerange.flags import Flag


def two(camera="left", **more):
    return ImagePoints.of(camera=camera, point=["1", "01"], xy_px=[[1, 2], [3, 4]], **more)


def test_what_is_not_known_is_nan_blank_or_zero():
    points = two()
    assert points.placement == points.reading == ("", "")
    assert points.flags.tolist() == [0, 0]
    matrices = (("cov_px2", (2, 2, 2)), ("noise_cov_px2", (2, 2, 2)))
    for name, shape in (*matrices, ("ellipse", (2, 3)), ("disc_diameter_mm", (2,))):
        assert getattr(points, name).shape == shape
        assert np.isnan(getattr(points, name)).all()
    assert points.size_px == {}


def test_one_value_for_all_rows():
    points = two(placement="a", cov_px2=np.eye(2), disc_diameter_mm=16.0)
    assert points.placement == ("a", "a")
    assert points.disc_diameter_mm.tolist() == [16, 16]
    assert (points.cov_px2 == np.eye(2)).all()


def test_arrays_are_copies_that_cannot_be_written():
    xy = np.array([[1.0, 2], [3, 4]])
    points = ImagePoints.of(camera="c", point=["a", "b"], xy_px=xy)
    xy[0, 0] = 99
    assert points.xy_px[0, 0] == 1
    with pytest.raises(ValueError, match="read-only"):
        points.xy_px[0, 0] = 5


def test_names_are_opaque():
    assert two().keys() == [("left", "", "", "1"), ("left", "", "", "01")]


def test_a_row_that_appears_twice_is_refused():
    with pytest.raises(InputError, match="point 'a' of camera 'left', placement 'p' appears twice"):
        ImagePoints.of(camera="left", placement="p", point=["a", "a"], xy_px=np.zeros((2, 2)))


@pytest.mark.parametrize("different", ["camera", "placement", "reading"])
def test_the_same_point_in_another_camera_placement_or_reading_is_another_row(different):
    names = {"camera": "c", different: ["a", "b"]}
    assert len(ImagePoints.of(point=["1", "1"], xy_px=np.zeros((2, 2)), **names)) == 2


def test_columns_of_unequal_length_are_refused():
    with pytest.raises(ValueError, match="placement has 3 rows, camera has 2"):
        two(placement=["a", "b", "c"])
    with pytest.raises(ValueError):
        ImagePoints.of(camera="c", point=["a"], xy_px=np.zeros((2, 2)))


def test_join():
    joined = two(size_px={"left": (640, 480)}) + two("right", size_px={"right": (800, 600)})
    assert joined.cameras == ("left", "right")
    assert joined.size_px == {"left": (640, 480), "right": (800, 600)}
    assert joined.xy_px.tolist() == [[1, 2], [3, 4], [1, 2], [3, 4]]


def test_join_refuses_a_row_in_both():
    with pytest.raises(InputError, match="twice"):
        two() + two()


def test_join_refuses_two_image_sizes_of_one_camera():
    with pytest.raises(InputError, match="640x480 and of 480x640"):
        two(size_px={"left": (640, 480)}) + two(placement="b", size_px={"left": (480, 640)})


def test_select_by_mask_and_by_index():
    points = two("left", flags=[0, int(Flag.blurred)]) + two("right")
    assert points.select(points.flags == 0).point == ("1", "1", "01")
    reordered = points.select([3, 0])
    assert reordered.camera == ("right", "left")
    assert reordered.xy_px.tolist() == [[3, 4], [1, 2]]
    assert points.of_camera("right").camera == ("right", "right")
    assert len(points.of_camera("none")) == 0
    assert len(points.select([])) == 0


def test_noise_keeps_its_row():
    noise = np.array([np.eye(2), 2 * np.eye(2)])
    joined = two("left", noise_cov_px2=noise) + two("right")
    np.testing.assert_array_equal(joined.noise_cov_px2[:2], noise)
    assert np.isnan(joined.noise_cov_px2[2:]).all()
    assert joined.select([3, 1]).noise_cov_px2[1, 0, 0] == 2
    with pytest.raises(ValueError, match="read-only"):
        joined.noise_cov_px2[0, 0, 0] = 5
    with pytest.raises(ValueError):
        two(noise_cov_px2=np.zeros((3, 2, 2)))


def test_found():
    points = ImagePoints.of(
        camera="c", point=["a", "b", "c"], xy_px=[[1, 2], [np.nan, np.nan], [1, np.nan]]
    )
    assert points.found.tolist() == [True, False, False]


def test_a_crop_changes_nothing_but_the_position():
    points = two(
        noise_cov_px2=np.eye(2) / 3,
        cov_px2=np.eye(2),
        ellipse=[5.0, 4.0, 0.3],
        flags=[1, 2],
        size_px={"left": (640, 480)},
    )
    moved = points.shifted([100, 50])
    assert moved.xy_px.tolist() == [[101, 52], [103, 54]]
    for name in ("cov_px2", "noise_cov_px2", "ellipse", "flags"):
        assert (getattr(moved, name) == getattr(points, name)).all()
    assert moved.keys() == points.keys()
    assert moved.size_px == {}


def test_no_rows():
    empty = ImagePoints.of(camera="c", point=[], xy_px=[])
    assert len(empty) == 0
    assert empty.cameras == ()
    assert len(empty + two()) == 2


@pytest.mark.parametrize("name", ["cov_px2", "noise_cov_px2"])
@pytest.mark.parametrize(
    "matrix",
    [
        [[1e-3, 1.0], [1.0, 1e-3]],
        [[0.0, 0.0], [0.0, 0.0]],
        [[-1.0, 0.0], [0.0, 1.0]],
        [[1.0, 1.0], [1.0, 1.0]],
        [[1.0, 0.1], [0.2, 1.0]],
        [[1.0, np.nan], [np.nan, 1.0]],
        [[np.inf, 0.0], [0.0, 1.0]],
    ],
    ids=["indefinite", "zero", "negative", "singular", "unsymmetric", "in part", "infinite"],
)
def test_what_is_no_covariance_is_refused_by_name(name, matrix):
    cov = np.array([np.eye(2), matrix])
    with pytest.raises(InputError, match=f"camera 'left', point '01': {name} = .* not a covarianc"):
        two(**{name: cov})


def test_covariances_that_rounding_made_unsymmetric_are_fine():
    cov = np.array([[1.0, 0.3], [0.3 * (1 + 1e-12), 2.0]])
    kept = two(cov_px2=cov).cov_px2[0]
    np.testing.assert_array_equal(kept, kept.T)
    assert kept[0, 1] == (cov[0, 1] + cov[1, 0]) / 2
