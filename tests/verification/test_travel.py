"""Regular errors of a positioning device: found where they are, silent where they are not."""

from __future__ import annotations

import re
import warnings
from importlib.resources import files
from pathlib import Path

import numpy as np
import pytest

from closerange.errors import CloseRangeWarning
from closerange.features.control import ControlPoints, read_control
from closerange.flags import Flag
from closerange.position.positions import Positions
from closerange.rig.calibrate import calibrate_rig
from closerange.verification.scenes import observe, rig_a, rig_b
from closerange.verification.travel import travel_hints, truth_hints
from closerange.workflows.detect import detect

NOISE_PX = 0.05


def plate(heights=7, xs=(0.0,)):
    """Make nine points at several heights and places along x."""
    rows = [
        (f"z{k}x{x:g}", f"r{r}c{c}", ((c - 1) * 40.0 + x, (1 - r) * 40.0, z))
        for k, z in enumerate(np.linspace(-45.0, 45.0, heights))
        for x in xs
        for r in range(3)
        for c in range(3)
    ]
    placement, point, xyz = zip(*rows, strict=True)
    return ControlPoints.of(point, xyz, placement=placement)


def hints_of(true, error_mm, seed=0, rig=None, model="brown"):
    """Calibrate with wrong control rows; the cameras see the true ones."""
    rig = rig or rig_a()
    rng = np.random.default_rng(seed)
    points = observe(rig.cameras, true, noise_px=NOISE_PX, rng=rng)
    wrong = ControlPoints.of(true.point, true.xyz_mm + error_mm, placement=true.placement)
    sizes = {camera.name: camera.size_px for camera in rig.cameras}
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", CloseRangeWarning)
        return travel_hints(calibrate_rig(points, wrong, sizes, model=model))


def error_of(true, axis, size):
    """Return errors along one axis, from a function of the placement's name and the point."""
    error = np.zeros((len(true), 3))
    error[:, axis] = [size(*pair) for pair in zip(true.placement, true.xyz_mm, strict=True)]
    return error


def numbers(hint):
    return [float(text) for text in re.findall(r"[+-]\d+\.\d+", hint)]


@pytest.mark.parametrize("rig", [rig_a(), rig_b()], ids="ab")
def test_good_control_is_not_suspected(rig):
    """At one alarm in a hundred calibrations twenty show none; the half of squares sees to it."""
    true = plate(xs=(-10.0, 10.0))
    assert [hints_of(true, np.zeros((len(true), 3)), seed, rig) for seed in range(20)] == [[]] * 20


@pytest.mark.parametrize("size", [0.2, 1.0, 5.0])
@pytest.mark.parametrize("axis", [0, 1, 2])
def test_shift_of_one_placement(axis, size):
    true = plate()
    (hint,) = hints_of(true, error_of(true, axis, lambda name, _: size * (name == "z2x0")))
    assert "placement 'z2x0'" in hint
    expected = np.zeros(3)
    expected[axis] = size
    # nine points in two cameras: 0.006 mm across, 0.02 mm in depth; large errors are linearised
    np.testing.assert_allclose(numbers(hint)[:3], expected, atol=0.03 + 0.02 * size)


def test_shift_of_all_later_placements():
    true = plate()
    (hint,) = hints_of(true, error_of(true, 2, lambda _, xyz: 1.0 * (xyz[2] > 20)))
    assert "z_mm is" in hint
    assert "from z = 31 mm on" in hint
    assert numbers(hint)[0] == pytest.approx(1.0, abs=0.1)


def test_scale_of_the_travel_along_x():
    """Three places along x: a scale is told from a step."""
    true = plate(3, xs=(-30.0, 0.0, 30.0))
    places = np.array([float(name.split("x")[1]) for name in true.placement])
    error = np.zeros((len(true), 3))
    error[:, 0] = 0.01 * places
    (hint,) = hints_of(true, error)
    assert "distances along x are" in hint
    assert " or " not in hint.partition(":")[0]
    assert numbers(hint)[0] == pytest.approx(1.0, abs=0.1)


