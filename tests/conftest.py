"""Fixtures of all tests."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from closerange.rig.camera import Camera
from closerange.rig.distortion import BrownIdeal
from closerange.rig.rig import Rig
from closerange.verification.scenes import SyntheticRig, looking_at_origin

SHARED = Path(__file__).parents[1].parent / "shared"


@pytest.fixture(scope="session")
def shared() -> Path:
    """Folder of shared data beside the repository; tests that need it skip without it."""
    if not (SHARED / "data").is_dir():
        pytest.skip("needs the shared data folder beside the repository")
    return SHARED


@pytest.fixture(scope="session")
def box_scene() -> BoxScene:
    """Two converging views of three boxes of known heights on a table, made once."""
    return render_boxes()


@dataclass(frozen=True)
class BoxScene:
    """Images by camera's name, the rig that took them, and where rays meet the surface."""

    rig: Rig
    images: dict[str, NDArray[np.uint8]]
    boxes: tuple[tuple[float, ...], ...]

    def nearest_height(self, camera: Camera, xy_px: NDArray[Any]) -> NDArray[Any]:
        """Return the Z of pixels' rays on the nearest surface within 1.2 px, shape (N,)."""
        turn = np.arange(8) * np.pi / 4
        around = xy_px[:, None] + 1.2 * np.column_stack([np.cos(turn), np.sin(turn)])
        away, normal, offset = cast(camera, around.reshape(-1, 2))
        best = away.reshape(-1, 8).argmin(axis=1) + 8 * np.arange(len(xy_px))
        direction = camera.directions(xy_px)
        reach = offset[best] - normal[best] @ camera.centre_mm
        way = reach / np.einsum("ni,ni->n", normal[best], direction)
        return np.asarray((camera.centre_mm + way[:, None] * direction)[:, 2])


BOXES = ((-22.0, 14.0, 34.0, 26.0, 20.0, 8.0), (26.0, 10.0, 26.0, 30.0, -28.0, 22.0),
         (-2.0, -30.0, 40.0, 18.0, 9.0, 15.0))  # fmt: skip
"""Middle x, y, sides, turn in degrees, top Z; the table is at Z = -20 mm."""

TABLE_MM = -20.0


def cast(camera: Camera, xy_px: NDArray[Any]) -> tuple[NDArray[Any], NDArray[Any], NDArray[Any]]:
    """Return distance, normal and offset of the surface that the ray of each pixel meets."""
    direction, centre = camera.directions(xy_px), camera.centre_mm
    away = (TABLE_MM - centre[2]) / direction[:, 2]
    normal = np.tile([0.0, 0.0, 1.0], (len(xy_px), 1))
    offset = np.full(len(xy_px), TABLE_MM)
    for x, y, long, wide, turn, top in BOXES:
        c, s = np.cos(np.deg2rad(turn)), np.sin(np.deg2rad(turn))
        axes = np.array([[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]])
        middle = np.array([x, y, (top + TABLE_MM) / 2])
        half = np.array([long, wide, top - TABLE_MM]) / 2
        start, way = axes @ (centre - middle), direction @ axes.T
        with np.errstate(divide="ignore"):
            enter = (-np.sign(way) * half - start) / way
            leave = (np.sign(way) * half - start) / way
        axis = enter.argmax(axis=1)
        near = enter.max(axis=1)
        hit = (near < leave.min(axis=1)) & (near < away)
        sign = -np.sign(way[np.arange(len(way)), axis])
        face = sign[:, None] * axes[axis]
        away = np.where(hit, near, away)
        normal = np.where(hit[:, None], face, normal)
        offset = np.where(hit, face @ middle + half[axis], offset)
    return away, normal, offset


def render_boxes(size_px: tuple[int, int] = (320, 256), *, noise: float = 1.5) -> BoxScene:
    """Render the boxes matt, on a table darker than any face."""
    scale = size_px[0] / 320
    cameras = [
        looking_at_origin(
            name, angle_rad=np.deg2rad(angle), distance_mm=800.0, focal_px=1900.0 * scale,
            size_px=size_px, distortion=BrownIdeal(k1=-0.15),
        )
        for name, angle in (("left", -13.0), ("right", 12.0))
    ]  # fmt: skip
    volume = np.array([[-48.0, -48.0, -22.0], [48.0, 48.0, 26.0]])
    rig = SyntheticRig("boxes", tuple(cameras), volume, 0.05).true_rig()
    rng = np.random.default_rng(5)
    images = {}
    for camera in cameras:
        grey = np.clip(cv2.GaussianBlur(_drawn(camera), (0, 0), 0.6), 0, 255)
        grey += rng.normal(0.0, noise, grey.shape)
        images[camera.name] = np.clip(np.rint(grey), 0, 255).astype(np.uint8)
    return BoxScene(rig, images, BOXES)


def _drawn(camera: Camera) -> NDArray[Any]:
    """Draw one view: a ray a pixel, 6 x 6 where the surface changes within the pixel's reach."""
    width, height = camera.size_px
    pixel = np.stack(np.meshgrid(np.arange(width), np.arange(height)), axis=-1).astype(float)
    grey = _shade(camera, pixel.reshape(-1, 2)).reshape(height, width)
    square = np.ones((3, 3), np.uint8)
    row, column = np.nonzero(cv2.dilate(grey, square) - cv2.erode(grey, square) > 0.5)
    share = (np.arange(6) - 2.5) / 6
    part = np.stack(np.meshgrid(share, share), axis=-1).reshape(-1, 2)
    fine = np.column_stack([column, row])[:, None] + part
    grey[row, column] = _shade(camera, fine.reshape(-1, 2)).reshape(-1, 36).mean(axis=1)
    return grey


def _shade(camera: Camera, xy_px: NDArray[Any]) -> NDArray[Any]:
    _, normal, offset = cast(camera, xy_px)
    table = (offset == TABLE_MM) & (normal[:, 2] == 1.0)
    return np.where(table, 45.0, 95.0 + 105.0 * (normal @ [0.35, 0.25, 0.9]))
