"""Scenes to match: rendered folders with exact truth, the speckled plate, the rectified pair."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from closerange.features.edge_operators import edge_mask
from closerange.features.edges import EdgePoints, find_edges
from closerange.geometry.transform import RigidTransform
from closerange.position.triangulate import triangulate_linear
from closerange.rig.camera import Camera
from closerange.rig.distortion import BrownIdeal
from closerange.rig.rig import Rig
from closerange.verification.scenes import SyntheticRig
from matching.scene_truth import Kind, PointTruth, SceneTruth, read_cameras

FloatArray = NDArray[np.float64]

HEIGHTS_MM = (-53.0, 50.0)
"""Measuring volume of the rendered scenes: their 100 mm cube, 3 mm below the work plane."""

ALOE_FOCAL_PX, ALOE_BASELINE_MM = 3740.0, 160.0  # the makers' data; any would do
ALOE_SLACK_PX = 10.0
ALOE_ROWS = slice(427, 683)
"""A band of the rectified pair: rows do not know each other, and 60 000 points tell enough."""

PLATE_CROP_PX = (640, 512)
"""Middle part of the speckled images; whole ones have 300 000 edge points for 121 seeds."""
PLATE_SLACK_MM = 10.0


@dataclass(frozen=True, slots=True, eq=False)
class Scene:
    """Images, cameras and points with known matches.

    Attributes
    ----------
    name : str
        For the tables.
    images : tuple of ndarray, shape (H, W), uint8
        The first holds the points, the second their matches.
    cameras : tuple of Camera
        In the same order.
    volume_mm : ndarray, shape (2, 3)
        Infinite on axes without limits.
    xy_px : ndarray, shape (M, 2)
        The points.
    truth : PointTruth
        Of the points.
    right_px : float
        Error up to which a match is right: 1 px, or what the truth allows.
    heights : bool
        Whether the truth includes positions in mm.
    checks : dict of str to float
        Of the truth itself.
    of_points : callable or None
        Truth of any points of the first image, for methods that choose their own.
    rig : Rig or None
        Cameras with covariances, where they were calibrated.
    """

    name: str
    images: tuple[NDArray[np.uint8], ...]
    cameras: tuple[Camera, ...]
    volume_mm: FloatArray
    xy_px: FloatArray
    truth: PointTruth
    right_px: float = 1.0
    heights: bool = True
    checks: dict[str, float] | None = None
    of_points: Callable[[FloatArray], PointTruth] | None = None
    rig: Rig | None = None

    def measuring_rig(self) -> Rig:
        """Return the rig that positions are computed with."""
        if self.rig is not None:
            return self.rig
        return true_rig(self.cameras, finite_volume(self.volume_mm))

    def with_rig(self, rig: Rig) -> Scene:
        """Return the scene seen by calibrated cameras instead of the true ones."""
        cameras = tuple(rig.camera(camera.name) for camera in self.cameras)
        return replace(self, name=f"{self.name}, calibrated", cameras=cameras, rig=rig)


def true_rig(cameras: tuple[Camera, ...], volume_mm: FloatArray) -> Rig:
    """Return a rig of cameras that are known exactly."""
    return SyntheticRig("true", cameras, volume_mm, 0.05).true_rig()


def finite_volume(volume_mm: FloatArray) -> FloatArray:
    """Replace limits that do not exist by far ones: linear algebra wants a middle."""
    span = float(np.ptp(volume_mm[:, np.isfinite(volume_mm).all(axis=0)]))
    return np.clip(
        volume_mm, *(volume_mm[np.isfinite(volume_mm)].mean() + span * np.array([-2, 2]))
    )


def strong_edges(pixels: NDArray[np.uint8]) -> EdgePoints:
    """Return the thinned strong edges: blur-minimum above Trussell's threshold, within a pixel."""
    edges = find_edges(pixels)
    mask = cv2.dilate(edge_mask(pixels)[0].astype(np.uint8), np.ones((3, 3), np.uint8))
    column, row = np.rint(edges.xy_px).astype(int).T
    return edges.select(mask[row, column] > 0)


