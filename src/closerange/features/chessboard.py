"""Chessboard and ChArUco corners: found by OpenCV, measured by a fitted corner model.

OpenCV only says roughly where the corners are; its two chessboard finders even begin at
different ends of the board. Order, position and covariance are decided here, so they are the
same whichever finder succeeded.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from closerange.errors import DetectionError
from closerange.features.corner_fit import CornerFits, fit_corners
from closerange.features.grid_orientation import ROLL_LIMIT_RAD
from closerange.features.pattern import Charuco, Chessboard
from closerange.features.plane_map import mapped, plane_homography, plane_roll
from closerange.flags import Flag
from closerange.geometry.arrays import FloatArray, IntArray
from closerange.images.frame import Frame

FREE_SHARE = 0.7
"""Radius of a corner's window over its distance from the next line of the board: edge blur of
the neighbouring squares stays outside."""

MARKER_SHARE = 0.8
"""The same for ChArUco, over the white rim between a square and its marker."""

MIN_RADIUS_PX = 3.0
"""Smallest window: 29 pixels for nine unknowns."""

MAX_RADIUS_PX = 12.0
"""Largest window: beyond it the edges of a wide-angle image bend by hundredths of a pixel."""

MAX_BLUR_SHARE = 0.2
"""Largest edge blur (sigma) over the distance to the next line: the two edges of a square,
each some four sigma wide, all but touch."""

CONTINUES_SHARE = 0.75
"""Share of a corner's contrast that a place outside has if the board goes on there: all of it;
half where the board ends on an even ground."""

SATURATED_SHARE = 0.01


@dataclass(frozen=True, slots=True, eq=False)
class Corners:
    """Corners of a board in the target's order; N points.

    Attributes
    ----------
    xy_px : ndarray, shape (N, 2)
        Position, px; NaN where a corner is not found.
    cov_px2 : ndarray, shape (N, 2, 2)
        Covariance, px^2.
    flags : ndarray of int, shape (N,)
        `Flag` bits.
    blur_px : ndarray, shape (N,)
        Edge blur (sigma), px.
    """

    xy_px: FloatArray
    cov_px2: FloatArray
    flags: IntArray
    blur_px: FloatArray


def find_chessboard(frame: Frame, board: Chessboard) -> Corners:
    """Find and measure the inner corners of a chessboard.

    Parameters
    ----------
    frame : Frame
        The image.
    board : Chessboard
        The target.

    Returns
    -------
    Corners
        All corners in row-major order, r0c0 first.

    Raises
    ------
    DetectionError
        If the whole board is not in the image, or its orientation cannot be decided.

    Notes
    -----
    Where rows + columns is odd, r0c0 is the corner beside which, on the upper left, lies a
    dark square: this decides at any roll. Every other board looks the same after a half turn
    (or, if square, a quarter turn), so it must be upright within 40 degrees of roll; beyond
    that nothing is returned rather than labels that may be turned.
    """
    image = _eight_bit(frame)
    found = _finder(image, board)
    if found is None:
        raise DetectionError(
            f"no chessboard of {board.rows} x {board.columns} inner corners found in "
            f"{frame.source or 'the image'}",
            remedy="bring the whole board into view, sharp and evenly lit; rows and columns "
            "count inner corners, not squares",
        )
    xy = canonical_order(found.reshape(board.rows, board.columns, 2), image, board)
    _refuse_larger_board(xy, image, board)
    places = _places(board.rows, board.columns)
    return _measured(frame, xy.reshape(-1, 2), places, FREE_SHARE)


def find_charuco(frame: Frame, board: Charuco) -> Corners:
    """Find and measure the corners of a ChArUco board.

    Parameters
    ----------
    frame : Frame
        The image.
    board : Charuco
        The target.

    Returns
    -------
    Corners
        All corners in row-major order; those not seen are NaN with flag not_found.

    Raises
    ------
    DetectionError
        If fewer than four corners, or only corners on one line, are found.
    """
    rows, columns = board.rows - 1, board.columns - 1
    dictionary = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, board.dictionary))
    layout = cv2.aruco.CharucoBoard(
        (board.columns, board.rows), board.square_mm, board.marker_mm, dictionary
    )
    found, ids, _, marker_ids = cv2.aruco.CharucoDetector(layout).detectBoard(_eight_bit(frame))
    xy = np.full((rows * columns, 2), np.nan)
    if ids is not None:
        xy[np.asarray(ids).reshape(-1)] = np.asarray(found, np.float64).reshape(-1, 2)
    seen = int(np.isfinite(xy).all(axis=1).sum())
    places = _places(rows, columns)
    known = np.isfinite(xy).all(axis=1)
    if seen < 4 or plane_homography(places[known], xy[known]) is None:
        markers = 0 if marker_ids is None else len(marker_ids)
        raise DetectionError(
            f"{seen} of {len(xy)} corners and {markers} of {board.rows * board.columns // 2} "
            f"markers of the ChArUco board found in {frame.source or 'the image'}; the limit is "
            "4 corners not on one line",
            remedy="check rows and columns (squares), dictionary and the board's layout; bring "
            "it into view, sharp, evenly lit and not mirrored",
        )
    share = MARKER_SHARE * (1 - board.marker_mm / board.square_mm) / 2
    return _measured(frame, xy, places, min(share, FREE_SHARE))


def canonical_order(xy: FloatArray, image: NDArray[Any], board: Chessboard) -> FloatArray:
    """Turn a board's corners so that r0c0 comes first, whatever the finder's order.

    Parameters
    ----------
    xy : ndarray, shape (rows, columns, 2)
        Corners, px, neighbours beside each other; any end first, mirrored or not.
    image : ndarray, shape (H, W)
        Grey values.
    board : Chessboard
        The target.

    Returns
    -------
    ndarray, shape (rows, columns, 2)
        The same corners.

    Raises
    ------
    DetectionError
        If the board looks the same after a turn and its roll is not clearly below 45 degrees.
    """
    across, down = xy[:, -1] - xy[:, 0], xy[-1] - xy[0]
    a, b = across.mean(axis=0), down.mean(axis=0)
    if a[0] * b[1] - a[1] * b[0] < 0:
        xy = xy[:, ::-1]
    if not board.half_turn_symmetric:
        return xy if _first_is_dark(xy, image) else xy[::-1, ::-1]
    turns = range(4) if board.rows == board.columns else (0, 2)
    turned = [np.rot90(xy, turn) for turn in turns]
    rolls = [plane_roll(_places(*c.shape[:2]), c.reshape(-1, 2)) for c in turned]
    best = int(np.argmin([abs(roll) for roll, _ in rolls]))
    roll, margin = rolls[best]
    if abs(roll) + margin > ROLL_LIMIT_RAD:
        raise DetectionError(
            f"the board of {board.rows} x {board.columns} inner corners looks the same after a "
            f"turn, and it is rolled by {np.degrees(abs(roll)):.1f} degrees; the limit "
            f"is {np.degrees(ROLL_LIMIT_RAD - margin):.1f}",
            remedy="hold it upright (exchange rows and columns if it is), or use a board with "
            "one odd and one even number of inner corners",
        )
    return turned[best]


def _finder(image: NDArray[Any], board: Chessboard) -> FloatArray | None:
    """Try OpenCV's finders, the more accurate and quicker one first."""
    size = (board.columns, board.rows)
    normal = cv2.CALIB_CB_NORMALIZE_IMAGE
    for flags in (normal, normal | cv2.CALIB_CB_EXHAUSTIVE):
        ok, corners = cv2.findChessboardCornersSB(image, size, flags=flags)
        if ok:
            return np.asarray(corners, np.float64).reshape(-1, 2)
        if flags == normal:
            ok, corners = cv2.findChessboardCorners(
                image, size, flags=normal | cv2.CALIB_CB_ADAPTIVE_THRESH
            )
            if ok:
                return np.asarray(corners, np.float64).reshape(-1, 2)
    return None


