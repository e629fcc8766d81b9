import json

import numpy as np
import pytest
from scipy.spatial import ConvexHull, HalfspaceIntersection

from closerange.errors import GeometryError, InputError
from closerange.geometry.transform import RigidTransform, rotation_from_vector
from closerange.matching.common_view import (
    MIN_ANGLE_RAD,
    check_in_view,
    common_view,
    mean_direction,
    parallel_axes,
    propose_volume,
    shared_field,
)
from closerange.matching.search import between_planes, inside_image
from closerange.position import measure
from closerange.rig.camera import Camera
from closerange.rig.distortion import BrownIdeal
from closerange.verification.error_map import predict_errors
from closerange.verification.scenes import looking_at_origin, rig_a, strong_lens_rig


def _converged(focal=900.0, lens=None, angles=(-0.3, 0.3), size=(640, 512)):
    return [
        looking_at_origin(
            f"c{i}",
            angle_rad=angle,
            distance_mm=500.0,
            focal_px=focal,
            distortion=lens,
            size_px=size,
        )
        for i, angle in enumerate(angles)
    ]


def _parallel(baseline=100.0, focal=1200.0):
    matrix = np.array([[focal, 0, 319.5], [0, focal, 255.5], [0, 0, 1]])
    return [
        Camera(name, (640, 512), matrix, RigidTransform(np.diag([1.0, -1, -1]), [x, 0.0, 1000.0]))
        for name, x in (("left", baseline / 2), ("right", -baseline / 2))
    ]


def _moved_world(cameras, turn):
    """Return the same cameras in a world frame that is turned."""
    rotation = rotation_from_vector(turn)
    return [
        Camera(
            c.name,
            c.size_px,
            c.matrix_px,
            RigidTransform(
                c.camera_from_world.rotation @ rotation.T, c.camera_from_world.translation_mm
            ),
            c.distortion,
        )
        for c in cameras
    ]


def _halfspaces(cameras):
    """Each border of each image is a plane of the world: a . X + b <= 0 inside."""
    rows = []
    for camera in cameras:
        p = camera.projection_matrix
        width, height = camera.size_px
        for axis, size in ((0, width), (1, height)):
            rows.append(-(p[axis] + 0.5 * p[2]))
            rows.append(p[axis] - (size - 0.5) * p[2])
        rows.append(-p[2])
    return np.array(rows)


def _polytope(cameras):
    return HalfspaceIntersection(_halfspaces(cameras), np.zeros(3)).intersections


def _seen(cameras, xyz):
    return np.sum([inside_image(camera, camera.project(xyz)) for camera in cameras], axis=0)


def _in_box(box, count=1000, seed=3):
    rng = np.random.default_rng(seed)
    points = rng.uniform(box[0], box[1], (count, 3))
    corners = [[box[(i >> axis) & 1, axis] for axis in range(3)] for i in range(8)]
    return np.concatenate([points, corners])


# --- common view -----------------------------------------------------------------------------


@pytest.mark.parametrize("angles", [(-0.3, 0.3), (-0.3, 0.1, 0.4)])
def test_without_a_lens_it_is_the_polytope_of_the_image_borders(angles):
    cameras = _converged(focal=1400.0, angles=angles)
    corners = _polytope(cameras)
    view = common_view(cameras, nodes=41)
    exact = ConvexHull(corners).volume
    assert view.volume_mm3 == pytest.approx(exact, rel=0.02)
    cell = np.array([axis[1] - axis[0] for axis in view.axes_mm])
    # the grid reaches as far as the region, and its outer nodes come within a few cells of it:
    # the region ends in points, which a cell does not fill
    assert (np.abs(view.box_mm[0] - corners.min(axis=0)) < 3 * cell).all()
    assert (np.abs(view.box_mm[1] - corners.max(axis=0)) < 3 * cell).all()
    nodes = np.stack(np.meshgrid(*view.axes_mm, indexing="ij"), axis=-1).reshape(-1, 3)
    assert np.array_equal(_seen(cameras, nodes), view.seen.ravel())
    assert np.array_equal(view.inside, view.seen == len(cameras))  # no flat angle here
    assert np.isfinite(view.std_mm[view.inside]).all()
    assert np.isnan(view.std_mm[~view.inside]).all()


def test_area_and_depth_range_follow_the_polytope():
    cameras = _converged(focal=1400.0)
    corners = _polytope(cameras)
    view = common_view(cameras, nodes=41)
    assert view.depth_axis == 2
    cell = view.depths_mm[1] - view.depths_mm[0]
    low, high = view.depth_range_mm
    assert low == pytest.approx(corners[:, 2].min(), abs=3 * cell)
    assert high == pytest.approx(corners[:, 2].max(), abs=3 * cell)
    halfspaces = _halfspaces(cameras)
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