def rendered(folder: Path, heights_mm: tuple[float, float] = HEIGHTS_MM) -> Scene:
    """Read a rendered scene."""
    truth = SceneTruth(folder)
    cameras = read_cameras(folder)
    names = [*("left", "right"), *(name for name in cameras if name not in ("left", "right"))]
    names = [name for name in names if (folder / f"{name}.png").is_file()]
    images = tuple(_grey(folder / f"{name}.png") for name in names)
    edges = strong_edges(images[0])
    known = truth.of(edges.xy_px, edges.tangent)
    checks = truth.checked(known, find_edges(images[1]).xy_px)
    spread = known.spread_px[known.kind == int(Kind.edge)]
    checks["open_px"] = float(np.median(spread)) if len(spread) else float("nan")
    unlimited = [np.inf, np.inf]
    volume = np.array([[-np.inf, -np.inf, heights_mm[0]], [*unlimited, heights_mm[1]]])
    return Scene(
        name=folder.name,
        images=images,
        cameras=tuple(cameras[name] for name in names),
        volume_mm=volume,
        xy_px=edges.xy_px,
        truth=known,
        checks=checks,
        of_points=truth.of,
    )


def speckled_plate(folder: Path, *, whole: bool = False) -> Scene:
    """Read dice-gt4-stereo: seeds on the speckle of a real plate and their gold matches."""
    document: dict[str, Any] = json.loads((folder / "calibration.json").read_text(encoding="utf-8"))
    cameras = tuple(_vic_camera(entry) for entry in document["cameras"])
    table = np.genfromtxt(folder / "matches.csv", delimiter=",", names=True)
    first = np.column_stack([table["x0"], table["y0"]])
    second = np.column_stack([table["x1"], table["y1"]])
    inside = ((second > 0) & (second < np.array(cameras[1].size_px) - 1)).all(axis=1)
    first, second = first[inside], second[inside]
    everywhere = np.array([[-1e4] * 3, [1e4] * 3])
    seen = np.stack([first, second], axis=1)
    xyz = triangulate_linear(true_rig(cameras, everywhere), seen, np.ones(seen.shape[:2], bool))
    volume = np.array([[-np.inf] * 3, [np.inf] * 3])
    volume[0, 2], volume[1, 2] = xyz[:, 2].min() - PLATE_SLACK_MM, xyz[:, 2].max() + PLATE_SLACK_MM
    images = tuple(_grey(folder / f"gt4_cam{i}.png") for i in (0, 1))
    scene = Scene(
        name="dice-gt4-stereo",
        images=images,
        cameras=cameras,
        volume_mm=volume,
        xy_px=first,
        truth=_all_visible(xyz, second),
        heights=False,
    )
    return scene if whole else _middle(scene, PLATE_CROP_PX)


def _middle(scene: Scene, size: tuple[int, int]) -> Scene:
    """Keep the middle of both images: of the first its centre, of the second what matches it."""
    first = scene.xy_px - np.array(scene.cameras[0].size_px) / 2
    inner = np.abs(first).max(axis=1) < min(size) / 4
    centres = [scene.xy_px[inner].mean(axis=0), scene.truth.xy_px[inner].mean(axis=0)]
    corners = [np.rint(centre - np.array(size) / 2).astype(int) for centre in centres]
    images, cameras = [], []
    for image, camera, (x, y) in zip(scene.images, scene.cameras, corners, strict=True):
        images.append(np.ascontiguousarray(image[y : y + size[1], x : x + size[0]]))
        matrix = camera.matrix_px.copy()
        matrix[:2, 2] -= x, y
        cameras.append(replace(camera, size_px=size, matrix_px=matrix))
    places = [scene.xy_px - corners[0], scene.truth.xy_px - corners[1]]
    rows = np.all([((p > 10) & (p < np.array(size) - 10)).all(axis=1) for p in places], axis=0)
    truth = replace(scene.truth.select(rows), xy_px=places[1][rows])
    return replace(
        scene,
        name=f"{scene.name}, middle {size[0]} x {size[1]}",
        images=tuple(images),
        cameras=tuple(cameras),
        xy_px=places[0][rows],
        truth=truth,
    )


