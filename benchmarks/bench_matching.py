"""Matching beside its rivals, on the same points of every scene, in one run.

    python benchmarks/bench_matching.py [--quick] [--calibrated] [--json FILE] [--shared ../shared]
    python benchmarks/bench_matching.py --scene FOLDER [--scene FOLDER] [--calibration FOLDER]

Points are all thinned strong edge points (blur-minimum above Trussell's threshold). Rendered
scenes have exact truth (see `matching.scene_truth`); any folder of their layout can be given with
``--scene``. The speckled plate has the matches of another program, the rectified pair a map in
whole pixels; of both a part is taken, unless ``--whole``, which needs memory. ``--calibrated``
measures each rendered scene once more with cameras calibrated from the images of disc plates
beside it. Methods that cannot run are named with the reason.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from collections.abc import Iterator
from pathlib import Path

from matching import scenes
from matching.calibrations import calibrated_rig, calibration_folder
from matching.methods import methods
from matching.run import Result, run
from matching.scenes import Scene
from matching.tables import legend, tables
from peer_tables.machine import NoiseMeter, versions

RENDERED = ("A_blocks", "B_blocks", "A_spring", "A_parts")
NEEDED = ("cameras.json", "edge_points.csv", "truth_left.npz", "truth_right.npz", "left.png")


def main() -> int:
    """Print all tables; return the exit code."""
    options = _options()
    chosen = methods(options.method)
    if not chosen:
        print(f"no method is named like {', '.join(options.method)}", file=sys.stderr)
        return 2
    start = time.perf_counter()
    meter = NoiseMeter()
    meter.sample()
    print("# Matching\n")
    print(versions() + "\n")
    print("\n".join(legend()))
    every: list[Result] = []
    for scene in _scenes(options):
        results = [run(method, scene, 1 if options.quick else options.repeats) for method in chosen]
        every += results
        print("\n".join(tables(scene, results)), flush=True)
        meter.sample()
    print(f"{meter}\n\n{time.perf_counter() - start:.0f} s in all.")
    if options.json:
        entries = [result.as_dict() for result in every]
        options.json.write_text(json.dumps(entries, indent=1) + "\n", encoding="utf-8")
    return 0 if any(result.figures for result in every) else 1


def _scenes(options: argparse.Namespace) -> Iterator[Scene]:
    """Read one scene after the other; say which are not there."""
    data: Path = options.shared / "data"
    if not options.scene and not data.is_dir():
        _missing(data, "the scenes are in the shared data; give --shared or --scene FOLDER")
        return
    folders = options.scene or [data / "rendered" / name for name in RENDERED]
    if options.quick and not options.scene:
        folders = folders[:1]
    for folder in [] if options.real else folders:
        absent = [name for name in NEEDED if not (folder / name).is_file()]
        if absent:
            _missing(folder, f"a rendered scene has {', '.join(absent)}")
            continue
        scene = scenes.rendered(folder, tuple(options.z))
        yield scene
        if options.calibrated:
            yield from _calibrated(scene, folder, options.calibration)
    if not options.real and (options.scene or options.quick):
        return
    for folder, read in (
        (data / "dice-gt4-stereo", scenes.speckled_plate),
        (data / "opencv-pairs", scenes.aloe),
    ):
        if folder.is_dir():
            yield read(folder, whole=options.whole)
        else:
            _missing(folder, "this scene is left out")


def _calibrated(scene: Scene, folder: Path, calibration: Path | None) -> Iterator[Scene]:
    plates = calibration or calibration_folder(folder)
    if plates is None or not (plates / "targets.csv").is_file():
        _missing(plates or folder.parent, "no images of disc plates taken with the same cameras")
        return
    yield scene.with_rig(calibrated_rig(plates, tuple(camera.name for camera in scene.cameras)))


def _missing(path: Path, text: str) -> None:
    print(f"not run: {path}: {text}", file=sys.stderr)


def _options() -> argparse.Namespace:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--scene", type=Path, action="append", default=[], metavar="FOLDER")
    parser.add_argument(
        "--z", type=float, nargs=2, default=scenes.HEIGHTS_MM, metavar=("MIN", "MAX")
    )
    parser.add_argument("--calibrated", action="store_true", help="also with calibrated cameras")
    parser.add_argument("--calibration", type=Path, metavar="FOLDER", help="disc plates to use")
    parser.add_argument(
        "--method", action="append", default=[], help="only methods named like this"
    )
    parser.add_argument("--real", action="store_true", help="only the two real pairs")
    parser.add_argument("--repeats", type=int, default=5, help="timed runs of each method")
    parser.add_argument("--quick", action="store_true", help="one scene, one timed run")
    parser.add_argument("--whole", action="store_true", help="the two real pairs uncut")
    parser.add_argument("--json", type=Path, metavar="FILE", help="also write all figures")
    parser.add_argument("--shared", type=Path, default=Path(__file__).parents[1].parent / "shared")
    return parser.parse_args()


if __name__ == "__main__":
    sys.exit(main())
