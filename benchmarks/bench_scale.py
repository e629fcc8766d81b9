"""What the default matcher costs as images grow: time, memory, and what is still right.

    python benchmarks/bench_scale.py [--quick] [--repeats 3] [--json FILE]

Boxes on a table (see `matching.box_scenes`), from 640 x 512 pixels to 20 Mpx; with the pixels also
the boxes become more, as finer cameras are bought to see finer parts. All edge points of the first
image are matched. OpenCV's SGBM-HH on the same points stands beside it where its volume of costs
fits into the memory allowed.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
import warnings
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from closerange.errors import CloseRangeWarning
from closerange.matching.candidates import find_candidates
from closerange.matching.matcher import match_views, views_of
from closerange.matching.pencil import Pencil
from closerange.rig.camera import Camera
from matching.box_scenes import BoxScene, FloatArray, box_scene
from matching.memory import peak_mb
from matching.peers import semi_global
from peer_tables.machine import NoiseMeter, versions
from thesis.tables import Lines, fixed, markdown

SIZES = ((1.0, 3), (2.0, 5), (4.0, 9), (7.8, 18))
"""Pixels per pixel of 640 x 512, and boxes in a row: 0.3, 1.3, 5 and 20 Mpx."""

SEMI_GLOBAL_MB = 4000.0
"""What SGBM may need; a cost has two bytes and is kept twice."""

RIGHT_PX = 1.0
"""In pixels of the image at hand: what is one pixel of 20 Mpx is an eighth of one of 0.3 Mpx."""

LONG_S = 30.0
"""What takes so long is not repeated."""


@dataclass(frozen=True, slots=True)
class Cost:
    """Median seconds of the repeats, and the most memory taken beside what was there before."""

    wall_s: float
    cpu_s: float
    memory_mb: float


@dataclass(frozen=True, slots=True)
class Figures:
    """One size; shares are of the points on box edges that both views see."""

    size_px: tuple[int, int]
    points: int
    candidates: int
    known: int
    edges: Cost
    matching: Cost
    right: float
    kept: float
    kept_right: float
    peer: Cost | None
    peer_right: float
    peer_needs_mb: float

    @property
    def mpx(self) -> float:
        """Millions of pixels."""
        return self.size_px[0] * self.size_px[1] / 1e6


def measured(scene: BoxScene, repeats: int) -> Figures:
    """Find edges and match them; measure both."""
    edges, views = _cost(lambda: views_of(scene.cameras, scene.images), repeats)
    points = views[0].edges.xy_px
    matching, found = _cost(lambda: match_views(views, scene.volume_mm, seeds_px=points), repeats)
    truth = scene.truth(points)
    known = np.isfinite(truth).all(axis=1)
    right = _right(found.xy_px[:, 1], truth)
    kept = known & (found.flags[:, 1] == 0)
    needs = _semi_global_mb(scene.cameras, scene.volume_mm)
    peer, peer_right = None, float("nan")
    if needs <= SEMI_GLOBAL_MB:
        peer, (place, _) = _cost(
            lambda: semi_global.match(scene.images, scene.cameras, points, scene.volume_mm), repeats
        )
        peer_right = float(_right(place, truth)[known].mean())
    pencil = Pencil.of(*scene.cameras)
    candidates = find_candidates(pencil, views[0].edges, views[1].edges, scene.volume_mm)
    return Figures(
        size_px=scene.cameras[0].size_px,
        points=len(points),
        candidates=len(candidates),
        known=int(known.sum()),
        edges=edges,
        matching=matching,
        right=float(right[known].mean()),
        kept=float(kept.sum() / known.sum()),
        kept_right=float(right[kept].mean()),
        peer=peer,
        peer_right=peer_right,
        peer_needs_mb=needs,
    )


def table(every: Sequence[Figures]) -> Lines:
    """Write costs and shares."""
    costs = markdown(
        (
            "image",
            "edge points",
            "candidates per point",
            "edges: wall s",
            "CPU s",
            "MB",
            "matching: wall s",
            "CPU s",
            "CPU us per point",
            "per candidate",
            "MB",
        ),
        [
            [
                f"{f.size_px[0]} x {f.size_px[1]}, {f.mpx:.1f} Mpx",
                str(f.points),
                fixed(f.candidates / f.points, 1),
                *_written(f.edges),
                *_written(f.matching)[:2],
                fixed(1e6 * f.matching.cpu_s / f.points, 0),
                fixed(1e6 * f.matching.cpu_s / f.candidates, 0),
                fixed(f.matching.memory_mb, 0),
            ]
            for f in every
        ],
    )
    shares = markdown(
        (
            "image",
            "on box edges both see",
            f"within {RIGHT_PX:g} px %",
            "kept %",
            "right of kept %",
            "SGBM-HH within %",
            "wall s",
            "CPU s",
            "MB",
        ),
        [
            [
                f"{f.mpx:.1f} Mpx",
                str(f.known),
                fixed(100 * f.right, 1),
                fixed(100 * f.kept, 1),
                fixed(100 * f.kept_right, 2),
                *(
                    (fixed(100 * f.peer_right, 1), *_written(f.peer))
                    if f.peer
                    else (f"not run: needs {f.peer_needs_mb / 1000:.0f} GB", "", "", "")
                ),
            ]
            for f in every
        ],
    )
    return [*costs, *shares]


def growth(every: Sequence[Figures]) -> str:
    """Say how time and memory grow with the edge points."""
    points = np.log([f.points for f in every])
    texts = []
    for name, values in (
        ("CPU time", [f.matching.cpu_s for f in every]),
        ("memory", [f.matching.memory_mb for f in every]),
    ):
        if np.isfinite(values).all() and len(every) > 1:
            texts.append(f"{name} as their power {np.polyfit(points, np.log(values), 1)[0]:.2f}")
    return f"With the number of edge points grow: {', '.join(texts)}." if texts else ""


def main() -> int:
    """Measure all sizes; return the exit code."""
    options = _options()
    sizes = SIZES[:2] if options.quick else SIZES
    start = time.perf_counter()
    meter = NoiseMeter()
    meter.sample()
    print(f"# Cost of matching and size of images\n\n{versions()}\n")
    every = []
    for scale, boxes in sizes:
        every.append(measured(box_scene(scale, boxes), 1 if options.quick else options.repeats))
        print(f"measured {every[-1].mpx:.1f} Mpx", file=sys.stderr)
        meter.sample()
    print("\n".join(table(every)))
    print(f"{growth(every)}\n\n{meter}\n\n{time.perf_counter() - start:.0f} s in all.")
    if options.json:
        entries = [asdict(figures) for figures in every]
        options.json.write_text(json.dumps(entries, indent=1) + "\n", encoding="utf-8")
    return 0


def _cost(work: Callable[[], Any], repeats: int) -> tuple[Cost, Any]:
    """Run once for memory and result, then for time."""

    def quietly() -> Any:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", CloseRangeWarning)
            return work()

    times = []

    def timed() -> Any:
        start = time.perf_counter(), time.process_time()
        result = quietly()
        times.append((time.perf_counter() - start[0], time.process_time() - start[1]))
        return result

    memory, result = peak_mb(timed)
    if times[0][0] < LONG_S:
        times.clear()  # the first run pays for cold caches and new memory
        for _ in range(repeats):
            timed()
    wall, cpu = np.median(times, axis=0)
    return Cost(float(wall), float(cpu), memory), result


def _right(place: FloatArray, truth: FloatArray) -> np.ndarray[Any, np.dtype[np.bool_]]:
    with np.errstate(invalid="ignore"):
        return np.asarray(np.linalg.norm(place - truth, axis=1) < RIGHT_PX)


def _semi_global_mb(cameras: Sequence[Camera], volume_mm: FloatArray) -> float:
    """Return the memory of the volume of costs, from the length of the segment in the middle."""
    width, height = cameras[0].size_px
    ray = cameras[0].directions([[width / 2, height / 2]])
    way = (volume_mm[:, 2] - cameras[0].centre_mm[2]) / ray[0, 2]
    ends = cameras[1].project(cameras[0].centre_mm + way[:, None] * ray)
    return float(4 * width * height * np.linalg.norm(ends[1] - ends[0]) / 1e6)


def _written(cost: Cost) -> tuple[str, str, str]:
    return fixed(cost.wall_s, 2), fixed(cost.cpu_s, 2), fixed(cost.memory_mb, 0)


def _options() -> argparse.Namespace:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--quick", action="store_true", help="two small sizes, one timed run")
    parser.add_argument("--repeats", type=int, default=3, help="timed runs of each")
    parser.add_argument("--json", type=Path, metavar="FILE", help="also write all figures")
    return parser.parse_args()


if __name__ == "__main__":
    sys.exit(main())
