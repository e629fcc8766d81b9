"""Examples 1 to 4 of chapter 5 of the thesis, with its own matcher, on rendered scenes.

    python examples/point_of_correspondence.py [--scenes FOLDER]

The cameras are calibrated with the images of ``closerange demo``; the scenes `A_blocks`,
`A_spring` and `A_parts`, seen by the same cameras, lie in FOLDER, by default in the shared folder
beside the repository. As in the thesis the depths are Z_upper = -50 mm and Z_lower = +50 mm, and
matches are whole pixels.

1. Nine edge points of five blocks, structuring element 15 x 15: Tables 5.1 and 5.2.
2. Centroids of the blocks' white patches: Tables 5.3 and 5.4. The thesis asks for an element "large
   enough to encompass edges from the object" and takes 59 x 59 px (17 mm in its picture of 512 px
   for 150 mm). These blocks are larger in the picture: the nearest edge of four patches of five is
   farther from the centroid than 29 px, and an element without edges has no match. Each gets the
   smallest element that holds its whole patch. The nine discs of the calibration plate are small
   enough for 59 x 59 and are matched with it.
3. A spring on a base, 15 x 15.
4. Three parts of different shapes, 15 x 15.
"""

from __future__ import annotations

import argparse
import json
from importlib.resources import as_file, files
from pathlib import Path

import cv2
import numpy as np

import closerange as cr
from closerange.features.borders import border_centroid, follow_borders
from closerange.features.threshold import fixed_points, threshold_report
from closerange.flags import format_flags
from closerange.images import read_image
from closerange.matching.literal import LiteralMatcher, binary_images, match_literal
from closerange.matching.literal_element import footprint
from closerange.matching.literal_matches import LiteralMatches, join_matches
from closerange.matching.search import between_planes

CAMERAS = ("left", "right")
DEPTHS = between_planes(-50.0, 50.0)
TABLE_MM = -50.0
SHARED = Path(__file__).resolve().parents[1].parent / "shared" / "data" / "rendered"

# candidates, chosen by eye in the left images; the nearest edge pixel is taken
BLOCKS = (
    ("1", (426, 72), 50.44),
    ("2", (456, 145), 50.44),
    ("3", (257, 264), 75.07),
    ("4", (305, 216), 75.07),
    ("5", (295, 52), 44.18),
    ("6", (235, 86), 44.18),
    ("7", (117, 210), 25.19),
    ("8", (158, 262), 25.19),
    ("9", (426, 330), 25.06),
)
SPRING = (
    ("base, top edge", (230, 206)),
    ("base, left edge", (205, 305)),
    ("base, lower edge", (335, 339)),
    ("base, right edge", (405, 252)),
    ("base, right corner", (426, 296)),
    ("base, left corner", (172, 234)),
    ("wire's end", (378, 207)),
    ("first coil, top", (322, 176)),
    ("first coil, left", (270, 232)),
)
PARTS = (
    ("block, hole", (128, 190)),
    ("block, upper edge", (135, 143)),
    ("block, first step", (187, 160)),
    ("block, second step", (254, 150)),
    ("block, right edge", (308, 140)),
    ("knob, bore", (412, 310)),
    ("knob, rim", (440, 275)),
    ("flange, rim", (333, 310)),
    ("screw, slot", (362, 288)),
    ("clip, hole", (191, 339)),
    ("clip, lower edge", (170, 402)),
)