def test_parallel_cameras_end_where_their_rays_cross_at_one_degree():
    assert pytest.approx(measure.MIN_ANGLE_RAD) == MIN_ANGLE_RAD
    view = common_view(_parallel(), nodes=41)
    low, high = 1000 - np.array(view.depth_range_mm)[::-1]
    assert low > 100 * 1200 / 640  # they begin to overlap at f B / W = 187.5 mm
    assert high == pytest.approx(100 / MIN_ANGLE_RAD, rel=0.03)
    depth = 1000 - view.depths_mm
    std = view.depth_std_mm
    middle = np.isfinite(std) & (depth > 1000)
    # Z^2 / (f B) times sqrt(2) for 1 px
    expected = depth**2 / (1200 * 100) * np.sqrt(2)
    assert np.allclose(std[middle], expected[middle], rtol=0.05)


def test_fewer_cameras_see_more_and_a_margin_sees_less():
    cameras = _converged(angles=(-0.5, 0.0, 0.5))
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


def test_the_depth_axis_is_the_one_along_which_the_cameras_look():
    cameras = _converged()
    assert mean_direction(cameras) @ [0, 0, -1] == pytest.approx(1)
    aside = _moved_world(cameras, [np.pi / 2, 0, 0])
    assert common_view(aside).depth_axis == 1
    assert common_view(_moved_world(cameras, [0, np.pi / 2, 0])).depth_axis == 0


@pytest.mark.parametrize(
    ("cameras", "message"),
    [
        (_converged(), "no place that 2 of the cameras c0, c1 see"),
        (_parallel(baseline=0.0), "stand in one place"),
    ],
)
def test_cameras_without_a_common_view_are_told_so(cameras, message):
    if "no place" in message:  # back to back
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
def test_impossible_options_are_refused(options, message):
    with pytest.raises(InputError, match=message):
        propose_volume(_converged(), **options)
    with pytest.raises(InputError, match="1 camera"):
        common_view(_converged()[:1])


# --- proposed volume -------------------------------------------------------------------------


@pytest.mark.parametrize(
    "cameras",
    [
        _converged(),
        _converged(angles=(-0.3, 0.1, 0.5)),
        list(strong_lens_rig().cameras),
        _parallel(baseline=20.0, focal=4000.0),
        _moved_world(_converged(), [0.5, 0.6, 0.3]),
        _moved_world(_parallel(baseline=20.0, focal=4000.0), [0.7, 0.4, 0.0]),
    ],
)
def test_all_of_the_proposed_volume_is_in_view_and_evenly_accurate(cameras):
    box = propose_volume(cameras)
    assert (box[0] < box[1]).all()
    points = _in_box(box)
    assert (_seen(cameras, points) == len(cameras)).all()
    jacobians = np.concatenate([camera.project_jacobian(points) for camera in cameras], axis=1)
    cov = np.linalg.inv(np.swapaxes(jacobians, 1, 2) @ jacobians)
    error = np.sqrt(np.einsum("nii->n", cov))
    assert error.max() <= 2.15 * error.min()  # 2, but for the nodes between


@pytest.mark.parametrize("focal", [900.0, 3000.0])
def test_the_proposal_is_as_good_as_a_box_can_be(focal):
    cameras = _converged(focal=focal)
    halfspaces = _halfspaces(cameras)
    share = np.linspace(0, 1, 5)
    weight = np.outer(np.outer([1, 2, 2, 2, 1], [1, 2, 2, 2, 1]), [1, 2, 2, 2, 1]).ravel()

    def worth(low, high):
        """Count positions told apart in a box; 0 if it is not in view or not even."""
        axes = [low[i] + share * (high[i] - low[i]) for i in range(3)]
        nodes = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
        if (np.column_stack([nodes, np.ones(125)]) @ halfspaces.T > 0).any():
            return 0.0
        jacobians = np.concatenate([c.project_jacobian(nodes) for c in cameras], axis=1)
        normal = np.swapaxes(jacobians, 1, 2) @ jacobians
        error = np.sqrt(np.einsum("nii->n", np.linalg.inv(normal)))
        if error.max() > 2 * error.min():
            return 0.0
        return np.average(np.sqrt(np.linalg.det(normal)), weights=weight) * np.prod(high - low)

    low, high = propose_volume(cameras)
    found = best = worth(low, high)
    assert found > 0
    rng = np.random.default_rng(8)
    size = (high - low).min()
    for _ in range(800):  # a climb by chance steps of any size
        step = size * 10 ** rng.uniform(-3, 0)
        new = low + step * rng.normal(0, 1, 3), high + step * rng.normal(0, 1, 3)
        if (new[0] < new[1]).all() and (value := worth(*new)) > best:
            best, (low, high) = value, new
    assert found > 0.95 * best  # 0.983 and 0.993: the sides are rounded inwards


def test_parallel_cameras_are_given_a_volume_near_them():
    box = propose_volume(_parallel())
    assert np.array_equal(propose_volume(_parallel()), box)  # the same each time
    near, far = 1000 - box[1, 2], 1000 - box[0, 2]
    # (W/f Z - B) Z / Z^3 of the cross section at the near end is largest at Z = 2 f B / W = 375;
    # the error grows with Z^2 and may double: far / near = sqrt 2
    assert 330 < near < 430
    assert far / near == pytest.approx(np.sqrt(2), abs=0.05)


