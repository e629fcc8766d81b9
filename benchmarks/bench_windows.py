"""Window matches: speckle, texture, centroids of faces and discs, rendered planes.

    python benchmarks/bench_windows.py [--shared ../shared] [--points 1500]

Each row says how many points were asked, the share found right before flags, the share kept without
a flag and right among those, the distance from the truth along the epipolar curve and in all, the
share of 95 % regions that hold the truth, and the processor time. Few points are searched one by
one; rows that end in "all" ask for so many that whole images are swept.
"""

from __future__ import annotations

import argparse
import csv
import json
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from closerange.features.edges import find_edges
from closerange.geometry.transform import RigidTransform
from closerange.matching.pencil import Pencil
from closerange.matching.window_matcher import WindowMatches, match_windows
from closerange.rig.camera import Camera
from closerange.rig.distortion import BrownIdeal
from closerange.verification.scenes import looking_at_origin
from closerange.verification.textured_planes import (
    TexturedPlane,
    render_planes,
    seen_points,
    visible,
)

Images = tuple[NDArray[Any], NDArray[Any]]
Cameras = tuple[Camera, Camera]


def row(
    name: str, matches: WindowMatches, truth_px: NDArray[Any], seconds: float, right_px: float
) -> None:
    """Print one line of the table."""
    apart = matches.xy_px - truth_px
    along = np.einsum("ni,ni->n", apart, matches.epipolar)
    distance = np.linalg.norm(apart, axis=1)
    kept = matches.flags == 0
    with np.errstate(invalid="ignore"):
        right = np.abs(along) < right_px
        covered = np.abs(along) < 1.96 * matches.std_px
    median = np.median(distance[kept]) if kept.any() else np.nan
    on_curve = np.median(np.abs(along[kept])) if kept.any() else np.nan
    print(
        f"{name:34} {len(kept):5} points, right (< {right_px:g} px) {right.mean():6.1%}, kept "
        f"{kept.mean():6.1%}, right of kept {right[kept].mean() if kept.any() else np.nan:7.2%}, "
        f"median {median:.4f} px (along {on_curve:.4f}, worst "
        f"{np.abs(along[kept]).max(initial=0):.2f}), covered "
        f"{covered[kept].mean() if kept.any() else np.nan:6.1%}, {seconds:.1f} s"
    )


def matched(
    cameras: Cameras, images: Images, points: NDArray[Any], volume: Any, **options: Any
) -> tuple[WindowMatches, float]:
    edges = find_edges(images[0]), find_edges(images[1])
    greys = images[0].astype(np.float32), images[1].astype(np.float32)
    start = time.process_time()
    matches = match_windows(Pencil.of(*cameras), greys, edges, points, volume, **options)
    return matches, time.process_time() - start


def grey_image(path: Path) -> NDArray[Any]:
    pixels = cv2.imread(str(path), cv2.IMREAD_GRAYSCALE)
    assert pixels is not None, path
    return np.asarray(pixels)


def turn(axis: int, degrees: float) -> NDArray[Any]:
    vector = np.zeros(3)
    vector[axis] = np.radians(degrees)
    return np.asarray(cv2.Rodrigues(vector)[0])