class Scene:
    """Images of one scene, and its truth."""

    def __init__(self, folder: Path) -> None:
        if not folder.is_dir():
            raise SystemExit(f"no folder {folder}: name the folder of the scenes with --scenes")
        self.images = [read(folder / f"{name}.png") for name in CAMERAS]
        self.masks = binary_images(self.images)
        with np.load(folder / "truth_left.npz") as maps:
            self._depth = maps["depth"].astype(np.float64)
        self._true = json.loads((folder / "cameras.json").read_text(encoding="utf-8"))["cameras"]

    def edge_pixels(self, near: list[tuple[int, int]]) -> np.ndarray:
        """Return the edge pixel of the left image that is nearest to each place."""
        row, column = np.nonzero(self.masks[0])
        pixels = np.column_stack([column, row])
        away = np.linalg.norm(pixels[None] - np.array(near)[:, None], axis=2)
        return pixels[away.argmin(axis=1)].astype(np.float64)

    def truth(self, pixels: np.ndarray) -> np.ndarray:
        """Return the true places in the right image: of the nearest surface within 2 px."""
        near = cv2.erode(self._depth, np.ones((5, 5), np.uint8))
        column, row = pixels.astype(int).T
        left, right = (self._true[name] for name in CAMERAS)
        matrix, lens = np.array(left["K"], float), np.array(left["dist_k1_k2_p1_p2_k3"], float)
        ideal = cv2.undistortPoints(pixels.reshape(-1, 1, 2), matrix, lens).reshape(-1, 2)
        seen = np.column_stack([ideal, np.ones(len(ideal))]) * near[row, column][:, None]
        world = (seen - np.array(left["t_mm"])) @ np.array(left["R"])
        turn, shift = cv2.Rodrigues(np.array(right["R"], float))[0], np.array(right["t_mm"], float)
        matrix, lens = np.array(right["K"], float), np.array(right["dist_k1_k2_p1_p2_k3"], float)
        return cv2.projectPoints(world, turn, shift, matrix, lens)[0].reshape(-1, 2)


def read(path: Path) -> np.ndarray:
    """Read a grey image."""
    return np.asarray(read_image(path).pixels)


def calibrated() -> tuple[cr.Rig, list[np.ndarray]]:
    """Calibrate with the demonstration's plate; return its images in the middle plane too."""
    with as_file(files("closerange.workflows") / "demo_data") as data:
        plate = None
        for camera in CAMERAS:
            found = cr.detect(
                sorted((data / "calibration").glob(f"{camera}_*.png")),
                target=data / "plate.toml",
                camera=camera,
                placement_pattern="_(z.*)$",
            )
            plate = found if plate is None else plate + found
        rig = cr.calibrate(plate, control=data / "control.csv")
        images = [read(data / "calibration" / f"{name}_z+00.0.png") for name in CAMERAS]
    return rig, images


def heights(rig: cr.Rig, found: LiteralMatches) -> np.ndarray:
    """Return Z of matches (equation 5.6, each ray weighted alike)."""
    names = [str(number) for number in range(len(found))]
    return cr.measure(rig, found.to_correspondences(CAMERAS, names)).xyz_mm[:, 2]


def example_1(rig: cr.Rig, scene: Scene) -> None:
    """Edge points of blocks."""
    pixels = scene.edge_pixels([near for _, near, _ in BLOCKS])
    found = match_literal(scene.images, rig.cameras, pixels, DEPTHS, side_px=15)
    z = heights(rig, found)
    print("Example 1: edge points, element 15 x 15\n\nTable 5.1   Point   Z mm")
    for (name, _, _), height in zip(BLOCKS, z, strict=True):
        print(f"            {name:5s} {height:7.2f}")
    print("\nTable 5.2   Points   Actual height   Measured height (Z + 50) mm")
    for actual in dict.fromkeys(actual for _, _, actual in BLOCKS):
        rows = [i for i, block in enumerate(BLOCKS) if block[2] == actual]
        names = " and ".join(BLOCKS[i][0] for i in rows)
        measured = " / ".join(f"{z[i] - TABLE_MM:.2f}" for i in rows)
        print(f"            {names:8s} {actual:10.2f}        {measured}")
    worst = np.abs(z - TABLE_MM - [actual for _, _, actual in BLOCKS]).max()
    print(f"            largest error {worst:.2f} mm (thesis: 1.58 mm)")
    print_share(found, scene.truth(pixels))


def patches(image: np.ndarray) -> list[np.ndarray]:
    """Return the borders of white patches: the brighter ones of what is not background.

    The sides of the blocks are grey, between the dark table and the white top faces: a first
    threshold parts all blocks from the table, a second one parts white from grey.
    """
    bright = image[image > threshold_report(image).threshold]
    white = image > min(fixed_points(bright))
    return [border for border in follow_borders(white) if len(border) > 60]


