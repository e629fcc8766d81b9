"""Table 1: simulated rigs, white noise, right model; 3-D errors of positions not used before."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from importlib import import_module
from typing import Any

import numpy as np

from closerange.features.control import ControlPoints
from closerange.features.image_points import ImagePoints
from closerange.position.measure import measure_points
from closerange.rig.calibrate import calibrate_rig
from closerange.verification.bound import BROWN, position_bound, rms_3d_mm
from closerange.verification.scenes import (
    SyntheticRig,
    control_grid,
    observe,
    random_positions,
    rig_a,
    rig_b,
)
from peer_tables.table import (
    OURS,
    PEER,
    VARIANT,
    Bar,
    FloatArray,
    Measured,
    Quantity,
    bars,
    lines,
    rotated,
    run,
    timed,
)
from peers import opencv_points, thesis_dlt
from thesis.tables import Lines

HELD_OUT = 400
QUANTITIES = (Quantity("error", "um", 1000, 2), Quantity("calibration", "um", 1000, 2))

Calibrate = Callable[[FloatArray, Sequence[FloatArray], Sequence[tuple[int, int]]], Any]


@dataclass(frozen=True, slots=True, eq=False)
class _Data:
    """One repeat: control seen with noise, held-out positions seen with and without it."""

    scene: SyntheticRig
    control: ControlPoints
    seen: ImagePoints
    held_out: ControlPoints
    held_out_seen: tuple[ImagePoints, ImagePoints]

    def pixels(self, points: ImagePoints) -> list[FloatArray]:
        """Return what the peers take: one array a camera."""
        return [points.of_camera(camera.name).xy_px for camera in self.scene.cameras]


def compare(repeats: int, seed: int) -> tuple[Lines, list[Bar]]:
    """Run all scenes; return their tables and bars."""
    text: Lines = []
    held: list[Bar] = []
    peers, absent = _peers()
    for scene in (rig_a(), rig_b()):
        for count in (27, 63):
            rng = np.random.default_rng((seed, count))
            methods = _scene(scene, control_grid(count), repeats, rng, peers)
            where = f"rig {scene.name}, {count} points"
            text += lines(f"Positions, {where}", methods, QUANTITIES, "calibration")
            text += [_bound(scene, count, rng), ""]
            held += bars(where, methods, QUANTITIES)
    text += [
        (
            f"'error': 3-D RMS of {HELD_OUT} held-out positions from noisy pixels, 'calibration': "
            "from noise-free ones, what averaging cannot remove; medians of "
            f"{repeats} calibrations, ratios to 'closerange brown' on the same data."
        ),
        *absent,
    ]
    return text, held


def _peers() -> tuple[dict[str, Calibrate], Lines]:
    """Return the peers that are installed, and why others are not run."""
    found: dict[str, Calibrate] = {
        "cv2 calibrateCamera, k3 fixed": opencv_points.calibrate,
        "cv2 calibrateCamera, k3 free (its default)": partial(
            opencv_points.calibrate, free_k3=True
        ),
        "thesis DLT, no lens": thesis_dlt.calibrate,
    }
    absent = ["", "not run: aniposelib; it adjusts boards in unknown poses, not known points."]
    try:
        mrcal_points = import_module("peers.mrcal_points")
        found["mrcal, regularised (its default)"] = mrcal_points.calibrate
        found["mrcal, not regularised"] = partial(mrcal_points.calibrate, regularised=False)
    except ImportError as error:
        absent.append(
            f"not run: mrcal ({error}); it has wheels for CPython 3.12 and 3.13 only: pip install "
            "numpysane; pip install --no-deps mrcal."
        )
    try:
        found["COLMAP, constant points"] = import_module("peers.colmap_points").calibrate
    except ImportError as error:
        absent.append(f"not run: COLMAP ({error}); pip install pycolmap.")
    return found, absent


def _scene(
    scene: SyntheticRig,
    control: ControlPoints,
    repeats: int,
    rng: np.random.Generator,
    peers: dict[str, Calibrate],
) -> list[Measured]:
    work: dict[str, Callable[[_Data], tuple[float, ...]]] = {
        f"closerange {model}": partial(_ours, model=model) for model in ("brown", "auto", "dlt")
    }
    work |= {name: partial(_peer, calibrate=calibrate) for name, calibrate in peers.items()}
    methods = [Measured(name, _kind(name)) for name in work]
    for repeat in range(-1, repeats):  # the first one warms up
        held_out = random_positions(HELD_OUT, scene.volume_mm, rng, prefix="h")
        noisy, exact = (
            observe(scene.cameras, held_out, noise_px=noise, rng=rng)
            for noise in (scene.noise_px, 0.0)
        )
        seen = observe(scene.cameras, control, noise_px=scene.noise_px, rng=rng)
        data = _Data(scene, control, seen, held_out, (noisy, exact))
        for method in rotated(methods, repeat):
            run(method, partial(work[method.method], data), len(QUANTITIES))
        if repeat < 0:
            methods = [Measured(name, _kind(name)) for name in work]
    return methods


def _kind(name: str) -> str:
    if not name.startswith("closerange"):
        return PEER
    return VARIANT if name.endswith("dlt") else OURS


def _ours(data: _Data, model: str) -> tuple[float, ...]:
    sizes = {camera.name: camera.size_px for camera in data.scene.cameras}
    seconds, rig = timed(lambda: calibrate_rig(data.seen, data.control, sizes, model=model))
    found = [measure_points(rig, points).xyz_mm for points in data.held_out_seen]
    return seconds, *(_rms(xyz - data.held_out.xyz_mm) for xyz in found)


def _peer(data: _Data, calibrate: Calibrate) -> tuple[float, ...]:
    sizes = [camera.size_px for camera in data.scene.cameras]
    xyz, xy = np.array(data.control.xyz_mm), [np.array(p) for p in data.pixels(data.seen)]
    seconds, cameras = timed(lambda: calibrate(xyz, xy, sizes))
    found = [cameras.positions(data.pixels(points)) for points in data.held_out_seen]
    return seconds, *(_rms(xyz - data.held_out.xyz_mm) for xyz in found)


def _rms(error: FloatArray) -> float:
    return float(np.sqrt(np.mean(np.sum(error**2, axis=1))))


def _bound(scene: SyntheticRig, count: int, rng: np.random.Generator) -> str:
    held_out = random_positions(HELD_OUT, scene.volume_mm, rng)
    bound = position_bound(
        scene.cameras, BROWN, control_grid(count).xyz_mm, held_out.xyz_mm, scene.noise_px
    )
    total, calibration = (1000 * rms_3d_mm(cov) for cov in bound)
    return (
        f"Cramér-Rao bound of an unbiased calibration: {total:.2f} um, of which calibration "
        f"{calibration:.2f} um."
    )
