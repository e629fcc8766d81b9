"""Usual mistakes of labels, axes and cameras are named."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from closerange.errors import CloseRangeWarning, GeometryError
from closerange.features.control import ControlPoints
from closerange.features.image_points import ImagePoints
from closerange.rig.calibrate import calibrate_rig
from closerange.rig.diagnosis import relabellings
from closerange.verification.scenes import rig_a, rig_b

NOISE_PX = 0.05
PITCH_MM = 45.0


def plates(rows, columns, *, tilt_rad=0.0):
    """Five placements of a grid, parallel to XY or tilted about X by different angles."""
    names, placements, xyz = [], [], []
    for k, z in enumerate((-50.0, -25.0, 0.0, 25.0, 50.0)):
        angle = tilt_rad * (k - 2)
        for r in range(rows):
            for c in range(columns):
                x = (c - (columns - 1) / 2) * PITCH_MM
                y = ((rows - 1) / 2 - r) * PITCH_MM
                xyz.append([x, y * np.cos(angle), z + y * np.sin(angle)])
                names.append(f"r{r}c{c}")
                placements.append(f"z{z:+.0f}")
    return ControlPoints.of(names, np.array(xyz), placement=placements)


def see(scene, control, seed=0):
    rng = np.random.default_rng(seed)
    parts = [
        ImagePoints.of(
            camera=camera.name,
            point=control.point,
            placement=control.placement,
            xy_px=camera.project(control.xyz_mm) + rng.normal(0, NOISE_PX, (len(control), 2)),
        )
        for camera in scene.cameras
    ]
    return parts[0] + parts[1]


def renamed(points, new, where=lambda *_: True):
    names = [
        "r{}c{}".format(*new(int(name[1]), int(name[3]))) if where(camera, placement) else name
        for camera, placement, name in zip(
            points.camera, points.placement, points.point, strict=True
        )
    ]
    return replace(points, point=tuple(names))


def refusal(points, control, scene, size=None) -> str:
    size = size or {camera.name: camera.size_px for camera in scene.cameras}
    with pytest.raises(GeometryError) as caught:
        calibrate_rig(points, control, size)
    return str(caught.value)


@pytest.mark.parametrize("tilt_rad", [0.0, 0.2])
@pytest.mark.parametrize("scene", [rig_a, rig_b], ids=["A", "B"])
def test_rows_and_columns_exchanged(scene, tilt_rad):
    control = plates(3, 3, tilt_rad=tilt_rad)
    text = refusal(renamed(see(scene(), control), lambda r, c: (c, r)), control, scene())
    assert "rows and columns exchanged" in text
    assert "becomes 0.0" in text or "falls from" in text


@pytest.mark.parametrize("scene", [rig_a, rig_b], ids=["A", "B"])
def test_order_reversed(scene):
    control = plates(3, 4, tilt_rad=0.2)
    points = renamed(
        see(scene(), control), lambda r, c: (2 - r, 3 - c), lambda camera, _: camera == "left"
    )
    text = refusal(points, control, scene())
    assert "camera 'left'" in text
    assert "turned by half a turn" in text
    assert " px to 0.0" in text


def test_half_turn_of_parallel_plates_is_a_rig_turned_by_half_a_turn():
    """Turned about Z all the world fits as well: no residual can tell, and none is claimed."""
    scene, control = rig_b(), plates(3, 4)
    points = renamed(see(scene, control), lambda r, c: (2 - r, 3 - c))
    size = {camera.name: camera.size_px for camera in scene.cameras}
    assert calibrate_rig(points, control, size).noise_px < 2 * NOISE_PX


@pytest.mark.parametrize("scene", [rig_a, rig_b], ids=["A", "B"])
def test_one_placement_turned(scene):
    control = plates(3, 4)
    points = renamed(
        see(scene(), control),
        lambda r, c: (2 - r, 3 - c),
        lambda camera, placement: (camera, placement) == ("left", "z+0"),
    )
    text = refusal(points, control, scene())
    assert "camera 'left', placement 'z+0'" in text
    assert "half a turn" in text


@pytest.mark.parametrize("scene", [rig_a, rig_b], ids=["A", "B"])
@pytest.mark.parametrize("rows", [(3, 3), (3, 4)], ids=["3x3", "3x4"])
def test_cameras_exchanged_in_one_placement(scene, rows):
    control = plates(*rows)
    points = see(scene(), control)
    other = {"left": "right", "right": "left"}
    names = [
        other[camera] if placement == "z+25" else camera
        for camera, placement in zip(points.camera, points.placement, strict=True)
    ]
    text = refusal(replace(points, camera=tuple(names)), control, scene())
    assert "cameras exchanged" in text
    assert "placement 'z+25'" in text


@pytest.mark.parametrize("scene", [rig_a, rig_b], ids=["A", "B"])
def test_left_handed_axes(scene):
    control = plates(3, 4, tilt_rad=0.2)
    points = see(scene(), control)
    text = refusal(points, replace(control, xyz_mm=control.xyz_mm * [1, -1, 1]), scene())
    assert "left-handed" in text


def test_x_and_y_exchanged():
    scene, control = rig_b(), plates(3, 4, tilt_rad=0.2)
    points = see(scene, control)
    square = {camera.name: (1280, 1280) for camera in scene.cameras}
    text = refusal(replace(points, xy_px=points.xy_px[:, ::-1]), control, scene, square)
    assert "x_px and y_px exchanged" in text


def test_what_is_not_explained_is_only_warned_of():
    scene, control = rig_b(), plates(3, 4)
    points = see(scene, control)
    rough = np.random.default_rng(3).normal(0, 3.0, points.xy_px.shape)
    size = {camera.name: camera.size_px for camera in scene.cameras}
    with pytest.warns(CloseRangeWarning, match="usually better than 1 px"):
        rig = calibrate_rig(replace(points, xy_px=points.xy_px + rough), control, size)
    assert rig.noise_px == pytest.approx(3.0, rel=0.2)


def test_relabellings_undo_themselves_on_the_grid():
    control = plates(3, 4)
    found = dict(relabellings(control))
    half = found["the order of the points reversed (the target turned by half a turn)"]
    assert half("r0c1") == "r2c2"
    assert half(half("r2c3")) == "r2c3"
    assert not list(relabellings(ControlPoints.of(["a", "b"], np.zeros((2, 3)))))
