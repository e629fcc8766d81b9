import numpy as np
import pytest

from closerange.errors import InputError
from closerange.flags import Flag
from closerange.matching.correspondences import Correspondences
from closerange.position.measure import measure_points
from closerange.verification.scenes import rig_a


def _three():
    """Two cameras; the second point is occluded in the right one, the third seed saturated."""
    xy = np.arange(12.0).reshape(3, 2, 2)
    xy[1, 1] = np.nan
    return Correspondences.of(
        cameras=["left", "right"],
        point=["a", "b", "c"],
        placement="part",
        xy_px=xy,
        cov_px2=np.broadcast_to(0.01 * np.eye(2), (3, 2, 2, 2)),
        mismatch=[0.1, np.nan, 0.3],
        flags=[[0, 0], [0, Flag.occluded], [Flag.saturated, Flag.aperture]],
    )


def test_seed_and_match_keep_their_own_flags():
    matches = _three()
    assert len(matches) == 3
    assert matches.flags.tolist() == [[0, 0], [0, Flag.occluded], [Flag.saturated, Flag.aperture]]
    assert matches.point_flags.tolist() == [0, Flag.occluded, Flag.saturated | Flag.aperture]
    assert matches.found.tolist() == [[True, True], [True, False], [True, True]]
    assert matches.matched.tolist() == [True, False, True]
    assert matches.clean.tolist() == [True, False, False]


def test_arrays_are_copies_and_read_only():
    xy = np.zeros((1, 2, 2))
    matches = Correspondences.of(cameras=["l", "r"], point=["a"], xy_px=xy)
    xy[:] = 7
    assert not matches.xy_px.any()
    with pytest.raises(ValueError, match="read-only"):
        matches.xy_px[0, 0, 0] = 1
    with pytest.raises(ValueError, match="read-only"):
        matches.flags[0, 0] = 1


def test_a_matcher_must_say_why_there_is_no_match():
    xy = np.array([[[1.0, 2.0], [np.nan, np.nan]]])
    with pytest.raises(ValueError, match="point 'a', camera 'r': no position and no flag"):
        Correspondences.of(cameras=["l", "r"], point=["a"], xy_px=xy)
    flagged = Correspondences.of(
        cameras=["l", "r"], point=["a"], xy_px=xy, flags=[[0, Flag.no_edge]]
    )
    assert not flagged.matched.any()


def test_half_a_position_is_none():
    xy = np.array([[[1.0, 2.0], [np.nan, 5.0]]])
    matches = Correspondences.of(cameras="lr", point=["a"], xy_px=xy, flags=[[0, Flag.not_found]])
    assert np.isnan(matches.xy_px[0, 1]).all()


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"xy_px": np.zeros((2, 3, 2))}, "xy_px has shape"),
        ({"cameras": ["l", "l"]}, "named twice"),
        ({"mismatch": [1.0, 2.0]}, "mismatch has shape"),
        ({"flags": [[0, 0], [0, 0]]}, "shape|broadcast"),
        ({"placement": ["x", "y"]}, "differ in length"),
    ],
)
def test_columns_of_other_lengths_are_refused(change, message):
    good = {"cameras": ["l", "r"], "point": ["a"], "xy_px": np.zeros((1, 2, 2))}
    with pytest.raises(ValueError, match=message):
        Correspondences.of(**{**good, **change})


def test_a_point_that_appears_twice_is_refused_but_a_reading_is_not():
    twice = {"cameras": ["l", "r"], "point": ["a", "a"], "xy_px": np.zeros((2, 2, 2))}
    with pytest.raises(InputError, match="point 'a' of placement '' appears twice"):
        Correspondences.of(**twice)
    assert len(Correspondences.of(**twice, reading=["1", "2"])) == 2
    assert len(Correspondences.of(**twice, placement=["1", "2"])) == 2


def test_select_by_mask_and_by_index_and_nothing():
    matches = _three()
    assert matches.select([True, False, True]).point == ("a", "c")
    assert matches.select([2, 0]).mismatch.tolist() == [0.3, 0.1]
    assert matches.select([2]).flags.tolist() == [[Flag.saturated, Flag.aperture]]
    none = matches.select([])
    assert len(none) == 0
    assert none.cameras == ("left", "right")
    assert len(none.to_image_points()) == 0
    assert none.point_flags.shape == (0,)


def test_no_points_at_all():
    none = Correspondences.of(cameras=["l", "r"], point=[], xy_px=[])
    assert none.xy_px.shape == (0, 2, 2)
    assert none.flags.shape == (0, 2)


def test_sum_has_all_cameras_and_a_camera_not_asked_has_no_row():
    matches = _three()
    more = Correspondences.of(
        cameras=["left", "third"], point=["d"], placement="part", xy_px=np.ones((1, 2, 2))
    )
    both = matches + more
    assert both.cameras == ("left", "right", "third")
    assert both.point == ("a", "b", "c", "d")
    assert np.isnan(both.xy_px[3, 1]).all()
    assert both.flags[3].tolist() == [0, 0, 0]
    assert both.xy_px[3, 2].tolist() == [1, 1]
    points = both.to_image_points()
    assert [c for c, p in zip(points.camera, points.point, strict=True) if p == "d"] == [
        "left",
        "third",
    ]
    with pytest.raises(InputError, match="appears twice"):
        matches + matches


def test_image_points_have_a_row_for_each_view_that_was_asked():
    points = _three().to_image_points()
    assert points.point == ("a", "a", "b", "b", "c", "c")
    assert points.camera == ("left", "right") * 3
    assert points.flags.tolist() == [0, 0, 0, Flag.occluded, Flag.saturated, Flag.aperture]
    assert points.found.tolist() == [True, True, True, False, True, True]
    assert np.array_equal(points.cov_px2[5], 0.01 * np.eye(2))


def test_measure_works_on_matches():
    rig = rig_a().true_rig()
    xyz = np.array([[10.0, -20.0, 5.0], [0.0, 0.0, 0.0], [30.0, 20.0, -10.0]])
    names = [camera.name for camera in rig.cameras]
    xy = np.stack([camera.project(xyz) for camera in rig.cameras], axis=1)
    xy[1, 1:] = np.nan
    flags = np.zeros(xy.shape[:2], int)
    flags[1, 1:] = Flag.occluded
    flags[2, 1] = Flag.aperture
    matches = Correspondences.of(cameras=names, point=["a", "b", "c"], xy_px=xy, flags=flags)
    positions = measure_points(rig, matches.to_image_points())
    assert positions.point == ("a", "b", "c")
    assert np.abs(positions.xyz_mm[[0, 2]] - xyz[[0, 2]]).max() < 1e-8
    assert np.isnan(positions.xyz_mm[1]).all()
    assert positions.flags[0] == 0
    assert positions.flags[1] & Flag.single_view
    assert positions.flags[1] & Flag.occluded
    assert positions.flags[2] == Flag.aperture
