"""Render the held-out scenes of `rendering.scenes` with exact truth.

    python benchmarks/rendering/render.py --out FOLDER [--scene NAME] [--samples N]

Needs Blender as a Python module, `pip install 'bpy==4.2.*' scipy opencv-python-headless`, in a
separate Python 3.11 environment; it is no dependency of closerange, nor is closerange one of it.
Each scene becomes FOLDER/NAME in the layout of the shared rendered scenes, ready for
``bench_matching.py --scene FOLDER/NAME``. Images are not kept in the repository: the same seeds
give the same truth, and the same images but for the rounding of another processor.
"""

from __future__ import annotations

import argparse
import shutil
import sys
import time
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

NEEDS = "pip install 'bpy==4.2.*' scipy opencv-python-headless"


def main() -> int:
    """Render the chosen scenes; return the exit code."""
    try:
        import bpy  # noqa: F401, PLC0415
    except ImportError:
        print(
            f"needs `{NEEDS}` in a separate Python 3.11 environment; it is no dependency of "
            "closerange",
            file=sys.stderr,
        )
        return 2
    from rendering.scenes import SCENES  # noqa: PLC0415

    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--out", type=Path, required=True, metavar="FOLDER")
    parser.add_argument("--scene", action="append", choices=sorted(SCENES))
    parser.add_argument("--samples", type=int, help="paths per fine pixel; each scene has its own")
    options = parser.parse_args()
    for name in options.scene or SCENES:
        _render(name, options.out, options.samples)
    return 0


def _render(name: str, out: Path, samples: int | None) -> None:
    """Render one scene beside its place, then put it there whole."""
    from dataclasses import replace  # noqa: PLC0415

    import numpy as np  # noqa: PLC0415

    from rendering import blender, folder  # noqa: PLC0415
    from rendering.scenes import SCENES  # noqa: PLC0415
    from rendering.sensor import irradiance  # noqa: PLC0415

    start = time.perf_counter()
    scene = SCENES[name]()
    scene = replace(scene, samples=samples or scene.samples)
    part = out / f"{name}.part"
    part.mkdir(parents=True, exist_ok=True)
    lines = folder.write_truth(part, scene)
    print(f"{name}: truth after {time.perf_counter() - start:.0f} s", flush=True)
    light = []
    for view in scene.views:
        picture, pinhole = blender.pictures(scene, view)
        light.append(irradiance(picture, pinhole, view, scene.fineness, scene.sensor.psf_sigma_px))
        print(f"{name}: {view.name} after {time.perf_counter() - start:.0f} s", flush=True)
    full_scale = float(np.percentile(light[0], 99)) / scene.bright
    lines += folder.write_images(part, scene, light, full_scale)
    folder.write_readme(part, scene, lines)
    if (out / name).exists():
        shutil.rmtree(out / name)
    part.rename(out / name)
    print("\n".join(lines), flush=True)


if __name__ == "__main__":
    sys.exit(main())