def dice(folder: Path) -> None:
    """Real speckle, converged cameras; the gold matches are those of another program."""
    document = json.loads((folder / "calibration.json").read_text(encoding="utf-8"))
    cameras = tuple(
        Camera(
            str(c["id"]),
            tuple(c["image_size"]),
            np.array([[c["fx"], c["skew"], c["cx"]], [0, c["fy"], c["cy"]], [0, 0, 1]]),
            RigidTransform(
                turn(2, c["gamma_deg"]) @ turn(1, c["beta_deg"]) @ turn(0, c["alpha_deg"]),
                np.array([c["tx"], c["ty"], c["tz"]]),
            ),
            BrownIdeal(k1=c["k1"], k2=c["k2"], k3=c["k3"]),
        )
        for c in document["cameras"]
    )
    gold = np.genfromtxt(folder / "matches.csv", delimiter=",", names=True)
    images = grey_image(folder / "gt4_cam0.png"), grey_image(folder / "gt4_cam1.png")
    # the plate stands 0.37 m in front, where Z is -0.37 m; 60 mm more and less are searched
    volume = [[-np.inf, -np.inf, -430.0], [np.inf, np.inf, -310.0]]
    truth = np.column_stack([gold["x1"], gold["y1"]])
    points = np.column_stack([gold["x0"], gold["y0"]])
    matches, seconds = matched((cameras[0], cameras[1]), images, points, volume)
    row("dice-gt4-stereo (real speckle)", matches, truth, seconds, 1.0)


def aloe(folder: Path, count: int) -> None:
    """Real texture, whole-pixel truth; points that the right image does not show are left out."""
    images = grey_image(folder / "aloeL.jpg"), grey_image(folder / "aloeR.jpg")
    disparity = grey_image(folder / "aloeGT.png").astype(float)
    height, width = disparity.shape
    matrix = np.array([[1000.0, 0, width / 2], [0, 1000.0, height / 2], [0, 0, 1]])
    cameras = tuple(
        Camera(name, (width, height), matrix, RigidTransform(np.eye(3), np.array([shift, 0, 0])))
        for name, shift in (("left", 0.0), ("right", -100.0))
    )
    edges = find_edges(images[0])
    chosen = np.random.default_rng(1).choice(len(edges), count, replace=False)
    points = edges.xy_px[np.sort(chosen)]
    column, line = np.rint(points).astype(int).T
    true = disparity[line, column]
    nearest = np.zeros_like(disparity)
    y, x = np.nonzero(disparity > 0)
    there = np.rint(x - disparity[y, x]).astype(int)
    np.maximum.at(nearest, (y[there >= 0], there[there >= 0]), disparity[y, x][there >= 0])
    target = np.rint(points[:, 0] - true).astype(int)
    shown = (true > 0) & (target >= 0)
    hidden = shown & (nearest[line, np.maximum(target, 0)] > true + 1.5)
    z = 1e5 / np.array([true.max() + 10, true[true > 0].min() - 10])
    volume = [[-np.inf, -np.inf, z[0]], [np.inf, np.inf, z[1]]]
    matches, seconds = matched((cameras[0], cameras[1]), images, points, volume)
    truth = points - np.column_stack([true, np.zeros(len(true))])
    for name, rows in (
        ("aloe, edge points seen by both", shown & ~hidden),
        ("aloe, all edge points with truth", true > 0),
        ("aloe, hidden ones (none is right)", hidden),
    ):
        row(name, select(matches, rows), truth[rows], seconds, 1.5)


def select(matches: WindowMatches, rows: NDArray[Any]) -> WindowMatches:
    return WindowMatches(*(getattr(matches, name)[rows] for name in WindowMatches.__slots__))


def rendered_cameras(folder: Path) -> Cameras:
    document = json.loads((folder / "cameras.json").read_text(encoding="utf-8"))["cameras"]
    left, right = (
        Camera(
            name,
            (true["width"], true["height"]),
            np.array(true["K"], np.float64),
            RigidTransform(np.array(true["R"]), np.array(true["t_mm"])),
            BrownIdeal(*true["dist_k1_k2_p1_p2_k3"]),
        )
        for name, true in ((name, document[name]) for name in ("left", "right"))
    )
    return left, right


def centroid(image: NDArray[Any], near: NDArray[Any]) -> NDArray[Any]:
    """Return the centroid of the face around a pixel: what is at least 0.85 times as bright."""
    x, y = np.rint(near).astype(int)
    level = np.median(image[y - 3 : y + 4, x - 3 : x + 4])
    mask = (cv2.GaussianBlur(image, (0, 0), 1.0) > 0.85 * level).astype(np.uint8)
    label = cv2.connectedComponents(mask, connectivity=4)[1]
    line, column = np.nonzero(label == label[y, x])
    return np.array([column.mean(), line.mean()])


