"""Table 4: chessboard corners in images drawn from a formula, through a lens, with exact truth."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

import cv2
import numpy as np

from closerange.features.chessboard import find_chessboard
from closerange.features.pattern import Chessboard
from closerange.geometry.transform import RigidTransform, rotation_from_vector
from closerange.images import Frame
from closerange.rig.camera import Camera
from closerange.rig.distortion import BrownIdeal
from peer_tables.chessboard import in_order
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
from peers import corner_sector, corner_subpix
from thesis.tables import Lines

SIZE_PX = (640, 480)
BOARD = Chessboard(rows=6, columns=9, square_mm=25.0)
LENS = BrownIdeal(k1=-0.25, k2=0.08)
FOCAL_PX = 700.0
SUB = 5  # samples along each side of a pixel
DARK, LIGHT, GROUND, NOISE = 40.0, 190.0, 120.0, 3.0
KINDS = {"large, sharp": (36.0, 0.7), "small, sharp": (18.0, 0.7), "large, soft": (36.0, 1.5)}
"""Square in px at the board's middle and sigma of the blur in px."""

QUANTITIES = (Quantity("corner", "px", 1, 4),)


@dataclass(frozen=True, slots=True, eq=False)
class _View:
    frame: Frame
    truth_px: FloatArray


def compare(images: int, timings: int, seed: int) -> tuple[Lines, list[Bar]]:
    """Draw boards in random attitudes and find their corners."""
    text: Lines = []
    held: list[Bar] = []
    for kind, (square_px, blur_px) in KINDS.items():
        rng = np.random.default_rng((seed, int(square_px), int(10 * blur_px)))
        views = [_draw(square_px, blur_px, rng) for _ in range(images)]
        methods = _measure(views, timings)
        title = f"Chessboard corners, {kind}: squares {square_px:g} px, blur {blur_px:g} px"
        text += lines(title, methods, QUANTITIES, "time")
        held += bars(f"corners, {kind}", methods, QUANTITIES)
    text += [
        (
            "RMS over an image's corners of the distance from the truth, medians over "
            f"{images} images of {BOARD.rows} x {BOARD.columns} corners, noise {NOISE:g} of "
            f"{LIGHT - DARK:g} grey values, tilts up to 35 degrees, lens k1 = {LENS.k1:g}. "
            "closerange's time includes OpenCV's finder, the order of the corners and their "
            "covariances."
        ),
        "",
    ]
    return text, held


def _measure(views: list[_View], timings: int) -> list[Measured]:
    work: dict[str, Callable[[_View], FloatArray]] = {
        "closerange": lambda view: find_chessboard(view.frame, BOARD).xy_px,
        "cv2 cornerSubPix, half window 11 (tutorial)": partial(
            _peer, method=partial(corner_subpix.corners, half_window=11)
        ),
        "cv2 cornerSubPix, half window 5": partial(
            _peer, method=partial(corner_subpix.corners, half_window=5)
        ),
        "cv2 findChessboardCornersSB": partial(
            _peer, method=partial(corner_sector.corners, accurate=False)
        ),
        "cv2 findChessboardCornersSB, ACCURACY": partial(_peer, method=corner_sector.corners),
    }
    methods = [Measured(name, PEER if "cv2" in name else OURS) for name in work]
    for find in work.values():
        find(views[0])  # warm up
    for number, view in enumerate(views):
        for method in rotated(methods, number):
            run(method, partial(_one, work[method.method], view, timings), len(QUANTITIES))
    return methods


def _peer(view: _View, method: Callable[..., FloatArray]) -> FloatArray:
    return method(view.frame.pixels, rows=BOARD.rows, columns=BOARD.columns)


def _one(find: Callable[[_View], FloatArray], view: _View, timings: int) -> tuple[float, ...]:
    tried = [timed(lambda: find(view)) for _ in range(timings)]
    found = in_order(tried[0][1], view.truth_px)
    missed = int(np.count_nonzero(~np.isfinite(found).all(axis=1)))
    if missed:
        raise LookupError(f"{missed} corners were not found")
    error = float(np.sqrt(np.mean(np.sum((found - view.truth_px) ** 2, axis=1))))
    return float(np.median([seconds for seconds, _ in tried])), error


def _draw(square_px: float, blur_px: float, rng: np.random.Generator) -> _View:
    """Draw a board in a random attitude in front of a camera whose world is the board."""
    camera = _camera(square_px, rng)
    grid = np.array([(c, r, 0) for r in range(BOARD.rows) for c in range(BOARD.columns)])
    middle = np.array([BOARD.columns - 1, BOARD.rows - 1, 0]) / 2
    truth = camera.project((grid - middle) * BOARD.square_mm)
    # board coordinates of the rays, by a plane's homography in undistorted px
    pose = camera.camera_from_world
    plane = np.column_stack([pose.rotation[:, :2], pose.translation_mm])
    from_ideal = np.linalg.inv(camera.matrix_px @ plane)
    y, x = np.mgrid[: SIZE_PX[1], : SIZE_PX[0]].astype(np.float64)
    ideal = camera.undistort(np.stack([x.ravel(), y.ravel()], axis=1))
    ideal = np.column_stack([ideal, np.ones(len(ideal))])
    places = ideal @ from_ideal.T
    places = (places[:, :2] / places[:, 2:] / BOARD.square_mm + middle[:2]).reshape(*y.shape, 2)
    by_y, by_x = np.gradient(places, axis=(0, 1))  # linear within a pixel: 1e-5 squares
    total = np.zeros(y.shape)
    steps = (np.arange(SUB) + 0.5) / SUB - 0.5
    for dy in steps:
        for dx in steps + dy / SUB:  # sheared, so that no two samples lie on one line
            total += _grey(places + dx * by_x + dy * by_y)
    image = cv2.GaussianBlur(total / SUB**2, (0, 0), blur_px) + rng.normal(0, NOISE, y.shape)
    return _View(Frame("a", np.clip(np.rint(image), 0, 255).astype(np.uint8)), truth)


def _grey(places: FloatArray) -> FloatArray:
    """Return the board's grey value; one light square's width of rim, grey beyond."""
    column, row = np.floor(places[..., 0]), np.floor(places[..., 1])
    on_board = (column >= -1) & (column < BOARD.columns) & (row >= -1) & (row < BOARD.rows)
    on_rim = (column >= -2) & (column <= BOARD.columns) & (row >= -2) & (row <= BOARD.rows)
    dark = on_board & ((column + row) % 2 == 0)
    return np.where(dark, DARK, np.where(on_rim, LIGHT, GROUND))


def _camera(square_px: float, rng: np.random.Generator) -> Camera:
    """Tilt by 10 to 35 degrees about a random axis, roll by up to 20, stay inside the image."""
    axis, tilt = rng.uniform(0, 2 * np.pi), np.radians(rng.uniform(10, 35))
    turn = rotation_from_vector(tilt * np.array([np.cos(axis), np.sin(axis), 0.0]))
    roll = rotation_from_vector([0.0, 0.0, np.radians(rng.uniform(-20, 20))])
    depth = FOCAL_PX * BOARD.square_mm / square_px
    shift = np.array([*rng.uniform(-10, 10, 2), depth])
    centre = (np.array(SIZE_PX) - 1) / 2 + (4.0, -3.0)
    matrix = np.array([[FOCAL_PX, 0, centre[0]], [0, FOCAL_PX, centre[1]], [0, 0, 1]])
    return Camera("a", SIZE_PX, matrix, RigidTransform(turn @ roll, shift), LENS)
