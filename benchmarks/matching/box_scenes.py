"""Boxes on a table, seen by two cameras of any resolution: images with exact truth in seconds.

What the path-traced scenes cannot offer is size. Here faces are drawn as filled polygons three
times finer than the pixel, blurred as by a lens and given a sensor's noise. There are no shadows
and no reflections: for cost, not for a comparison of matchers.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import product

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from closerange.geometry.transform import RigidTransform
from closerange.rig.camera import Camera
from closerange.rig.distortion import BrownIdeal

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]
Image = NDArray[np.uint8]

TABLE_MM = -50.0
FIELD_MM = 110.0
"""Side of the square on which boxes stand: what the 100 mm cube of the shared scenes needs."""

BASE_PX = (640, 512)
FOCAL_PX = 5000.0
CENTRES_MM = ((-240.0, -295.0, 1450.0), (380.0, -120.0, 1400.0))
"""About the shared rig A, 25 degrees between the views; pixels are those of scale 1."""

FINER = 3
PSF_PX = 0.7
GREY_NOISE = 1.2
LIGHT = np.array([0.35, -0.55, 0.76])
AMBIENT = 0.3
STEP_PX = 0.5
"""Distance of the truth's samples along an edge."""

NEAR_PX = 1.0
"""An image edge further from all box edges is noise, or lies at a corner."""


@dataclass(frozen=True, slots=True, eq=False)
class BoxScene:
    """Two images, their cameras, and the visible box edges.

    Attributes
    ----------
    images : tuple of two ndarrays, shape (H, W), uint8
        Grey values.
    cameras : tuple of two Cameras
        Their cameras, exact.
    volume_mm : ndarray, shape (2, 3)
        Where the boxes are, in height; no limits across.
    edge_mm : ndarray, shape (S, 3)
        Samples of edges that both views see.
    """

    images: tuple[Image, Image]
    cameras: tuple[Camera, Camera]
    volume_mm: FloatArray
    edge_mm: FloatArray

    def truth(self, xy_px: FloatArray) -> FloatArray:
        """Return the places in the second view of points of the first; NaN where unknown."""
        seen = self.cameras[0].project(self.edge_mm)
        away, nearest = cKDTree(seen).query(xy_px)
        place = self.cameras[1].project(self.edge_mm[nearest])
        place[away > NEAR_PX] = np.nan
        return place


def box_scene(scale: float, boxes: int, seed: int = 5) -> BoxScene:
    """Make a scene.

    Parameters
    ----------
    scale : float
        Pixels per pixel of a 640 x 512 image of the same field.
    boxes : int
        Boxes in a row and in a column.
    seed : int, optional
        Of sizes, places, shades and noise.
    """
    rng = np.random.default_rng(seed)
    cameras = tuple(
        _camera(name, centre, scale)
        for name, centre in zip(("left", "right"), CENTRES_MM, strict=True)
    )
    corners, cell = _boxes(boxes, rng)
    shade = rng.uniform(0.45, 0.95, len(corners))
    drawn = [_drawn(camera, corners, cell, shade, boxes) for camera in cameras]
    images = tuple(_exposed(picture, rng) for picture, _ in drawn)
    sample, owner = [], []
    for box, eight in enumerate(corners):
        for points in _edges(eight, cameras):
            sample.append(points)
            owner.append(np.full(len(points), box + 1))
    xyz_mm, whose = np.concatenate(sample), np.concatenate(owner)
    seen = np.all(
        [_seen(c, xyz_mm, whose, who) for c, (_, who) in zip(cameras, drawn, strict=True)], axis=0
    )
    free = [np.inf, np.inf]
    volume = np.array([[-np.inf, -np.inf, TABLE_MM - 3.0], [*free, TABLE_MM + FIELD_MM]])
    return BoxScene(images, cameras, volume, xyz_mm[seen])  # type: ignore[arg-type]


def _camera(name: str, centre: tuple[float, float, float], scale: float) -> Camera:
    forward = -np.array(centre) / np.linalg.norm(centre)
    right = np.cross(forward, [0.0, 1.0, 0.0])
    right /= np.linalg.norm(right)
    rotation = np.stack([right, np.cross(forward, right), forward])
    size = tuple(round(side * scale) for side in BASE_PX)
    matrix = np.diag([FOCAL_PX * scale, FOCAL_PX * scale, 1.0])
    matrix[:2, 2] = (np.array(size) - 1) / 2
    return Camera(
        name,
        (size[0], size[1]),
        matrix,
        RigidTransform(rotation, -rotation @ np.array(centre)),
        BrownIdeal(k1=-0.5),
    )


