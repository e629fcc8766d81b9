"""Table 2: real chessboard pairs; boards that took no part in the calibration are measured."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from importlib import import_module
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np

from closerange.features.chessboard import find_chessboard
from closerange.features.control import ControlPoints
from closerange.features.image_points import ImagePoints
from closerange.features.pattern import Chessboard
from closerange.features.target import Target
from closerange.images import read_image
from closerange.position.measure import measure_points
from closerange.rig.free_poses import calibrate_free_poses
from peer_tables.table import (
    OURS,
    PEER,
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
from peers import corner_sector, corner_subpix, opencv_stereo
from thesis.tables import Lines

FOLDER = "opencv-stereo-chessboard"
BOARD = Chessboard(rows=6, columns=9, square_mm=25.0)
CAMERAS = ("left", "right")
LEFT_OUT = 4
HALF_WINDOW = 5  # the tutorial's 11 is larger than half a square here: corners run away by 6 px
SAME_PX = 5.0  # squares are 30 px: another detector's corner is the same one or a whole square off

QUANTITIES = (
    Quantity("square length", "um", 1000, 1),
    Quantity("shape", "um", 1000, 1),
    Quantity("scale", "1e-6", 1e6, 0, judged=False),
)

Corners = dict[tuple[str, str], FloatArray]
"""(camera, placement) to corners in the target's order, px."""


@dataclass(frozen=True, slots=True, eq=False)
class _Pairs:
    """All placements, measured by several detectors, and which of them calibrate."""

    target: Target
    size_px: tuple[int, int]
    corners: dict[str, Corners]
    points: ImagePoints
    used: tuple[str, ...]
    left_out: tuple[str, ...]

    def lists(self, detector: str, placements: Sequence[str]) -> list[list[FloatArray]]:
        """Return one list of placements a camera."""
        found = self.corners[detector]
        return [[found[camera, name] for name in placements] for camera in CAMERAS]


def compare(data: Path, repeats: int, seed: int) -> tuple[Lines, list[Bar]]:
    """Leave placements out at random, calibrate from the others, measure those left out."""
    folder = data / FOLDER
    if not folder.is_dir():
        return [f"## Real chessboard: not run: no folder {folder.name} in the data", ""], []
    pairs, placements = _read(folder)
    work = _work()
    methods = [Measured(name, _kind(name)) for name in work]
    rng = np.random.default_rng(seed)
    for repeat in range(repeats):
        order = rng.permutation(placements).tolist()
        split = {"left_out": tuple(order[:LEFT_OUT]), "used": tuple(order[LEFT_OUT:])}
        case = _Pairs(pairs.target, pairs.size_px, pairs.corners, pairs.points, **split)
        for method in rotated(methods, repeat):
            run(method, partial(work[method.method], case), len(QUANTITIES))
    text = lines("Real chessboard pairs, unknown poses", methods, QUANTITIES, "calibration")
    text += [
        (
            f"{repeats} times {LEFT_OUT} of {len(placements)} placements, drawn at random, are "
            "left out of the calibration and measured. 'square length': RMS error of the distances "
            "of neighbouring corners, 25 mm; 'shape': 3-D RMS after the best rigid motion onto the "
            "flat board; 'scale': RMS of the boards' relative scale error. Medians over the draws; "
            "the board is not certified, so a common part of the scale may be its own."
        ),
        "",
    ]
    return text, bars("chessboard", methods, QUANTITIES)


def _work() -> dict[str, Callable[[_Pairs], tuple[float, ...]]]:
    ours, subpix, sector = "closerange corners", "cornerSubPix", "findChessboardCornersSB"
    joint = partial(opencv_stereo.calibrate, joint=True)
    default = partial(opencv_stereo.calibrate, joint=False)
    work: dict[str, Callable[[_Pairs], tuple[float, ...]]] = {
        f"closerange free poses, {ours}": _ours,
        f"stereoCalibrate joint, {ours}": partial(_peer, calibrate=joint, detector=ours),
        f"stereoCalibrate default, {ours}": partial(_peer, calibrate=default, detector=ours),
        f"stereoCalibrate joint, {subpix}": partial(_peer, calibrate=joint, detector=subpix),
        f"stereoCalibrate joint, {sector}": partial(_peer, calibrate=joint, detector=sector),
    }
    try:
        mrcal = import_module("peers.mrcal_board").calibrate
        work[f"mrcal, {ours}"] = partial(_peer, calibrate=mrcal, detector=ours)
        work[f"mrcal, {subpix}"] = partial(_peer, calibrate=mrcal, detector=subpix)
    except ImportError:
        pass  # the table of positions says why
    return work


