from dataclasses import replace

import numpy as np
import pytest

from closerange.errors import GeometryError, InputError
from closerange.geometry.transform import RigidTransform
from closerange.matching.proposed_volume import survey_volume
from closerange.matching.sight import between_planes
from closerange.verification.error_map import predict_errors
from closerange.verification.scenes import SyntheticRig


def _rig(cameras, volume=((-20.0, -20.0, -20.0), (20.0, 20.0, 20.0))):
    return SyntheticRig("s", tuple(cameras), np.array(volume), 0.05).true_rig()


@pytest.fixture(scope="module")
def surveyed(setups):
    rig = _rig(setups.converged())
    return rig, survey_volume(rig)


def test_a_proposal_knows_its_errors_and_the_volume_in_use(setups, surveyed):
    rig, found = surveyed
    np.testing.assert_array_equal(found.volume_mm, setups.proposal("converged"))
    np.testing.assert_array_equal(found.calibrated_mm, rig.volume_mm)
    assert found.calibrated_seen == 1.0
    assert found.view.noise_px == rig.noise_px
    low, high = found.volume_mm
    nodes = np.stack(np.meshgrid(*(np.linspace(low, high, 3).T), indexing="ij"), -1).reshape(-1, 3)
    std = np.array([predict_errors(rig, np.stack([at, at]), nodes=1).std_mm[0] for at in nodes])
    assert (std >= found.std_mm[0] * (1 - 1e-6)).all()
    assert (std <= found.std_mm[1] * (1 + 1e-6)).all()
    # corners and the middle are among the nodes that both looked at
    np.testing.assert_allclose(found.std_mm[1], std.max(axis=0), rtol=1e-6)
    assert ((found.shared > 0.5) & (found.shared <= 1)).all()


def test_a_volume_half_out_of_view_is_told_so(setups):
    cameras = setups.converged()
    half = [[0.0, -5.0, -5.0], [2 * _edge(setups, cameras), 5.0, 5.0]]
    assert survey_volume(_rig(cameras, half)).calibrated_seen == pytest.approx(0.5, abs=0.06)


def _edge(setups, cameras):
    """Return how far along X both cameras see, by bisection."""
    low, high = 0.0, 1000.0
    for _ in range(40):
        middle = (low + high) / 2
        seen = setups.seen(cameras, np.array([[middle, 0.0, 0.0]]))[0] == 2
        low, high = (middle, high) if seen else (low, middle)
    return low


def test_where_not_all_cameras_share_a_place_as_many_as_do_are_taken(setups):
    cameras = setups.converged(angles=(-0.3, 0.0, 0.3))
    pose, back = cameras[2].camera_from_world, np.diag([-1.0, 1.0, -1.0])
    turned = RigidTransform(back @ pose.rotation, back @ pose.translation_mm)
    rig = _rig([*cameras[:2], replace(cameras[2], camera_from_world=turned)])
    found = survey_volume(rig)
    assert found.view.least == 2
    assert (setups.seen(cameras[:2], setups.in_box(found.volume_mm)) == 2).all()
    with pytest.raises(GeometryError, match="no place that 3 of the cameras"):
        survey_volume(rig, least=3)


def test_limits_and_single_cameras(surveyed):
    rig, _ = surveyed
    found = survey_volume(rig, within_mm=between_planes(-10, 10))
    np.testing.assert_allclose(found.volume_mm[:, 2], [-10, 10], atol=0.1)
    with pytest.raises(InputError, match="1 camera"):
        survey_volume(replace(rig, cameras=rig.cameras[:1]))