def test_what_cannot_be_told_apart_is_named_together():
    """Two places: a scale, a step and a shift of either are one and the same."""
    true = plate(3, xs=(-20.0, 20.0))
    (hint,) = hints_of(true, error_of(true, 0, lambda name, _: 0.4 * name.endswith("x20")))
    assert "distances along x" in hint
    assert ", or x_mm is" in hint


def test_a_scale_of_all_depths_leaves_no_trace():
    true = plate()
    assert hints_of(true, true.xyz_mm * [0, 0, 0.016]) == []


def test_random_errors_of_the_control_points_are_not_regular():
    """Each point off by 0.1 mm, ten times the noise: the residuals are large, the hint absent."""
    true = plate()
    for seed in range(5):
        error = np.random.default_rng(seed).normal(0, 0.1, (len(true), 3))
        assert hints_of(true, error, seed) == []


def test_the_demonstration_is_not_suspected():
    """Rendered images: what errors there are come from pixels."""
    folder = Path(str(files("closerange.workflows") / "demo_data"))
    points = None
    for camera in ("left", "right"):
        images = [folder / f"calibration/{camera}_z{z}.png" for z in ("-50.0", "+00.0", "+50.0")]
        found = detect(
            images, target=folder / "plate.toml", camera=camera, placement_pattern="_(z.*)$"
        )
        points = found if points is None else points + found
    rig = calibrate_rig(points, read_control(folder / "control.csv"), points.size_px)
    assert travel_hints(rig) == []


def measured(error_mm, truth, std_mm=0.01, flags=0, stated_mm=None):
    """Return positions that differ from the truth by given and by random errors."""
    stated_mm = stated_mm or std_mm
    count = len(truth)
    noise = np.random.default_rng(0).normal(0, std_mm, (count, 3))
    return Positions(
        placement=truth.placement, point=truth.point, xyz_mm=truth.xyz_mm + error_mm + noise,
        cov_mm2=np.tile(np.eye(3) * stated_mm**2, (count, 1, 1)), residual_px=np.zeros(count),
        reading=("",) * count, cameras=np.full(count, 2), flags=np.broadcast_to(flags, (count,)),
    )  # fmt: skip


@pytest.fixture
def truth():
    """Ninety random positions of one point in a cube of 100 mm."""
    xyz = np.random.default_rng(7).uniform(-50, 50, (90, 3))
    return ControlPoints.of(["p"] * 90, xyz, placement=[f"n{i}" for i in range(90)])


def test_verification_without_regular_errors(truth):
    assert truth_hints(measured(0.0, truth), truth) == []


def test_an_origin_somewhere_else_is_no_error_of_travel(truth):
    assert truth_hints(measured([5.0, 0, 0], truth), truth) == []


def test_scale_of_one_axis_in_a_verification(truth):
    (hint,) = truth_hints(measured(truth.xyz_mm * [0, -0.002, 0], truth), truth)
    assert "distances along y are" in hint
    assert numbers(hint)[0] == pytest.approx(0.2, abs=0.01)  # of the truth: it is too long


def test_lost_turn_in_a_verification(truth):
    error = np.zeros((90, 3))
    error[truth.xyz_mm[:, 0] > 10, 0] = -0.635
    (hint,) = truth_hints(measured(error, truth), truth)
    first = truth.xyz_mm[truth.xyz_mm[:, 0] > 10, 0].min()
    assert f"from x = {first:g} mm on" in hint
    assert numbers(hint)[0] == pytest.approx(0.635, abs=0.01)


def test_an_error_within_the_stated_uncertainty_is_left_to_it(truth):
    """A scale as large as the calibration's own share: the covariances cover it."""
    error = truth.xyz_mm * [0, 0, 0.0005]  # 0.025 mm at the ends
    assert truth_hints(measured(error, truth, std_mm=0.001), truth) != []
    assert truth_hints(measured(error, truth, std_mm=0.001, stated_mm=0.01), truth) == []


def test_flagged_positions_are_not_compared(truth):
    error = np.zeros((90, 3))
    error[4] = 20.0
    flags = np.zeros(90, dtype=int)
    flags[4] = int(Flag.residual)
    assert truth_hints(measured(error, truth, flags=flags), truth) == []
    (hint,) = truth_hints(measured(error, truth), truth)
    assert "placement 'n4'" in hint