def _kind(name: str) -> str:
    return OURS if name.startswith("closerange") else PEER


def _read(folder: Path) -> tuple[_Pairs, list[str]]:
    """Find the corners in all images by all detectors, in the same order."""
    names = sorted(path.stem.removeprefix("left") for path in folder.glob("left[0-9][0-9].jpg"))
    corners: dict[str, Corners] = {}
    tables = []
    target = Target.of(BOARD)
    shape = {"rows": BOARD.rows, "columns": BOARD.columns}
    for camera, name in product(CAMERAS, names):
        frame = read_image(folder / f"{camera}{name}.jpg", camera=camera)
        own = find_chessboard(frame, BOARD)
        found = {
            "closerange corners": own.xy_px,
            "cornerSubPix": corner_subpix.corners(frame.pixels, half_window=HALF_WINDOW, **shape),
            "findChessboardCornersSB": corner_sector.corners(frame.pixels, **shape),
        }
        for detector, xy in found.items():
            corners.setdefault(detector, {})[camera, name] = in_order(xy, own.xy_px)
        tables.append(
            ImagePoints.of(
                camera=camera,
                placement=name,
                point=target.point,
                xy_px=own.xy_px,
                cov_px2=own.cov_px2,
                flags=own.flags,
                size_px={camera: frame.size_px},
            )
        )
    points = tables[0]
    for table in tables[1:]:
        points = points + table
    return _Pairs(target, points.size_px[CAMERAS[0]], corners, points, (), ()), names


def in_order(xy_px: FloatArray, like_px: FloatArray) -> FloatArray:
    """Put corners in the order of known ones; NaN where none is near."""
    if not len(xy_px):
        return np.full(like_px.shape, np.nan)
    apart = np.linalg.norm(xy_px[None] - like_px[:, None], axis=2)
    nearest = apart.argmin(axis=1)
    near = apart[np.arange(len(like_px)), nearest] < SAME_PX
    return np.where(near[:, None], xy_px[nearest], np.nan)


def _ours(case: _Pairs) -> tuple[float, ...]:
    control = ControlPoints.of(case.target.point, case.target.xyz_mm)
    sizes = dict.fromkeys(CAMERAS, case.size_px)
    used = case.points.select([name in case.used for name in case.points.placement])
    seconds, rig = timed(lambda: calibrate_free_poses(used, control, sizes))
    found = []
    for name in case.left_out:
        chosen = case.points.select([placement == name for placement in case.points.placement])
        found.append(measure_points(rig, chosen).xyz_mm)
    return seconds, *_judge(found, case.target.xyz_mm)


def _peer(case: _Pairs, calibrate: Callable[..., Any], detector: str) -> tuple[float, ...]:
    board = np.array(case.target.xyz_mm)
    seen = case.lists(detector, case.used)
    seconds, cameras = timed(lambda: calibrate(board, seen, case.size_px))
    left, right = case.lists(detector, case.left_out)
    found = [cameras.positions(pair) for pair in zip(left, right, strict=True)]
    return seconds, *_judge(found, board)


def _judge(found: Sequence[FloatArray], board_mm: FloatArray) -> tuple[float, ...]:
    """Return RMS of square length and shape in mm and of the relative scale, over all boards."""
    lengths, shapes, scales = [], [], []
    for xyz in found:
        grid = xyz.reshape(BOARD.rows, BOARD.columns, 3)
        for axis in (0, 1):
            length = np.linalg.norm(np.diff(grid, axis=axis), axis=2)
            lengths.append(length.ravel() - BOARD.square_mm)
        a, b = xyz - xyz.mean(axis=0), board_mm - board_mm.mean(axis=0)
        u, _, vt = np.linalg.svd(b.T @ a)
        rotation = u @ np.diag([1.0, 1.0, np.linalg.det(u @ vt)]) @ vt
        turned = b @ rotation
        shapes.append(np.sum((a - turned) ** 2, axis=1))
        scales.append(np.sum(a * turned) / np.sum(turned**2) - 1)
    return tuple(
        float(np.sqrt(np.mean(values)))
        for values in (np.concatenate(lengths) ** 2, np.concatenate(shapes), np.square(scales))
    )