def blocks(folder: Path) -> None:
    """Centroids of the five top faces: example 2 of the thesis."""
    cameras = rendered_cameras(folder)
    images = grey_image(folder / "left.png"), grey_image(folder / "right.png")
    objects = json.loads((folder / "objects.json").read_text(encoding="utf-8"))["objects"]
    top = np.array([[*o["centre_xy_mm"], o["top_Z_mm"]] for o in objects])
    found = [
        np.array([centroid(image, xy) for xy in camera.project(top)])
        for camera, image in zip(cameras, images, strict=True)
    ]
    volume = [[-np.inf, -np.inf, -53.0], [np.inf, np.inf, 50.0]]
    matches, seconds = matched(cameras, images, found[0], volume)
    ray = cameras[0].directions(found[0])
    way = (top[:, 2] - cameras[0].centre_mm[2]) / ray[:, 2]
    truth = cameras[1].project(cameras[0].centre_mm + way[:, None] * ray)
    row("A_blocks centroids, true heights", matches, truth, seconds, 0.1)
    # perspective moves the centroid of a face of 100 px by 0.2 to 0.5 px against the match
    row("A_blocks, centroids in the right", matches, found[1], seconds, 1.0)
    print(
        "    heights off by "
        + ", ".join(f"{1000 * d:.0f}" for d in matches.xyz_mm[:, 2] - top[:, 2])
        + " um; stated "
        + ", ".join(f"{s:.3f}" for s in matches.std_px)
        + " px; windows "
        + ", ".join(f"{h:.0f}" for h in matches.half_width_px)
    )


def table(path: Path) -> list[dict[str, str]]:
    with path.open(encoding="utf-8", newline="") as file:
        return list(csv.DictReader(file))


def discs(folder: Path) -> None:
    """Match true centres of discs on plates."""
    cameras = rendered_cameras(folder)
    targets = table(folder / "targets.csv")
    key = next(name for name in targets[0] if name in {"image", "file"})
    volume = [[-np.inf, -np.inf, -60.0], [np.inf, np.inf, 60.0]]
    parts, truths, seconds = [], [], 0.0
    for path in sorted(folder.glob("left_*.png")):
        pair = [
            np.array(
                [
                    [float(t["u_centre"]), float(t["v_centre"])]
                    for t in targets
                    if Path(t[key]).name == path.name.replace("left", side)
                ]
            )
            for side in ("left", "right")
        ]
        images = grey_image(path), grey_image(path.with_name(path.name.replace("left", "right")))
        matches, taken = matched(cameras, images, pair[0], volume)
        parts.append(matches)
        truths.append(pair[1])
        seconds += taken
    row("A_calib_discs centres", joined(parts), np.concatenate(truths), seconds, 0.02)


def joined(parts: Sequence[WindowMatches]) -> WindowMatches:
    names = WindowMatches.__slots__
    return WindowMatches(*(np.concatenate([getattr(p, name) for p in parts]) for name in names))


