"""The best structuring element per point against every fixed one, with the literal matcher.

    python benchmarks/bench_structuring.py [--scenes A_blocks ...] [--others] [--sensitivity]
    python benchmarks/bench_structuring.py --scene FOLDER [--scene FOLDER]

For each rendered scene: the share of edge points, visible in both views, that each fixed element
of four shapes and six sizes puts right within 1 px; the share of the element that
`closerange.matching.element_choice` chooses for each point from the images alone; the hindsight
oracle (right if any of the 24 is); and how much of the gap between the best fixed element, which
differs from scene to scene and which nobody knows beforehand, and the oracle is closed.

With 24 tries on a segment of 100 to 160 px some hits of the oracle are luck: the share of points
at which two elements or more are right stands beside it.

The standard error beside the gain takes points as independent; neighbours on an edge are not, so
that it is rather twice as large.

`--others` adds pairs of views on which the rule was not found: the four scenes were looked at while
it was made; `--scene` any folders of their layout. Beside the choice stands one with a prior from
the pair of views: distinctness times the square root of the odds that a match of the element
returns. It wins where nearly all of a pair is best seen by the largest element, and loses on
slanted and cluttered parts, so that it is not part of the rule. `--sensitivity` varies the
constants of the choice.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np

from closerange.features.edges import find_edges
from closerange.matching import element_choice
from closerange.matching.element_choice import ELEMENTS, SIZES_PX, match_with_best_element
from closerange.matching.literal import binary_images
from closerange.matching.search import between_planes
from matching.scene_truth import Kind, SceneTruth

SCENES = ("A_blocks", "B_blocks", "A_spring", "A_parts")
RENDERED = Path(__file__).resolve().parents[1].parent / "shared" / "data" / "rendered"
OTHERS = (
    *((name, "right", "left") for name in SCENES),
    ("A_pick", "left", "right"),
    ("A_pick", "right", "left"),
    *(
        (name, *pair)
        for name in ("A_blocks", "A_parts")
        for pair in (("left", "third"), ("right", "third"), ("third", "left"))
    ),
)
FRAMES = {"A_pick": "_f0"}
"""What follows the camera in the names of a scene's images; its truth is of that frame."""

Z_MM = (-53.0, 50.0)
RIGHT_PX = 1.0

VARIANTS: dict[str, dict[str, float]] = {
    "as is": {},
    "peak 1 px": {"PEAK_PX": 1},
    "peak 3 px": {"PEAK_PX": 3},
    "thickness 1 px": {"THICKNESS_PX": 1.0},
    "thickness 10 px": {"THICKNESS_PX": 10.0},
    "unlike 0.05": {"UNLIKE": 0.05},
    "unlike 0.2": {"UNLIKE": 0.2},
    "own share 0.3": {"OWN_SHARE": 0.3},
    "own share 0.7": {"OWN_SHARE": 0.7},
    "returns to 1.5 px": {"RETURN_PX": 1.5},
    "returns to 3 px": {"RETURN_PX": 3.0},
}


class Scene:
    """Visible edge points of one scene and what is needed to match them."""

    def __init__(self, folder: Path, first: str = "left", second: str = "right") -> None:
        truth = SceneTruth(folder, first, second)
        self.cameras = (truth.first, truth.second)
        frame = FRAMES.get(folder.name, "")
        images = [cv2.imread(str(folder / f"{name}{frame}.png"), -1) for name in (first, second)]
        self.masks = binary_images(images)
        edges = find_edges(images[0])
        known = truth.of(edges.xy_px, edges.tangent)
        # mesh edges are listed if left and right see them; another view may not
        visible = (known.kind == int(Kind.edge)) & truth.seen(known.xyz_mm)
        self.points, self.truth = edges.xy_px[visible], known.xy_px[visible]

    def right(self, found: np.ndarray) -> np.ndarray:
        """Tell which of places (N, ..., 2) are right; NaN is not."""
        wanted = self.truth.reshape(len(found), *(1,) * (found.ndim - 2), 2)
        return np.linalg.norm(found - wanted, axis=-1) < RIGHT_PX

    def choice(self) -> element_choice.ElementChoice:
        """Match with the element that suits each point."""
        return match_with_best_element(self.cameras, self.masks, self.points, between_planes(*Z_MM))


def closed(chosen: np.ndarray, every: np.ndarray) -> float:
    """Return the share of the gap between the best fixed element and the oracle."""
    fixed = every.mean(axis=0).max()
    return float((chosen.mean() - fixed) / (every.any(axis=1).mean() - fixed))


