from xml.etree import ElementTree as ET

import numpy as np
import pytest

from closerange.delivery.common_view_plot import draw_common_view
from closerange.delivery.svg import FULL_WIDTH, GREEN, PURPLE
from closerange.geometry.transform import RigidTransform, rotation_from_vector
from closerange.matching.common_view import common_view, propose_volume
from closerange.rig.camera import Camera
from closerange.verification.scenes import looking_at_origin


def _cameras(angles=(-0.3, 0.3), turn=(0.0, 0.0, 0.0), focal=1400.0):
    rotation = rotation_from_vector(turn)
    made = []
    for name, angle in zip(("left", "right", "<third>"), angles, strict=False):
        camera = looking_at_origin(
            name, angle_rad=angle, distance_mm=500.0, focal_px=focal, size_px=(640, 512)
        )
        pose = camera.camera_from_world
        turned = RigidTransform(pose.rotation @ rotation.T, pose.translation_mm)
        made.append(Camera(name, camera.size_px, camera.matrix_px, turned))
    return made


def _drawn(cameras, least=None):
    view = common_view(cameras, least=least, noise_px=0.05, nodes=17)
    svg = draw_common_view(cameras, view, propose_volume(cameras, least=least)).render()
    assert "nan" not in str(svg).lower()
    return ET.fromstring(str(svg))  # noqa: S314 - our own drawing


def _texts(root):
    return [text.text for text in root.iter("text")]


def _polygons(root, **wanted):
    return [
        np.array([[float(v) for v in pair.split(",")] for pair in shape.get("points").split()])
        for shape in root.iter("polygon")
        if all(shape.get(name) == value for name, value in wanted.items())
    ]


@pytest.mark.parametrize(
    ("turn", "axis"),
    [((0, 0, 0), "Z"), ((np.pi, 0, 0), "Z"), ((np.pi / 2, 0, 0), "Y"), ((0, np.pi / 2, 0), "X")],
)
def test_all_is_inside_and_the_depth_axis_is_that_of_the_cameras(turn, axis):
    root = _drawn(_cameras(turn=turn))
    texts = _texts(root)
    assert texts.count(f"{axis} [mm]") == 4
    assert {"left", "right", "Cameras as they stand", "Cameras with parallel axes"} <= set(texts)
    assert "seen by 2 cameras" in texts
    assert sum(text.startswith(f"{axis} ± ") for text in texts) == 6
    width, height = FULL_WIDTH, float(root.get("height"))
    for polygon in _polygons(root):
        assert (polygon >= -0.01).all()
        assert (polygon <= [width + 0.01, height + 0.01]).all()
    for text in root.iter("text"):
        assert 0 <= float(text.get("x")) <= width
        assert 0 <= float(text.get("y")) <= height
    # cameras stand above what they look at, whichever way the world's axes point
    names = {text.text: float(text.get("y")) for text in root.iter("text")}
    volumes = _polygons(root, stroke=PURPLE)
    assert len(volumes) == 4
    assert max(names["left"], names["right"]) < volumes[0][:, 1].min()


def test_the_volume_lies_in_the_common_field_of_both_sections():
    root = _drawn(_cameras())
    fields = _polygons(root, fill=GREEN)
    volumes = _polygons(root, stroke=PURPLE)
    lower = [field for field in fields if field[:, 1].min() > 300]
    assert len(lower) == 2
    for field, volume in zip(lower, volumes[2:], strict=True):
        for corner in volume:
            # convex and drawn in order: all cross products have one sign, but for rounding to 0.01
            edge = np.roll(field, -1, axis=0) - field
            cross = edge[:, 0] * (corner[1] - field[:, 1]) - edge[:, 1] * (corner[0] - field[:, 0])
            far = cross / np.maximum(np.linalg.norm(edge, axis=1), 1e-9)
            far = far[np.linalg.norm(edge, axis=1) > 0.5]
            assert (far > -1.0).all() or (far < 1.0).all()


def test_parallel_axes_share_nothing_of_a_long_lens_and_part_of_a_short_one():
    assert "shared part of the images: 0 %" in _texts(_drawn(_cameras(focal=4000.0)))
    texts = _texts(_drawn(_cameras(focal=700.0)))
    shares = [
        int(text.split(": ")[1].split(" %")[0]) for text in texts if text.startswith("shared")
    ]
    assert 0 < shares[1] < shares[0] <= 100


def test_a_third_camera_and_a_nasty_name():
    root = _drawn(_cameras(angles=(-0.4, 0.0, 0.4)), least=2)
    assert "<third>" in _texts(root)
    assert "seen by 2 cameras" in _texts(root)