def single_discs(folder: Path) -> None:
    """Match the acceptance crops: one disc at 90 places, pasted into plain images."""
    cameras = rendered_cameras(folder)
    crops = {c["image"]: c for c in table(folder / "single" / "crops.csv")}
    targets = table(folder / "single" / "targets.csv")
    volume = [[-np.inf, -np.inf, -60.0], [np.inf, np.inf, 60.0]]
    parts, truths, seconds = [], [], 0.0
    for number in range(0, 90, 3):
        images, centres = [], []
        for camera, side in zip(cameras, ("left", "right"), strict=True):
            name = f"p{number:02d}_{side}_r0.png"
            crop = grey_image(folder / "single" / name)
            rim = np.concatenate([crop[0], crop[-1]]).astype(float)
            image = np.random.default_rng(number).normal(
                rim.mean(), rim.std(), camera.size_px[::-1]
            )
            image = np.clip(np.rint(image), 0, 255).astype(np.uint8)
            x, y = (int(crops[name][k]) for k in ("x0", "y0"))
            image[y : y + crop.shape[0], x : x + crop.shape[1]] = crop
            images.append(image)
            centres.append(
                next(
                    [float(t["u_centre"]), float(t["v_centre"])]
                    for t in targets
                    if t["image"] == Path(name).stem.rsplit("_", 1)[0]
                )
            )
        matches, taken = matched(cameras, (images[0], images[1]), np.array(centres[:1]), volume)
        parts.append(matches)
        truths.append(centres[1])
        seconds += taken
    row("A_verify single discs", joined(parts), np.array(truths), seconds, 0.02)


def plane(
    tilt: tuple[float, float], half_mm: float, z_mm: float, contrast: float, seed: int
) -> TexturedPlane:
    pose = turn(1, tilt[1]) @ turn(0, tilt[0])
    return TexturedPlane(
        np.array([0.0, 0.0, z_mm]),
        pose @ [half_mm, 0, 0],
        pose @ [0, half_mm, 0],
        1.0,
        110.0,
        contrast,
        seed,
    )


def planes() -> None:
    """Match rendered textures: tilts, noise, two depths; the second camera is darker."""
    left, right = (
        looking_at_origin(
            name,
            angle_rad=np.radians(angle),
            distance_mm=900.0,
            focal_px=1700.0,
            distortion=BrownIdeal(k1=-0.1),
            size_px=(480, 384),
        )
        for name, angle in (("left", -12.5), ("right", 12.5))
    )
    scenes = [
        (f"rendered, tilted {a}, {b} deg", [plane((a, b), 300, 0, 25, 1)], 2.0)
        for a, b in ((0, 0), (20, 0), (0, 20), (40, 0), (0, -40))
    ]
    scenes += [
        (f"rendered, noise {n:g} of contrast {c:g}", [plane((0, 0), 200, 0, c, 2)], n)
        for n, c in ((1.0, 25), (4.0, 25), (2.0, 8))
    ]
    scenes.append(
        ("rendered, step of 20 mm", [plane((0, 0), 200, 0, 25, 3), plane((0, 0), 25, 20, 25, 4)], 2)
    )
    for name, scene, noise in scenes:
        images = (
            render_planes(left, scene, noise=noise, seed=1).astype(np.uint8),
            render_planes(right, scene, noise=noise, seed=2, gain=0.8, offset=15).astype(np.uint8),
        )
        few = np.random.default_rng(5).uniform(30, [450, 354], (400, 2))
        every = np.random.default_rng(6).uniform(30, [450, 354], (7000, 2))
        for label, points in ((name, few), (f"{name}, all", every)):
            xyz, _ = seen_points(left, scene, points)
            truth = right.project(xyz)
            shown = (
                visible(right, scene, xyz)
                & ((truth > 20) & (truth < [459, 363])).all(axis=1)
                & (np.abs(xyz[:, 2]) < 100)
            )
            volume = [[-np.inf, -np.inf, -105.0], [np.inf, np.inf, 105.0]]
            matches, seconds = matched((left, right), images, points[shown], volume)
            row(label, matches, truth[shown], seconds, 0.5)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--shared", type=Path, default=Path(__file__).parents[1].parent / "shared")
    parser.add_argument("--points", type=int, default=1500, help="edge points of the aloe pair")
    options = parser.parse_args()
    data = options.shared / "data"
    dice(data / "dice-gt4-stereo")
    blocks(data / "rendered" / "A_blocks")
    discs(data / "rendered" / "A_calib_discs")
    single_discs(data / "rendered" / "A_verify")
    planes()
    aloe(data / "opencv-pairs", options.points)


if __name__ == "__main__":
    main()
