"""Write a scene's folder: images, cameras, truth, edge points, objects, checks."""

from __future__ import annotations

import json
from dataclasses import asdict
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from rendering import checks
from rendering.cameras import CONVENTION, FloatArray, convergence
from rendering.edges import edge_points
from rendering.scene import Scene
from rendering.truth import Surfaces, truth_maps, visible

HEADER = "object,object_id,convex,X_mm,Y_mm,Z_mm,dx,dy,dz,u_left,v_left,u_right,v_right"


def write_truth(folder: Path, scene: Scene) -> list[str]:
    """Write everything but the images and the README; return lines of checks.

    Parameters
    ----------
    folder : Path
        Must exist.
    scene : Scene
        What to describe.

    Returns
    -------
    list of str
        Checks of what was written.
    """
    surfaces = scene.surfaces()
    lines = []
    for view in scene.views:
        others = [other for other in scene.views if other is not view]
        maps, closures = truth_maps(view, others, surfaces)
        np.savez_compressed(folder / f"truth_{view.name}.npz", **maps)
        for name, worst in closures.items():
            lines.append(f"exact closure {view.name}->{name}->{view.name}: max {worst:.1e} px")
    _write_json(folder / "objects.json", _objects(scene))
    _write_edges(folder / "edge_points.csv", scene, surfaces)
    for view in scene.views:
        others = [other for other in scene.views if other is not view]
        lines += [checks.there_and_back(folder, view, other) for other in others]
    xyz, _, *seen = _read_edges(folder)
    pairs = zip(scene.views[:2], seen, strict=True)
    return lines + [checks.reprojection(view, xyz, xy_px) for view, xy_px in pairs]


def write_images(
    folder: Path, scene: Scene, light: list[FloatArray], full_scale: float
) -> list[str]:
    """Expose all cameras, write their images and ``cameras.json``; return lines of checks.

    Parameters
    ----------
    folder : Path
        Must hold what `write_truth` wrote.
    scene : Scene
        Whose images they are.
    light : list of ndarray, shape (H, W)
        Mean light of each pixel of each view.
    full_scale : float
        Light that fills a pixel at gain 1.

    Returns
    -------
    list of str
        Checks of the images.
    """
    xyz, direction, *_ = _read_edges(folder)
    rng = np.random.default_rng(scene.seed)
    lines = []
    for view, gain, amount in zip(scene.views, scene.gains, light, strict=False):
        image: NDArray[np.uint8] = scene.sensor.numbers(amount * gain / full_scale, rng)
        cv2.imwrite(str(folder / f"{view.name}.png"), image)
        if view in scene.views[:2]:
            lines.append(checks.measured_edges(scene.sensor.linear(image), view, xyz, direction))
        dark, middle, bright = np.percentile(image, [1, 50, 99])
        lines.append(
            f"{view.name}: grey values p1 {dark:.0f}  median {middle:.0f}  p99 {bright:.0f}; "
            f"at 255 {100 * (image == 255).mean():.2f} % of pixels"
        )
    gains = {view.name: gain for view, gain in zip(scene.views, scene.gains, strict=False)}
    _write_json(
        folder / "cameras.json",
        {
            "convention": CONVENTION,
            **convergence(*scene.views[:2]),
            "cameras": {view.name: view.document() for view in scene.views},
            "sensor": {**asdict(scene.sensor), "exposure_scale": 1 / full_scale, "gains": gains},
        },
    )
    return lines


def write_readme(folder: Path, scene: Scene, lines: list[str]) -> None:
    """Write the README with all checks."""
    degrees, apart_mm = convergence(*scene.views[:2]).values()
    low, high = scene.heights_mm
    about = (
        f"{len(scene.views)} PNG images; {degrees:.1f} deg between the optical axes, which pass "
        f"{apart_mm:.1f} mm apart. Search heights: --z {low:g} {high:g}. Rendered by "
        f"benchmarks/rendering with {scene.samples} paths per fine pixel, {scene.fineness} x "
        f"{scene.fineness} of them per pixel. Conventions are those of the shared rendered scenes; "
        "(d) undoes gamma first."
    )
    text = [
        f"# {scene.name}",
        "",
        scene.text,
        "",
        about,
        "",
        "Checks:",
        "",
        "```",
        *lines,
        "```",
        "",
    ]
    (folder / "README.md").write_text("\n".join(text), encoding="utf-8")


def _write_edges(path: Path, scene: Scene, surfaces: Surfaces) -> None:
    """Write edge points that left and right see."""
    rows = []
    left, right = scene.views[:2]
    for number, solid in enumerate(scene.solids, start=1):
        table = edge_points(solid)
        if not len(table.xyz_mm):
            continue
        seen = visible(left, surfaces, table.xyz_mm) & visible(right, surfaces, table.xyz_mm)
        xyz, along, flag = table.xyz_mm[seen], table.direction[seen], table.convex[seen]
        values = np.column_stack([xyz, along, left.project(xyz), right.project(xyz)])
        for convex, row in zip(flag, values, strict=True):
            cells = ",".join(f"{value:.4f}" for value in row)
            rows.append(f"{solid.name},{number},{int(convex)},{cells}")
    path.write_text("\n".join([HEADER, *rows, ""]), encoding="utf-8")


def _read_edges(folder: Path) -> list[FloatArray]:
    """Return places, directions, and where left and right see them."""
    table = np.genfromtxt(folder / "edge_points.csv", delimiter=",", skip_header=1)
    return [table[:, 3:6], table[:, 6:9], table[:, 9:11], table[:, 11:13]]


def _objects(scene: Scene) -> dict[str, object]:
    ids = {"0": "work plane"}
    ids |= {str(number): solid.name for number, solid in enumerate(scene.solids, start=1)}
    return {
        "object_ids": ids,
        "objects": [
            {
                "name": solid.name,
                "kind": solid.kind,
                "size_mm": solid.size,
                "lowest_mm": solid.vertices_mm.min(axis=0).round(4).tolist(),
                "highest_mm": solid.vertices_mm.max(axis=0).round(4).tolist(),
                "finishes": [asdict(finish) for finish in solid.finishes],
            }
            for solid in scene.solids
        ],
    }


def _write_json(path: Path, document: object) -> None:
    path.write_text(json.dumps(document, indent=1) + "\n", encoding="utf-8")
