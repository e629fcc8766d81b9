import numpy as np
import pytest

from closerange.errors import TableError
from closerange.features.image_points import ImagePoints
from closerange.features.points_table import read_points, write_points
from closerange.flags import Flag
from closerange.matching.correspondences import Correspondences
from closerange.matching.matches_table import read_matches, write_matches
from closerange.verification.scenes import rig_a
from closerange.workflows.measure import measure


def _matches():
    rng = np.random.default_rng(5)
    xy = rng.uniform(0, 600, (4, 3, 2))
    xy[1, 1:] = np.nan
    xy[2, 2] = np.nan
    flags = np.zeros((4, 3), int)
    flags[1] = Flag.saturated, Flag.outside_image, Flag.no_edge | Flag.occluded
    flags[2, 2] = Flag.inconsistent
    flags[3, 1] = Flag.aperture
    root = rng.normal(0, 0.1, (4, 3, 2, 2))
    cov = root @ np.swapaxes(root, 2, 3) + 1e-4 * np.eye(2)
    cov[1:, 2] = np.nan
    return Correspondences.of(
        cameras=["left", "right", "third, the new one"],
        point=["01", "1", "a.b", "- x"],
        placement=["p", "p", "p", "q"],
        reading=["1", "1", "2", ""],
        xy_px=xy,
        cov_px2=cov,
        mismatch=[0.125, np.nan, 1 / 3, 0.0],
        flags=flags,
    )


def _same(first, second):
    for name in ("placement", "point", "reading", "cameras"):
        assert getattr(first, name) == getattr(second, name)
    for name in ("xy_px", "cov_px2", "mismatch", "flags"):
        assert np.array_equal(getattr(first, name), getattr(second, name), equal_nan=True), name


def test_round_trip_is_exact_and_byte_identical(tmp_path):
    matches = _matches()
    matches.to_csv(tmp_path / "one.csv")
    back = read_matches(tmp_path / "one.csv")
    # a covariance that was not symmetric to the last bit is read as its upper triangle
    assert np.allclose(back.cov_px2, matches.cov_px2, rtol=0, atol=1e-16, equal_nan=True)
    _same(back, read_matches(tmp_path / "one.csv"))
    assert np.array_equal(back.xy_px, matches.xy_px, equal_nan=True)
    assert np.array_equal(back.flags, matches.flags)
    assert np.array_equal(back.mismatch, matches.mismatch, equal_nan=True)
    back.to_csv(tmp_path / "two.csv")
    assert (tmp_path / "one.csv").read_bytes() == (tmp_path / "two.csv").read_bytes()


def test_a_camera_that_only_later_points_were_asked_for_round_trips(tmp_path):
    outer = Correspondences.of(cameras=["left", "third"], point=["a"], xy_px=np.ones((1, 2, 2)))
    inner = Correspondences.of(cameras=["left", "right"], point=["b"], xy_px=np.ones((1, 2, 2)))
    last = Correspondences.of(
        cameras=["left", "right", "third"], point=["c"], xy_px=np.full((1, 3, 2), 2.5)
    )
    both = outer + (last + inner).select([1, 0])
    # the table names left, third, right in this order, and the last point's rows in another
    swapped = last + inner + outer
    for matches in (both, swapped.select([2, 1, 0])):
        matches.to_csv(tmp_path / "one.csv")
        back = read_matches(tmp_path / "one.csv")
        assert np.isnan(back.xy_px).any()
        back.to_csv(tmp_path / "two.csv")
        assert (tmp_path / "one.csv").read_bytes() == (tmp_path / "two.csv").read_bytes()


def test_the_seed_row_is_repeated_unmoved(tmp_path):
    seed = np.array([123.45678901234567, 1 / 3])
    points = ImagePoints.of(camera="left", point=["s"], xy_px=[seed], flags=[Flag.at_border])
    write_points(points, tmp_path / "seeds.csv")
    xy = np.stack([points.xy_px[0], [np.nan, np.nan]])[None]
    matches = Correspondences.of(
        cameras=["left", "right"],
        point=["s"],
        xy_px=xy,
        flags=[[points.flags[0], Flag.outside_volume]],
    )
    write_matches(matches, tmp_path / "matches.csv")
    both = read_points(tmp_path / "matches.csv")
    assert both.keys()[0] == read_points(tmp_path / "seeds.csv").keys()[0]
    assert both.xy_px[0].tolist() == seed.tolist()
    assert both.flags.tolist() == [Flag.at_border, Flag.outside_volume]


def test_it_is_a_points_table_which_measure_reads_without_warning(tmp_path):
    rig = rig_a().true_rig()
    xyz = np.array([[10.0, -20.0, 5.0], [30.0, 20.0, -10.0]])
    xy = np.stack([camera.project(xyz) for camera in rig.cameras], axis=1)
    names = [camera.name for camera in rig.cameras]
    matches = Correspondences.of(
        cameras=names, point=["a", "b"], xy_px=xy, mismatch=[0.1, 0.2], placement="part"
    )
    matches.to_csv(tmp_path / "m.csv")
    assert (tmp_path / "m.csv").read_text().splitlines()[0] == (
        "camera,placement,point,x_px,y_px,mismatch,flags"
    )
    positions = measure(rig, tmp_path / "m.csv")  # a warning would be an error here
    assert np.abs(positions.xyz_mm - xyz).max() < 1e-8
    assert not positions.flags.any()
    assert np.array_equal(measure(rig, matches).xyz_mm, positions.xyz_mm)


def test_a_points_table_without_mismatch_is_a_matches_table(tmp_path):
    path = tmp_path / "p.csv"
    path.write_text("point,camera,x_px,y_px\na,l,1,2\nb,l,3,4\na,r,5,6\nb,r,7,8\n")
    matches = read_matches(path)
    assert matches.point == ("a", "b")
    assert matches.cameras == ("l", "r")
    assert matches.xy_px.tolist() == [[[1, 2], [5, 6]], [[3, 4], [7, 8]]]
    assert np.isnan(matches.mismatch).all()


def test_rows_in_contradictory_orders_are_read(tmp_path):
    path = tmp_path / "p.csv"
    path.write_text("point,camera,x_px,y_px\na,l,1,2\na,r,5,6\nb,r,7,8\nb,l,3,4\n")
    matches = read_matches(path)
    assert matches.cameras == ("l", "r")
    assert matches.xy_px[1].tolist() == [[3, 4], [7, 8]]


@pytest.mark.parametrize(
    ("rows", "message"),
    [
        ("a,l,1,2,0.5,\na,r,1,2,0.25,\n", "row 3, column 'mismatch': 0.25, but 0.5 in another"),
        ("a,l,1,2,-1,\n", "row 2, column 'mismatch': -1.0; expected 0 or more"),
        ("a,l,1,2,much,\n", "row 2, column 'mismatch': 'much' is not a number"),
        ("a,l,,,0.5,\n", "row has no flag"),
        ("a,l,1,2,,\na,l,1,2,,\n", "is also in row 2"),
        ("a,l,1,2,,lost\n", "unknown flag 'lost'"),
    ],
)
def test_a_broken_table_names_its_cell(tmp_path, rows, message):
    path = tmp_path / "m.csv"
    path.write_text("point,camera,x_px,y_px,mismatch,flags\n" + rows)
    with pytest.raises(TableError, match=message):
        read_matches(path)


def test_mismatch_may_stand_in_one_row_only(tmp_path):
    path = tmp_path / "m.csv"
    path.write_text("point,camera,x_px,y_px,mismatch\na,l,1,2,\na,r,1,2,0.25\n")
    assert read_matches(path).mismatch.tolist() == [0.25]