def report(name: str, scene: Scene) -> None:
    """Print one scene."""
    start = time.process_time()
    choice = scene.choice()
    microseconds = (time.process_time() - start) * 1e6 / max(len(choice), 1)
    every, chosen = scene.right(choice.xy_px), scene.right(choice.matches.xy_px)
    share = every.mean(axis=0)
    print(f"\n{name}: {len(choice)} visible edge points, right within {RIGHT_PX:g} px, %")
    print("  size      " + "".join(f"{size:7d}" for size in SIZES_PX))
    for shape in dict.fromkeys(shape for shape, _ in ELEMENTS):
        row = [share[ELEMENTS.index((shape, size))] for size in SIZES_PX]
        print(f"  {shape:10s}" + "".join(f"{100 * value:7.1f}" for value in row))
    best = int(np.argmax(share))
    twice = (every.sum(axis=1) > 1).mean()
    # standard error of the difference to the best fixed element, points taken as independent
    apart = chosen.astype(float) - every[:, best]
    print(f"  best fixed  {100 * share[best]:.1f}  ({ELEMENTS[best][0]} {ELEMENTS[best][1]})")
    print(
        f"  chosen      {100 * chosen.mean():.1f}  "
        f"(+{100 * apart.mean():.1f} +- {100 * apart.std() / np.sqrt(len(apart)):.1f})"
    )
    print(f"  oracle      {100 * every.any(axis=1).mean():.1f}  (two or more {100 * twice:.1f})")
    print(f"  gap closed  {100 * closed(chosen, every):.0f} %")
    clean = choice.matches.flags == 0
    print(
        f"  unflagged   {100 * clean.mean():.1f} % of the points, "
        f"{100 * chosen[clean].mean():.1f} % of them right"
    )
    print(f"  time        {microseconds:.0f} us per point, one thread, 24 elements, both ways")
    numbers = np.bincount(choice.element[choice.element >= 0], minlength=len(ELEMENTS))
    print("  chosen how often, %:")
    for first in range(0, len(ELEMENTS), len(SIZES_PX)):
        row = numbers[first : first + len(SIZES_PX)] / len(choice)
        print(f"  {ELEMENTS[first][0]:10s}" + "".join(f"{100 * value:7.1f}" for value in row))


def with_prior(choice: element_choice.ElementChoice) -> np.ndarray:
    """Return the elements chosen with a prior: how often each one's matches return in this pair."""
    found = choice.distinctness > 0
    often = (choice.returns.sum(axis=0) + 1) / (np.isfinite(choice.xy_px[..., 0]).sum(axis=0) + 2)
    value = choice.distinctness * choice.support * np.sqrt(often / (1 - often))
    merit = 4.0 * found + 2.0 * choice.returns + choice.centred + value / (1 + value.max(initial=0))
    return np.asarray(np.argmax(merit, axis=1))


def others(pairs: Sequence[tuple[Path, str, str]]) -> None:
    """Print one line for each pair of views that the rule was not found on."""
    print("\nOther pairs of views, right within 1 px, %")
    print(
        "  pair                        points   best fixed      chosen   gain   oracle  closed"
        "   prior   gain"
    )
    for folder, first, second in pairs:
        scene = Scene(folder, first, second)
        choice = scene.choice()
        every, chosen = scene.right(choice.xy_px), scene.right(choice.matches.xy_px)
        share = every.mean(axis=0)
        best = int(np.argmax(share))
        prior = every[np.arange(len(every)), with_prior(choice)].mean()
        label = f"{folder.name} {first} > {second}"
        kind = f"{ELEMENTS[best][0]} {ELEMENTS[best][1]}"
        print(
            f"  {label:27s} {len(choice):6d}  {100 * share[best]:5.1f} {kind:10s}"
            f"{100 * chosen.mean():7.1f} {100 * (chosen.mean() - share[best]):+6.1f} "
            f"{100 * every.any(axis=1).mean():8.1f} {100 * closed(chosen, every):7.0f}"
            f"{100 * prior:8.1f} {100 * (prior - share[best]):+6.1f}",
            flush=True,
        )


def sensitivity(scenes: dict[str, Scene]) -> None:
    """Print the gap closed for other constants."""
    print("\nShare of the gap closed, %, when a constant is another")
    print("  " + " " * 20 + "".join(f"{name:>10s}" for name in scenes))
    for label, changes in VARIANTS.items():
        usual = {name: getattr(element_choice, name) for name in changes}
        for name, value in changes.items():
            setattr(element_choice, name, value)
        row = []
        for scene in scenes.values():
            choice = scene.choice()
            row.append(closed(scene.right(choice.matches.xy_px), scene.right(choice.xy_px)))
        for name, value in usual.items():
            setattr(element_choice, name, value)
        print(f"  {label:20s}" + "".join(f"{100 * value:10.0f}" for value in row))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--scenes", nargs="+", default=SCENES)
    parser.add_argument("--folder", type=Path, default=RENDERED)
    parser.add_argument("--others", action="store_true")
    parser.add_argument("--scene", type=Path, action="append", default=[], metavar="FOLDER")
    parser.add_argument("--sensitivity", action="store_true")
    options = parser.parse_args()
    cv2.setNumThreads(1)
    if options.scene:
        ways = (("left", "right"), ("right", "left"))
        others([(folder, *way) for folder in options.scene for way in ways])
        return
    scenes = {name: Scene(options.folder / name) for name in options.scenes}
    for name, scene in scenes.items():
        report(name, scene)
    if options.others:
        others([(options.folder / name, first, second) for name, first, second in OTHERS])
    if options.sensitivity:
        sensitivity(scenes)


if __name__ == "__main__":
    main()
