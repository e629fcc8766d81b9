import numpy as np
import pytest
from scipy.spatial import ConvexHull, HalfspaceIntersection

from closerange.errors import GeometryError, InputError
from closerange.geometry.transform import RigidTransform
from closerange.matching.common_view import (
    MIN_ANGLE_RAD,
    common_view,
    mean_direction,
    parallel_axes,
    propose_volume,
    shared_field,
)
from closerange.position import measure
from closerange.rig.camera import Camera
from closerange.rig.distortion import BrownIdeal
from closerange.verification.error_map import predict_errors
from closerange.verification.scenes import rig_a


def _polytope(halfspaces):
    return HalfspaceIntersection(halfspaces, np.zeros(3)).intersections


@pytest.mark.parametrize("angles", [(-0.3, 0.3), (-0.3, 0.1, 0.4)])
def test_without_a_lens_it_is_the_polytope_of_the_image_borders(setups, angles):
    cameras = setups.converged(focal=1400.0, angles=angles)
    corners = _polytope(setups.halfspaces(cameras))
    view = common_view(cameras, nodes=41)
    exact = ConvexHull(corners).volume
    assert view.volume_mm3 == pytest.approx(exact, rel=0.02)
    cell = np.array([axis[1] - axis[0] for axis in view.axes_mm])
    # the grid reaches as far as the region, and its outer nodes come within a few cells of it:
    # the region ends in points, which a cell does not fill
    assert (np.abs(view.box_mm[0] - corners.min(axis=0)) < 3 * cell).all()
    assert (np.abs(view.box_mm[1] - corners.max(axis=0)) < 3 * cell).all()
    nodes = np.stack(np.meshgrid(*view.axes_mm, indexing="ij"), axis=-1).reshape(-1, 3)
    assert np.array_equal(setups.seen(cameras, nodes), view.seen.ravel())
    assert np.array_equal(view.inside, view.seen == len(cameras))  # no flat angle here
    assert np.isfinite(view.std_mm[view.inside]).all()
    assert np.isnan(view.std_mm[~view.inside]).all()


def test_area_and_depth_range_follow_the_polytope(setups):
    cameras = setups.converged(focal=1400.0)
    corners = _polytope(setups.halfspaces(cameras))
    view = common_view(cameras, nodes=41)
    assert view.depth_axis == 2
    cell = view.depths_mm[1] - view.depths_mm[0]
    low, high = view.depth_range_mm
    assert low == pytest.approx(corners[:, 2].min(), abs=3 * cell)
    assert high == pytest.approx(corners[:, 2].max(), abs=3 * cell)
    halfspaces = setups.halfspaces(cameras)
    for index in (15, 25, 32):
        # the cut of the polytope at this depth, from its 2-D half-planes
        flat = np.column_stack(
            [halfspaces[:, :2], halfspaces[:, 2] * view.depths_mm[index] + halfspaces[:, 3]]
        )
        flat = flat[np.linalg.norm(flat[:, :2], axis=1) > 0]
        cut = HalfspaceIntersection(flat, np.zeros(2)).intersections
        assert view.area_mm2[index] == pytest.approx(ConvexHull(cut).volume, rel=0.06)