def example_2(rig: cr.Rig, scene: Scene, plate: list[np.ndarray]) -> None:
    """Centroids of blocks and of discs."""
    borders, others = patches(scene.images[0]), patches(scene.images[1])
    centroids = np.array([border_centroid(border) for border in borders])
    second = np.array([border_centroid(border) for border in others])
    matcher = LiteralMatcher(rig.cameras, scene.masks, DEPTHS)
    small = matcher.match(centroids, footprint(59))
    empty = int(np.isnan(small.mismatch).sum())
    sides = [
        2 * int(np.ceil(np.linalg.norm(border - middle, axis=1).max())) + 1
        for border, middle in zip(borders, centroids, strict=True)
    ]
    found = join_matches(
        [matcher.match(c[None], footprint(n)) for c, n in zip(centroids, sides, strict=True)]
    )
    print(f"\nExample 2: centroids. With 59 x 59, {empty} of {len(small)} elements have no edge.")
    away = print_centroids("Table 5.3", found, second, sides)
    print(f"            largest difference {away:.2f} px (thesis: within 1 px)")
    print("\nTable 5.4   Points       Z mm   Z + 50 mm   Actual height mm")
    actual = {50.44: (440, 109), 44.18: (284, 99), 25.19: (137, 236), 75.07: (304, 264)}
    actual[25.06] = (426, 382)
    places = np.array(list(actual.values()))
    for number, (z, centroid) in enumerate(zip(heights(rig, found), centroids, strict=True), 1):
        height = list(actual)[int(np.linalg.norm(places - centroid, axis=1).argmin())]
        print(f"            {number:<6d} {z:10.2f} {z - TABLE_MM:9.2f} {height:14.2f}")
    discs = [
        np.array([border_centroid(border) for border in follow_borders(image > level)])
        for image in plate
        for level in [threshold_report(image).threshold]
    ]
    found = match_literal(plate, rig.cameras, discs[0], DEPTHS, side_px=59)
    away = print_centroids("\nDiscs      ", found, discs[1], [59] * len(found))
    print(f"            largest difference {away:.2f} px")


def print_centroids(
    title: str, found: LiteralMatches, second: np.ndarray, sides: list[int]
) -> float:
    """Print matches of centroids beside the centroids of the other image."""
    print(f"{title}   Element      Left camera       By morphology     From its borders")
    largest = 0.0
    for seed, match, side in zip(found.seed_px, found.xy_px, sides, strict=True):
        away = np.linalg.norm(second - match, axis=1)
        other = second[int(away.argmin())]
        largest = max(largest, float(away.min()))
        texts = "   ".join(f"{x:7.1f} {y:7.1f}" for x, y in (seed, match, other))
        print(f"            {side:3d} x {side:<3d}  {texts}")
    return largest


def example_points(rig: cr.Rig, scene: Scene, title: str, points: tuple) -> None:
    """Edge points of a scene, for examples 3 and 4."""
    pixels = scene.edge_pixels([near for _, near in points])
    found = match_literal(scene.images, rig.cameras, pixels, DEPTHS, side_px=15)
    z, truth = heights(rig, found), scene.truth(pixels)
    print(f"\n{title}, element 15 x 15")
    print("            Point                  Left       Right      Off px      Z mm   Missing")
    for row, (name, _) in enumerate(points):
        x, y = found.seed_px[row]
        u, v = found.xy_px[row]
        off = float(np.linalg.norm(found.xy_px[row] - truth[row]))
        missing = f"{found.mismatch[row]:.0f} of {found.pixels[row]}"
        print(
            f"            {name:20s} {x:4.0f} {y:4.0f}   {u:4.0f} {v:4.0f}   {off:7.2f} "
            f"{z[row]:10.2f}   {missing}  {format_flags(int(found.flags[row]))}"
        )
    print_share(found, truth)


def print_share(found: LiteralMatches, truth: np.ndarray) -> None:
    """Print how many matches are right."""
    right = np.linalg.norm(found.xy_px - truth, axis=1) < 1
    print(f"            right within 1 px: {right.sum()} of {len(right)}")


def main() -> None:
    """Run the four examples."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--scenes", type=Path, default=SHARED)
    folder = parser.parse_args().scenes
    rig, plate = calibrated()
    blocks = Scene(folder / "A_blocks")
    example_1(rig, blocks)
    example_2(rig, blocks, plate)
    example_points(rig, Scene(folder / "A_spring"), "Example 3: a spring on a base", SPRING)
    example_points(rig, Scene(folder / "A_parts"), "Example 4: three parts", PARTS)


if __name__ == "__main__":
    main()