def _boxes(count: int, rng: np.random.Generator) -> tuple[FloatArray, IntArray]:
    """Return the corners of turned boxes, (N, 2, 2, 2, 3), each within its cell of a grid."""
    pitch = FIELD_MM / count
    corners, cells = [], []
    for cell in product(range(count), repeat=2):
        half = pitch * rng.uniform(0.2, 0.33, 2)
        height = pitch * rng.uniform(0.3, 1.2)
        turn = rng.uniform(0, np.pi)
        across = np.array([np.cos(turn), np.sin(turn)]) * half[0]
        along = np.array([-np.sin(turn), np.cos(turn)]) * half[1]
        middle = (np.array(cell) + 0.5) * pitch - FIELD_MM / 2
        box = np.empty((2, 2, 2, 3))
        for i, j, k in product((0, 1), repeat=3):
            box[i, j, k, :2] = middle + (2 * i - 1) * across + (2 * j - 1) * along
            box[i, j, k, 2] = TABLE_MM + k * height
        corners.append(box)
        cells.append(cell)
    return np.array(corners), np.array(cells)


def _drawn(
    camera: Camera, corners: FloatArray, cell: IntArray, shade: FloatArray, boxes: int
) -> tuple[NDArray[np.uint8], NDArray[np.int32]]:
    """Paint far boxes first; return a fine picture and the box at each pixel (0 is the table)."""
    width, height = camera.size_px
    picture = np.full((height * FINER, width * FINER), 40, np.uint8)
    owner = np.zeros((height, width), np.int32)
    foot = np.floor((camera.centre_mm[:2] + FIELD_MM / 2) / (FIELD_MM / boxes))
    # what hides a box stands in a cell nearer to the camera in rows and columns
    order = np.argsort(-np.abs(cell - foot).sum(axis=1), kind="stable")
    for box in order.tolist():
        middle = corners[box].reshape(8, 3).mean(axis=0)
        for axis, side in product(range(3), (0, 1)):
            face = np.take(corners[box], side, axis=axis).reshape(4, 3)[[0, 1, 3, 2]]
            outward = face.mean(axis=0) - middle
            if outward @ (camera.centre_mm - face.mean(axis=0)) <= 0:
                continue
            lit = max(float(outward @ LIGHT / np.linalg.norm(outward)), 0.0)
            grey = 230 * shade[box] * (AMBIENT + (1 - AMBIENT) * lit)
            outline = camera.project(_outline(face))
            _fill(picture, (outline + 0.5) * FINER - 0.5, round(grey))
            _fill(owner, outline, box + 1)
    return picture, owner


def _outline(face: FloatArray) -> FloatArray:
    """Return points along the sides of a face: lenses bend them."""
    share = np.linspace(0, 1, 8, endpoint=False)[:, None]
    ends = zip(face, np.roll(face, -1, axis=0), strict=True)
    return np.concatenate([start + share * (stop - start) for start, stop in ends])


def _fill(image: NDArray[np.uint8] | NDArray[np.int32], xy: FloatArray, value: int) -> None:
    fixed = np.rint(xy * 16).astype(np.int32).reshape(-1, 1, 2)
    cv2.fillPoly(image, [fixed], float(value), lineType=cv2.LINE_8, shift=4)


def _exposed(picture: NDArray[np.uint8], rng: np.random.Generator) -> Image:
    height, width = (side // FINER for side in picture.shape)
    grey = cv2.resize(picture, (width, height), interpolation=cv2.INTER_AREA).astype(np.float32)
    grey = cv2.GaussianBlur(grey, (0, 0), PSF_PX)
    grey += GREY_NOISE * rng.standard_normal(grey.shape, dtype=np.float32)
    return np.asarray(np.clip(np.rint(grey), 0, 255), np.uint8)


def _edges(eight: FloatArray, cameras: Sequence[Camera]) -> Iterator[FloatArray]:
    """Return points along the edges that the box itself hides from no camera."""
    step_mm = STEP_PX * np.linalg.norm(cameras[0].centre_mm) / cameras[0].matrix_px[0, 0]
    middle = eight.reshape(8, 3).mean(axis=0)
    for axis in range(3):
        low, high = (np.take(eight, side, axis=axis) for side in (0, 1))
        others = [other for other in range(3) if other != axis]
        for sides in product((0, 1), repeat=2):
            faces = [
                np.take(eight, side, axis=other).reshape(4, 3).mean(axis=0)
                for other, side in zip(others, sides, strict=True)
            ]
            if all(
                any((face - middle) @ (camera.centre_mm - face) > 0 for face in faces)
                for camera in cameras
            ):
                start, stop = low[sides], high[sides]
                count = int(np.linalg.norm(stop - start) / step_mm) + 2
                yield start + np.linspace(0, 1, count)[:, None] * (stop - start)


def _seen(
    camera: Camera, xyz_mm: FloatArray, box: IntArray, owner: NDArray[np.int32]
) -> NDArray[np.bool_]:
    """Tell which points are inside of the image and beside a pixel of their own box."""
    xy = camera.project(xyz_mm)
    height, width = owner.shape
    column, row = np.rint(np.nan_to_num(xy, nan=-9.0)).astype(int).T
    inside = (column > 0) & (row > 0) & (column < width - 1) & (row < height - 1)
    column, row = np.clip(column, 1, width - 2), np.clip(row, 1, height - 2)
    near = [owner[row + i, column + j] == box for i in (-1, 0, 1) for j in (-1, 0, 1)]
    return np.asarray(inside & np.any(near, axis=0))
