"""The thesis' matcher, literally: time, share of right matches, and what its rules buy.

    python benchmarks/bench_literal.py [--scenes A_blocks ...] [--sample 150]

Time is processor time of one thread, the best of several runs, with all that a pair of images
costs after its edge images (which are timed apart), beside that of a fixed loop (a product of two
300 x 300 matrices) that tells how fast the machine is at that moment. Shares are of the edge points
that both views see, right within 1 px.

"image": the whole image 2 as neighbourhood instead of the epipolar segment (section 5.4), for a
sample of the points. "original": the images thresholded instead of their edge strength (5.3).
"larger": by how much an element mapped through Z_upper is larger, as a length, than it is seen
by camera 2 at Z_lower; section 5.5 claims that it never is.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np

from closerange.features.edges import find_edges
from closerange.flags import Flag
from closerange.matching.literal import LiteralMatcher, binary_images
from closerange.matching.literal_element import footprint
from closerange.matching.literal_matches import LiteralMatches
from closerange.matching.search import between_planes, upper_plane_mapping
from matching.scene_truth import Kind, SceneTruth

SCENES = ("A_blocks", "B_blocks", "A_spring", "A_parts")
RENDERED = Path(__file__).resolve().parents[1].parent / "shared" / "data" / "rendered"
Z_MM = (-53.0, 50.0)
SIDES = (15, 59)


class Scene:
    """Images, edge points and truth of one scene."""

    def __init__(self, folder: Path) -> None:
        truth = SceneTruth(folder)
        self.name = folder.name
        self.cameras = (truth.first, truth.second)
        self.images = [
            cv2.imread(str(folder / f"{camera.name}.png"), -1) for camera in self.cameras
        ]
        edges = find_edges(self.images[0])
        known = truth.of(edges.xy_px, edges.tangent)
        self.every = edges.xy_px
        self.visible = np.flatnonzero(known.kind == int(Kind.edge))
        self.truth = known.xy_px
        self.masks = binary_images(self.images)

    def matcher(self, masks: tuple | None = None, band_px: float = 0.5) -> LiteralMatcher:
        """Return a new matcher: its preparation is part of its time."""
        return LiteralMatcher(
            self.cameras, masks or self.masks, between_planes(*Z_MM), band_px=band_px
        )

    def right(self, found: LiteralMatches, rows: np.ndarray) -> float:
        """Return the share of right matches, per cent."""
        away = np.linalg.norm(found.xy_px - self.truth[rows], axis=1)
        return 100 * float((away < 1).mean())


def best_time(work: Callable[[], object], runs: int) -> float:
    """Return the least processor time of several runs, s."""
    least = np.inf
    for _ in range(runs):
        start = time.process_time()
        work()
        least = min(least, time.process_time() - start)
    return least


def timing(scene: Scene, runs: int = 15) -> None:
    """Print times and numbers of operations."""
    matrix = np.random.default_rng(0).random((300, 300))
    loop = best_time(lambda: matrix @ matrix, 30)
    count = len(scene.every)
    masks = best_time(lambda: binary_images(scene.images), runs)
    print(f"\n{scene.name}: all {count} edge points; fixed loop {1e3 * loop:.2f} ms")
    print(f"  edge images of both views {1e3 * masks:.1f} ms")
    for side in SIDES:
        inside = footprint(side)
        total = best_time(lambda inside=inside: scene.matcher().match(scene.every, inside), runs)
        matcher = scene.matcher()
        search = matcher.search(scene.every)
        elements, places = matcher.elements(search, inside), search.places
        scan = best_time(lambda m=matcher, e=elements, p=places: m.scan(e, p), runs)
        number = float(places.valid.sum(axis=1).mean())
        print(
            f"  {side} x {side}: {1e6 * total / count:.1f} us per point, of it scanning "
            f"{1e6 * scan / count:.1f}: {number:.0f} places x {elements.blocks.mean():.1f} blocks, "
            f"{1e9 * scan / (number * elements.blocks.sum()):.2f} ns each; "
            f"{elements.pixels.mean():.0f} edge pixels"
        )


def shares(scene: Scene) -> None:
    """Print shares of right matches for sides, bands and thresholds."""
    points = scene.every[scene.visible]
    original = binary_images(scene.images, original=True)
    print(f"\n{scene.name}: {len(points)} visible edge points")
    print("  side   band 0.5   band 1.0   band 1.5   original   ambiguous   no edge")
    for side in SIDES:
        inside = footprint(side)
        row = [
            scene.right(scene.matcher(band_px=band).match(points, inside), scene.visible)
            for band in (0.5, 1.0, 1.5)
        ]
        row.append(scene.right(scene.matcher(original).match(points, inside), scene.visible))
        found = scene.matcher().match(points, inside)
        row.extend(
            100 * ((found.flags & flag) > 0).mean() for flag in (Flag.ambiguous, Flag.no_edge)
        )
        print(f"  {side:4d}" + "".join(f"{value:11.1f}" for value in row))


def neighbourhood(scene: Scene, sample: int) -> None:
    """Print what the segment buys against the whole image."""
    rows = np.random.default_rng(0).choice(scene.visible, min(sample, len(scene.visible)), False)
    points, matcher = scene.every[rows], scene.matcher()
    for side in SIDES:
        inside = footprint(side)
        for label, whole in (("segment", False), ("image", True)):
            start = time.process_time()
            found = matcher.match(points, inside, whole_image=whole)
            spent = time.process_time() - start
            away = np.linalg.norm(found.xy_px - scene.truth[rows], axis=1)
            wrong = away[~(away < 3)]
            print(
                f"  {side:2d} x {side}, {label:8s} right {100 * (away < 1).mean():5.1f} %, "
                f"false by more than 3 px {100 * len(wrong) / len(rows):5.1f} %, "
                f"median of these {np.nanmedian(wrong):5.0f} px, "
                f"{1e6 * spent / len(rows):8.0f} us per point"
            )


def sizes(scene: Scene) -> None:
    """Print whether an element through Z_upper is 'if not equal, smaller'."""
    points = scene.every[scene.visible]
    area = [
        np.abs(np.linalg.det(upper_plane_mapping(*scene.cameras, points, z).jacobian))
        for z in (-50.0, 50.0)
    ]
    larger = 100 * (np.sqrt(area[0] / area[1]) - 1)
    low, middle, high = np.percentile(larger, (0, 50, 100))
    print(
        f"  larger by {low:+.1f} to {high:+.1f} % (median {middle:+.1f} %), so not smaller at "
        f"{100 * (larger > 0).mean():.0f} % of the points"
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--scenes", nargs="+", default=SCENES)
    parser.add_argument("--folder", type=Path, default=RENDERED)
    parser.add_argument("--sample", type=int, default=150)
    options = parser.parse_args()
    cv2.setNumThreads(1)
    scenes = [Scene(options.folder / name) for name in options.scenes]
    for scene in scenes[:1]:
        timing(scene)
    for scene in scenes:
        shares(scene)
        neighbourhood(scene, options.sample)
        sizes(scene)


if __name__ == "__main__":
    main()