def aloe(folder: Path, *, whole: bool = False) -> Scene:
    """Read the rectified pair; truth is the map's nearer surface within a pixel."""
    rows = slice(None) if whole else ALOE_ROWS
    images = tuple(np.ascontiguousarray(_grey(folder / f"aloe{side}.jpg")[rows]) for side in "LR")
    disparity = _grey(folder / "aloeGT.png").astype(np.float64)[rows]
    height, width = disparity.shape
    known = disparity[disparity > 0]
    matrix = np.array(
        [[ALOE_FOCAL_PX, 0, (width - 1) / 2], [0, ALOE_FOCAL_PX, (height - 1) / 2], [0, 0, 1]]
    )
    cameras = tuple(
        Camera(
            name,
            (width, height),
            matrix,
            RigidTransform(np.eye(3), np.array([-shift, 0.0, 0.0])),
            BrownIdeal(),
        )
        for name, shift in (("left", 0.0), ("right", ALOE_BASELINE_MM))
    )
    limits = ALOE_FOCAL_PX * ALOE_BASELINE_MM
    far = limits / max(known.min() - ALOE_SLACK_PX, 1.0)
    volume = np.array([[-np.inf] * 3, [np.inf] * 3])
    volume[:, 2] = limits / (known.max() + ALOE_SLACK_PX), far
    edges = strong_edges(images[0])
    nearer = cv2.dilate(disparity, np.ones((3, 3)))
    visible = _seen_in_right(disparity)
    column, row = np.rint(edges.xy_px).astype(int).T
    value = nearer[row, column]
    second = edges.xy_px - np.column_stack([value, np.zeros(len(value))])
    inside = second[:, 0] > 0
    kind = np.where(visible[row, column] & inside, int(Kind.edge), int(Kind.occluded))
    kind[value == 0] = int(Kind.unknown)
    xyz = np.full((len(value), 3), np.nan)
    return Scene(
        name="opencv-pairs/aloe" + ("" if whole else f", rows {rows.start} to {rows.stop - 1}"),
        images=images,
        cameras=cameras,
        volume_mm=volume,
        xy_px=edges.xy_px,
        truth=PointTruth(kind.astype(np.int64), xyz, second, np.zeros(len(value))),
        right_px=1.5,
        heights=False,
    )


def _seen_in_right(disparity: FloatArray) -> NDArray[np.bool_]:
    """Mark pixels (or a neighbour) that no nearer pixel of the row hides in the right view."""
    height, width = disparity.shape
    right = np.zeros((height, width))
    row, column = np.nonzero(disparity > 0)
    value = disparity[row, column]
    place = column - value.astype(int)
    inside = place >= 0
    np.maximum.at(right, (row[inside], place[inside]), value[inside])
    seen = np.zeros((height, width), np.uint8)
    seen[row[inside], column[inside]] = right[row[inside], place[inside]] <= value[inside] + 1
    return np.asarray(cv2.dilate(seen, np.ones((3, 3), np.uint8)) > 0)


def _vic_camera(entry: dict[str, Any]) -> Camera:
    """Build a camera of VIC-3D's calibration; see the data's README."""
    turns = [np.deg2rad(entry[f"{angle}_deg"]) for angle in ("alpha", "beta", "gamma")]
    about = [cv2.Rodrigues(turn * np.eye(3)[axis])[0] for axis, turn in enumerate(turns)]
    matrix = np.array(
        [[entry["fx"], entry["skew"], entry["cx"]], [0, entry["fy"], entry["cy"]], [0, 0, 1]]
    )
    return Camera(
        f"cam{entry['id']}",
        tuple(entry["image_size"]),
        matrix,
        RigidTransform(
            about[2] @ about[1] @ about[0], np.array([entry["tx"], entry["ty"], entry["tz"]])
        ),
        BrownIdeal(k1=entry["k1"], k2=entry["k2"], k3=entry["k3"]),
    )


def _all_visible(xyz_mm: FloatArray, second_px: FloatArray) -> PointTruth:
    count = len(xyz_mm)
    kind = np.full(count, int(Kind.edge), np.int64)
    return PointTruth(kind, xyz_mm, second_px, np.zeros(count))


def _grey(path: Path) -> NDArray[np.uint8]:
    image = cv2.imread(str(path), cv2.IMREAD_GRAYSCALE)
    if image is None:
        raise FileNotFoundError(f"{path} is not there or is no image")
    return np.asarray(image, np.uint8)