def test_wide_lenses_are_given_a_volume_where_they_cross_not_far_behind():
    # the borders of the images diverge: the region reaches to rays that cross at 1 degree, 17 m
    cameras = _converged(focal=700.0)
    assert common_view(cameras).depth_range_mm[0] < -10_000
    box = propose_volume(cameras)
    assert (box[0] < 0).all()
    assert (box[1] > 0).all()
    assert (box[1] - box[0]).max() < 400


def test_a_closer_look_at_a_part():
    cameras = _converged(focal=700.0)
    box = propose_volume(cameras)
    view = common_view(cameras, nodes=5, within_mm=box)
    assert view.inside.all()
    assert view.volume_mm3 == pytest.approx(np.prod(box[1] - box[0]))
    with pytest.raises(GeometryError, match="no place in the box"):
        common_view(cameras, within_mm=box + np.array([0.0, 0.0, 5000.0]))


def test_sides_are_round_numbers():
    box = propose_volume(_converged())
    size = box[1] - box[0]
    places = 2 - np.floor(np.log10(size)).astype(int)
    for axis in range(3):
        assert np.array_equal(np.round(box[:, axis], places[axis]), box[:, axis])


def test_a_proposal_with_fewer_cameras_and_a_margin():
    cameras = _converged(angles=(-0.5, 0.0, 0.5))
    box = propose_volume(cameras, least=2, margin_px=20)
    assert (_seen(cameras, _in_box(box)) >= 2).all()
    everyone = propose_volume(cameras, margin_px=20)
    xy = np.concatenate([c.project(_in_box(everyone)) for c in cameras])
    assert xy.min() >= 19.5 - 1e-6


def test_rendered_rig_a(shared):
    path = shared / "data" / "rendered" / "A_blocks" / "cameras.json"
    cameras = []
    for name, c in json.loads(path.read_text())["cameras"].items():
        k1, k2, p1, p2, k3 = c["dist_k1_k2_p1_p2_k3"]
        cameras.append(
            Camera(
                name,
                (c["width"], c["height"]),
                np.array(c["K"], float),
                RigidTransform(np.array(c["R"]), np.array(c["t_mm"])),
                BrownIdeal(k1, k2, p1, p2, k3),
            )
        )
    pair = cameras[:2]
    box = propose_volume(pair)
    assert (_seen(pair, _in_box(box)) == 2).all()
    # the plates of its calibration fill 100 mm: the proposal has room for most of it
    assert (box[1] - box[0] > 95).all()
    shares = shared_field(pair, box.mean(axis=0))
    assert (shares > 0.8).all()
    assert not shared_field(parallel_axes(pair), box.mean(axis=0)).any()  # Fig. 5.1: nothing left


# --- a volume that no one sees ---------------------------------------------------------------


def test_a_volume_in_view_passes():
    cameras = _converged()
    check_in_view(cameras, propose_volume(cameras))
    check_in_view(cameras, between_planes(-20, 20))
    check_in_view(cameras, [[-1e-3] * 3, [1e-3] * 3])  # smaller than the pixels that are tried
    check_in_view(cameras, np.zeros((2, 3)))
    check_in_view(cameras, [[-1e4] * 3, [1e4] * 3])  # with the cameras inside


@pytest.mark.parametrize(
    ("volume", "message"),
    [
        ([[900, 0, 0], [950, 50, 50]], "'c0' does not see the volume, which lies outside of its"),
        ([[-10, -10, 900], [10, 10, 950]], "'c0' does not see the volume, which lies behind it"),
        (between_planes(600, 700), "'c0' does not see the volume"),
    ],
)
def test_a_volume_out_of_view_is_refused(volume, message):
    with pytest.raises(GeometryError, match=message):
        check_in_view(_converged(), volume)


def test_a_volume_of_which_each_camera_sees_another_part_is_refused():
    with pytest.raises(GeometryError, match="no place of the volume is seen by two cameras"):
        check_in_view(_parallel(), [[-200, -50, 850], [200, 50, 900]])


# --- shared field ----------------------------------------------------------------------------


def test_parallel_cameras_share_less_the_nearer_the_plane():
    cameras = _parallel()
    for z in (700.0, 400.0, 0.0):
        share = 1 - 1200 * 100 / (1000 - z) / 640  # less the disparity f B / Z
        assert np.allclose(shared_field(cameras, [0, 0, z]), share, atol=1 / 41)
    assert shared_field(cameras, [0, 0, 850]).tolist() == [0, 0]


def test_turned_cameras_are_parallel_and_stay_where_they_are():
    cameras = _converged(lens=BrownIdeal(k1=-0.1))
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


def test_three_cameras_two_of_which_must_see():
    cameras = [*_parallel(), _converged()[0]]
    two = shared_field(cameras, np.zeros(3), least=2)
    assert (two >= shared_field(cameras, np.zeros(3))).all()
