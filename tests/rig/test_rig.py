"""The rig as a type."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from closerange.errors import InputError
from closerange.rig.rig import Residuals, Trust
from closerange.verification.scenes import rig_b


def rig(**changes):
    return replace(rig_b().true_rig(), **changes)


def test_cameras_are_found_by_name():
    assert rig().camera("right").name == "right"
    with pytest.raises(InputError, match="camera 'Right' is not in the rig; it has left, right"):
        rig().camera("Right")


def test_cameras_have_different_names():
    left = rig().cameras[0]
    for cameras in ((), (left, left)):
        with pytest.raises(ValueError, match="different names"):
            rig(cameras=cameras)


def test_parameters_of_a_camera_also_when_names_hold_dots():
    left, right = rig().cameras
    names = ("a.fx", "a.b.fx", "a.tx", "a.b.tx")
    one = rig(
        cameras=(replace(left, name="a"), replace(right, name="a.b")),
        parameters=names,
        parameter_cov=np.eye(4),
    )
    assert one.parameters_of("a") == (["fx", "tx"], [0, 2])
    assert one.parameters_of("a.b") == (["fx", "tx"], [1, 3])
    assert one.parameters_of("b") == ([], [])


def test_shapes_are_checked_and_arrays_frozen():
    with pytest.raises(ValueError, match="parameter_cov has shape"):
        rig(parameters=("left.fx",), parameter_cov=np.eye(2))
    with pytest.raises(ValueError, match="volume_mm has shape"):
        rig(volume_mm=np.zeros(6))
    with pytest.raises(ValueError, match="lower corner"):
        rig(volume_mm=np.array([[0, 0, 1], [1, 1, 0]]))
    with pytest.raises(ValueError, match="lower corner"):
        rig(volume_mm=np.full((2, 3), np.nan))
    with pytest.raises(ValueError, match="read-only"):
        rig().volume_mm[0, 0] = 1


def test_trusted_unless_judged_untrustworthy():
    trust = Trust("untrustworthy", np.ones(3), np.ones(3))
    assert rig().trusted
    assert rig(trust=replace(trust, verdict="fair")).trusted
    assert rig(trust=replace(trust, verdict="good")).trusted
    assert not rig(trust=trust).trusted


def test_trust_reads_as_a_sentence_in_micrometres():
    trust = Trust("good", [0.0042, 0.0123, 1.5], np.zeros(3))
    assert str(trust) == "good: predicted error 4.2 um (X) 12 um (Y) 1500 um (Z)"
    with pytest.raises(ValueError, match="verdict 'fine'"):
        Trust("fine", np.zeros(3), np.zeros(3))


def test_residuals_have_columns_of_one_length():
    whole = {
        "camera": ("a", "a"),
        "placement": ("", ""),
        "point": ("1", "2"),
        "xyz_mm": np.zeros((2, 3)),
        "xy_px": np.zeros((2, 2)),
        "residual_px": np.zeros((2, 2)),
        "fitted": np.array([True, False]),
        "flags": np.zeros(2),
    }
    residuals = Residuals(**whole)
    assert len(residuals) == 2
    assert not residuals.fitted.flags.writeable
    for name, short in (
        ("placement", ("",)),
        ("point", ("1",)),
        ("xyz_mm", np.zeros((1, 3))),
        ("fitted", np.array([True])),
        ("flags", np.zeros(3)),
    ):
        with pytest.raises(ValueError):
            Residuals(**{**whole, name: short})