def test_expected_errors_are_those_of_the_error_map():
    scene = rig_a()
    rig = scene.true_rig()
    view = common_view(rig, nodes=9)
    assert view.noise_px == rig.noise_px
    rows = np.argwhere(view.inside)
    for i, j, k in rows[:: max(1, len(rows) // 5)]:
        at = np.array([view.axes_mm[0][i], view.axes_mm[1][j], view.axes_mm[2][k]])
        expected = predict_errors(rig, np.stack([at, at]), nodes=1).std_mm[0]
        assert np.allclose(view.std_mm[i, j, k], expected, rtol=1e-9)
    doubled = common_view(rig, nodes=9, noise_px=2 * rig.noise_px)
    assert np.allclose(doubled.depth_std_mm, 2 * view.depth_std_mm, equal_nan=True)


def test_parallel_cameras_end_where_their_rays_cross_at_one_degree(setups):
    assert pytest.approx(measure.MIN_ANGLE_RAD) == MIN_ANGLE_RAD
    view = common_view(setups.parallel(), nodes=41)
    low, high = 1000 - np.array(view.depth_range_mm)[::-1]
    assert low > 100 * 1200 / 640  # they begin to overlap at f B / W = 187.5 mm
    assert high == pytest.approx(100 / MIN_ANGLE_RAD, rel=0.03)
    depth = 1000 - view.depths_mm
    std = view.depth_std_mm
    middle = np.isfinite(std) & (depth > 1000)
    # Z^2 / (f B) times sqrt(2) for 1 px
    expected = depth**2 / (1200 * 100) * np.sqrt(2)
    assert np.allclose(std[middle], expected[middle], rtol=0.05)


def test_fewer_cameras_see_more_and_a_margin_sees_less(setups):
    cameras = setups.converged(angles=(-0.5, 0.0, 0.5))
    everyone = common_view(cameras)
    two = common_view(cameras, least=2)
    assert (everyone.least, two.least) == (3, 2)
    assert two.volume_mm3 > 1.2 * everyone.volume_mm3
    assert two.seen[two.inside].min() == 2
    narrow = common_view(cameras, margin_px=60)
    assert narrow.volume_mm3 < 0.8 * everyone.volume_mm3
    nodes = np.stack(np.meshgrid(*narrow.axes_mm, indexing="ij"), axis=-1)[narrow.inside]
    for camera in cameras:
        xy = camera.project(nodes)
        assert xy.min() >= 59.5 - 1e-9
        assert (xy <= np.array(camera.size_px) - 60.5 + 1e-9).all()


def test_the_depth_axis_is_the_one_along_which_the_cameras_look(setups):
    cameras = setups.converged()
    assert mean_direction(cameras) @ [0, 0, -1] == pytest.approx(1)
    aside = setups.moved_world(cameras, [np.pi / 2, 0, 0])
    assert common_view(aside).depth_axis == 1
    assert common_view(setups.moved_world(cameras, [0, np.pi / 2, 0])).depth_axis == 0


@pytest.mark.parametrize(
    "message", ["no place that 2 of the cameras c0, c1 see", "stand in one place"]
)
def test_cameras_without_a_common_view_are_told_so(setups, message):
    cameras = setups.parallel(baseline=0.0)
    if "no place" in message:  # back to back
        cameras = setups.converged()
        pose = cameras[1].camera_from_world
        flip = np.diag([-1.0, 1, -1])
        cameras[1] = Camera(
            "c1",
            cameras[1].size_px,
            cameras[1].matrix_px,
            RigidTransform(flip @ pose.rotation, flip @ pose.translation_mm),
        )
    for function in (common_view, propose_volume):
        with pytest.raises(GeometryError, match=message) as error:
            function(cameras)
        assert error.value.remedy


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"least": 1}, "1 cameras of 2"),
        ({"least": 3}, "3 cameras of 2"),
        ({"margin_px": 256}, "a margin of 256 px"),
        ({"margin_px": -1}, "a margin of -1 px"),
    ],
)
def test_impossible_options_are_refused(setups, options, message):
    with pytest.raises(InputError, match=message):
        propose_volume(setups.converged(), **options)
    with pytest.raises(InputError, match="1 camera"):
        common_view(setups.converged()[:1])


# --- shared field ----------------------------------------------------------------------------


def test_parallel_cameras_share_less_the_nearer_the_plane(setups):
    cameras = setups.parallel()
    for z in (700.0, 400.0, 0.0):
        share = 1 - 1200 * 100 / (1000 - z) / 640  # less the disparity f B / Z
        assert np.allclose(shared_field(cameras, [0, 0, z]), share, atol=1 / 41)
    assert shared_field(cameras, [0, 0, 850]).tolist() == [0, 0]


def test_turned_cameras_are_parallel_and_stay_where_they_are(setups):
    cameras = setups.converged(lens=BrownIdeal(k1=-0.1))
    turned = parallel_axes(cameras)
    for before, after in zip(cameras, turned, strict=True):
        assert np.allclose(before.centre_mm, after.centre_mm, atol=1e-9)
        assert np.allclose(after.camera_from_world.rotation[2], [0, 0, -1], atol=1e-12)
        assert after.distortion == before.distortion
        # by the least angle: about an axis across both, without roll
        assert np.allclose(after.camera_from_world.rotation[1], [0, -1, 0], atol=1e-12)
    assert (shared_field(turned, np.zeros(3)) < shared_field(cameras, np.zeros(3)) - 0.2).all()
    again = parallel_axes(turned)
    for before, after in zip(turned, again, strict=True):
        assert np.allclose(
            before.camera_from_world.rotation, after.camera_from_world.rotation, atol=1e-12
        )


def test_three_cameras_two_of_which_must_see(setups):
    cameras = [*setups.parallel(), setups.converged()[0]]
    two = shared_field(cameras, np.zeros(3), least=2)
    assert (two >= shared_field(cameras, np.zeros(3))).all()
