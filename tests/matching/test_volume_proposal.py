import json

import numpy as np
import pytest

from closerange.errors import GeometryError, InputError
from closerange.geometry.transform import RigidTransform
from closerange.matching.common_view import (
    check_in_view,
    common_view,
    parallel_axes,
    propose_volume,
    shared_field,
)
from closerange.matching.search import between_planes
from closerange.rig.camera import Camera
from closerange.rig.distortion import BrownIdeal


@pytest.mark.parametrize(
    "name",
    ["converged", "three", "strong lens", "far", "turned", "far, turned"],
)
def test_all_of_the_proposed_volume_is_in_view_and_evenly_accurate(setups, name):
    cameras, box = setups.cameras(name), setups.proposal(name)
    assert (box[0] < box[1]).all()
    points = setups.in_box(box)
    assert (setups.seen(cameras, points) == len(cameras)).all()
    jacobians = np.concatenate([camera.project_jacobian(points) for camera in cameras], axis=1)
    cov = np.linalg.inv(np.swapaxes(jacobians, 1, 2) @ jacobians)
    error = np.sqrt(np.einsum("nii->n", cov))
    assert error.max() <= 2.15 * error.min()  # 2, but for the nodes between


@pytest.mark.parametrize("name", ["converged", "long lens"])
def test_the_proposal_is_as_good_as_a_box_can_be(setups, name):
    cameras = setups.cameras(name)
    halfspaces = setups.halfspaces(cameras)
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

    low, high = setups.proposal(name)
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


def test_parallel_cameras_are_given_a_volume_near_them(setups):
    box = setups.proposal("parallel")
    assert np.array_equal(propose_volume(setups.parallel()), box)  # the same each time
    near, far = 1000 - box[1, 2], 1000 - box[0, 2]
    # (W/f Z - B) Z / Z^3 of the cross section at the near end is largest at Z = 2 f B / W = 375;
    # the error grows with Z^2 and may double: far / near = sqrt 2
    assert 330 < near < 430
    assert far / near == pytest.approx(np.sqrt(2), abs=0.05)


def test_wide_lenses_are_given_a_volume_where_they_cross_not_far_behind(setups):
    # the borders of the images diverge: the region reaches to rays that cross at 1 degree, 17 m
    cameras, box = setups.cameras("wide lens"), setups.proposal("wide lens")
    assert common_view(cameras).depth_range_mm[0] < -10_000
    assert (box[0] < 0).all()
    assert (box[1] > 0).all()
    assert (box[1] - box[0]).max() < 400


def test_a_closer_look_at_a_part(setups):
    cameras, box = setups.cameras("wide lens"), setups.proposal("wide lens")
    view = common_view(cameras, nodes=5, within_mm=box)
    assert view.inside.all()
    assert view.volume_mm3 == pytest.approx(np.prod(box[1] - box[0]))
    with pytest.raises(GeometryError, match="no place in the box"):
        common_view(cameras, within_mm=box + np.array([0.0, 0.0, 5000.0]))


def test_sides_are_round_numbers(setups):
    box = setups.proposal("converged")
    size = box[1] - box[0]
    places = 2 - np.floor(np.log10(size)).astype(int)
    for axis in range(3):
        assert np.array_equal(np.round(box[:, axis], places[axis]), box[:, axis])


def test_a_proposal_with_fewer_cameras_and_a_margin(setups):
    cameras = setups.converged(angles=(-0.5, 0.0, 0.5))
    box = propose_volume(cameras, least=2, margin_px=20)
    assert (setups.seen(cameras, setups.in_box(box)) >= 2).all()
    everyone = propose_volume(cameras, margin_px=20)
    xy = np.concatenate([c.project(setups.in_box(everyone)) for c in cameras])
    assert xy.min() >= 19.5 - 1e-6


def test_rendered_rig_a(setups, shared):
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
    assert (setups.seen(pair, setups.in_box(box)) == 2).all()
    # the plates of its calibration fill 100 mm: the proposal has room for most of it
    assert (box[1] - box[0] > 95).all()
    shares = shared_field(pair, box.mean(axis=0))
    assert (shares > 0.8).all()
    assert not shared_field(parallel_axes(pair), box.mean(axis=0)).any()  # Fig. 5.1: nothing left


# --- a volume that no one sees ---------------------------------------------------------------


def test_a_volume_in_view_passes(setups):
    cameras = setups.cameras("converged")
    check_in_view(cameras, setups.proposal("converged"))
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
def test_a_volume_out_of_view_is_refused(setups, volume, message):
    with pytest.raises(GeometryError, match=message):
        check_in_view(setups.converged(), volume)


def test_a_volume_of_which_each_camera_sees_another_part_is_refused(setups):
    with pytest.raises(GeometryError, match="no place of the volume is seen by two cameras"):
        check_in_view(setups.parallel(), [[-200, -50, 850], [200, 50, 900]])


def test_a_proposal_keeps_within_limits(setups):
    """Above a table and up to a height; as good there as the best box of the whole view."""
    cameras, whole = setups.cameras("converged"), setups.proposal("converged")
    middle = whole[:, 2].mean()
    box = propose_volume(cameras, within_mm=between_planes(middle, middle + 30))
    assert box[0, 2] == pytest.approx(middle, abs=0.1)
    assert box[1, 2] == pytest.approx(middle + 30, abs=0.1)
    assert (setups.seen(cameras, setups.in_box(box)) == 2).all()
    assert (box[1] - box[0] >= 0.9 * (whole[1] - whole[0]))[:2].all(), "as wide as without limits"
    thin = propose_volume(cameras, within_mm=between_planes(middle, middle + 0.1))
    assert middle <= thin[0, 2] < thin[1, 2] <= middle + 0.1
    far = whole[0, 2] - 1e5
    with pytest.raises(GeometryError, match="no place within the limits") as error:
        propose_volume(cameras, within_mm=between_planes(far, far + 1))
    assert "widen the limits" in error.value.remedy


def test_limits_without_room_between_them_are_refused(box_scene):
    flat = [[-50, -50, 5], [50, 50, 5]]
    with pytest.raises(InputError, match="Z = 5 mm"):
        propose_volume(box_scene.rig.cameras, within_mm=flat)