def _eight_bit(frame: Frame) -> NDArray[Any]:
    """Stretch 16-bit pixels to 8 bits: the finders take nothing else."""
    if frame.pixels.dtype == np.uint8:
        return frame.pixels
    low, high = np.percentile(frame.pixels, [0.1, 99.9])
    scaled = (frame.pixels - low) * (255 / max(high - low, 1.0))
    stretched: NDArray[Any] = np.clip(scaled, 0, 255).astype(np.uint8)
    return stretched


def _places(rows: int, columns: int) -> FloatArray:
    row, column = np.mgrid[:rows, :columns]
    return np.column_stack([column.ravel(), row.ravel()]).astype(np.float64)


def _first_is_dark(xy: FloatArray, image: NDArray[Any]) -> bool:
    """Say whether the squares of the first square's colour are the darker ones.

    The square on the upper left of r0c0 touches the first inner square at a corner, so both
    have one colour; of the outer squares half may be cut off.
    """
    middles = (xy[:-1, :-1] + xy[1:, :-1] + xy[:-1, 1:] + xy[1:, 1:]) / 4
    x = np.clip(np.rint(middles[..., 0]).astype(int), 0, image.shape[1] - 1)
    y = np.clip(np.rint(middles[..., 1]).astype(int), 0, image.shape[0] - 1)
    grey = image[y, x].astype(np.float64)
    row, column = np.mgrid[: grey.shape[0], : grey.shape[1]]
    even = (row + column) % 2 == 0
    return bool(grey[even].mean() < grey[~even].mean())


def _refuse_larger_board(xy: FloatArray, image: NDArray[Any], board: Chessboard) -> None:
    """Refuse if the pattern goes on: the classic finder also takes a part of a larger board."""
    middle = _saddle(xy[1:-1, 1:-1], xy[1:-1, 2:], xy[2:, 1:-1], image)
    contrast = float(np.median(np.abs(middle)))
    for side in range(4):
        # the first row of the turned grid is one of the four sides
        turned = np.rot90(xy, side)
        outside = 2 * turned[0] - turned[1]
        along = np.roll(turned[0], -1, axis=0)
        across = 2 * outside - turned[0]
        saddle = _saddle(
            outside[:-1], outside[:-1] + along[:-1] - turned[0, :-1], across[:-1], image
        )
        # where the board ends, one half is even: half of the saddle
        if np.median(np.abs(saddle)) > CONTINUES_SHARE * contrast:
            raise DetectionError(
                f"the chessboard goes on beyond {board.rows} x {board.columns} inner corners",
                remedy="count the inner corners of the whole board and correct rows and columns",
            )


def _saddle(
    corner: FloatArray, along: FloatArray, across: FloatArray, image: NDArray[Any]
) -> FloatArray:
    """Return half the grey difference between the two diagonals of squares at corners."""
    u, v = (along - corner) / 4, (across - corner) / 4
    height, width = image.shape
    total: FloatArray = np.zeros(corner.shape[:-1])
    for sign, offset in ((1, u + v), (1, -u - v), (-1, u - v), (-1, v - u)):
        place = np.rint(corner + offset).astype(np.int64)
        x, y = place[..., 0], place[..., 1]
        seen = (x >= 0) & (x < width) & (y >= 0) & (y < height)
        grey = image[np.clip(y, 0, height - 1), np.clip(x, 0, width - 1)].astype(np.float64)
        total += np.where(seen, sign * grey, np.nan) / 4
    return np.nan_to_num(total)  # outside of the image nothing goes on


def _measured(frame: Frame, xy: FloatArray, places: FloatArray, share: float) -> Corners:
    """Fit every corner that was found; keep OpenCV's position where the fit fails."""
    known = np.asarray(np.isfinite(xy).all(axis=1))
    steps, spacing = _steps(xy, places, known)
    radius = np.clip(share * spacing, MIN_RADIUS_PX, MAX_RADIUS_PX)
    fits = fit_corners(frame.pixels, xy[known], steps[known], radius[known])
    # again with windows around the corners found, so that the start leaves no trace
    start = np.where(fits.good[:, None], fits.xy_px, xy[known])
    fits = fit_corners(frame.pixels, start, steps[known], radius[known])
    cov = np.full((len(xy), 2, 2), np.nan)
    blur = np.full(len(xy), np.nan)
    result = xy.copy()
    flags = np.where(known, 0, int(Flag.not_found))
    result[known] = np.where(fits.good[:, None], fits.xy_px, start)
    cov[known], blur[known] = fits.cov_px2, fits.blur_px
    flags[known] |= _fit_flags(fits, spacing[known])
    return Corners(result, cov, flags, blur)


def _fit_flags(fits: CornerFits, spacing: FloatArray) -> IntArray:
    flags = np.where(fits.good, 0, int(Flag.poor_fit))
    with np.errstate(invalid="ignore"):
        flags |= np.where(fits.blur_px > MAX_BLUR_SHARE * spacing, int(Flag.blurred), 0)
        flags |= np.where(fits.saturated > SATURATED_SHARE, int(Flag.saturated), 0)
        flags |= np.where(fits.contrast < 5 * fits.noise, int(Flag.low_contrast), 0)
    flags |= np.where(fits.cut, int(Flag.at_border), 0)
    return flags.astype(np.int64)


def _steps(
    xy: FloatArray, places: FloatArray, known: NDArray[np.bool_]
) -> tuple[FloatArray, FloatArray]:
    """Return steps to the next column and row, and the distance to the nearest other line."""
    steps = np.full((len(xy), 2, 2), np.nan)
    whole = plane_homography(places[known], xy[known])
    for point in np.flatnonzero(known):
        near = known & (np.abs(places - places[point]).max(axis=1) <= 2)
        local = plane_homography(places[near], xy[near]) if near.sum() >= 6 else None
        local = whole if local is None else local
        if local is not None:
            steps[point] = mapped(local, places[point])[1]
    area = np.abs(steps[:, 0, 0] * steps[:, 1, 1] - steps[:, 0, 1] * steps[:, 1, 0])
    return steps, area / np.linalg.norm(steps, axis=2).max(axis=1)
