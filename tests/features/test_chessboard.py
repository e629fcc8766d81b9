"""Chessboard and ChArUco corners: order, accuracy, honest covariance."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from closerange.errors import DetectionError
from closerange.features.chessboard import canonical_order, find_charuco, find_chessboard
from closerange.features.target import Charuco, Chessboard
from closerange.flags import Flag
from closerange.images.frame import Frame


def homography(rows, columns, square, roll_deg, rng, *, size=500, squeeze=0.8):
    """Map (column, row) of inner corners into the middle of an image, slightly in perspective."""
    a = np.radians(roll_deg)
    turn = np.array([[np.cos(a), -np.sin(a), 0], [np.sin(a), np.cos(a), 0], [0, 0, 1]])
    middle = np.array([[1, 0, -(columns - 1) / 2], [0, 1, -(rows - 1) / 2], [0, 0, 1]])
    tilt = np.array([[1, 0, 0], [0, 1, 0], [*rng.uniform(-0.01, 0.01, 2), 1]])
    shift = np.eye(3)
    shift[:2, 2] = size / 2 + rng.uniform(0, 1, 2)
    return shift @ turn @ np.diag([square, square * squeeze, 1.0]) @ tilt @ middle


def mapped(matrix, rows, columns):
    row, column = np.mgrid[:rows, :columns]
    x = np.stack([column.ravel(), row.ravel(), np.ones(rows * columns)], -1) @ matrix.T
    return x[:, :2] / x[:, 2:]


def board_image(rows, columns, matrix, rng, *, noise=3.0, blur=0.8, size=500, low=40, high=200):
    """Average a mathematical board over the pixels; the square up-left of (0, 0) is dark."""
    inverse = np.linalg.inv(matrix)
    sub = (np.arange(6) + 0.5) / 6 - 0.5
    y, x = np.mgrid[:size, :size].astype(np.float64)
    total = np.zeros((size, size))
    for dy, shift in zip(np.repeat(sub, 6), np.tile(sub, 6), strict=True):
        dx = shift + dy / 6  # sheared, so that no two samples lie on one line
        w = inverse[2, 0] * (x + dx) + inverse[2, 1] * (y + dy) + inverse[2, 2]
        u = (inverse[0, 0] * (x + dx) + inverse[0, 1] * (y + dy) + inverse[0, 2]) / w
        v = (inverse[1, 0] * (x + dx) + inverse[1, 1] * (y + dy) + inverse[1, 2]) / w
        on_board = (u > -1) & (u < columns) & (v > -1) & (v < rows)
        dark = (np.floor(u) + np.floor(v)) % 2 == 0
        total += np.where(on_board & dark, low, high)
    image = cv2.GaussianBlur(total / 36, (0, 0), blur) + rng.normal(0, noise, (size, size))
    return np.clip(np.rint(image), 0, 255).astype(np.uint8)


@pytest.mark.parametrize(
    ("square", "noise", "blur", "roll"),
    [(36, 3.0, 0.8, 20), (18, 2.0, 0.8, 110), (30, 8.0, 1.2, 245)],
)
def test_labels_and_covariances_hold_at_any_roll(square, noise, blur, roll):
    board = Chessboard(6, 9, 25.0)
    chi2, errors = [], []
    for seed in range(2):
        rng = np.random.default_rng(seed)
        matrix = homography(6, 9, square, roll, rng)
        frame = Frame("a", board_image(6, 9, matrix, rng, noise=noise, blur=blur))
        corners = find_chessboard(frame, board)
        error = corners.xy_px - mapped(matrix, 6, 9)
        assert np.abs(error).max() < 0.15  # a wrong label would be off by a square
        assert not corners.flags.any()
        assert np.abs(np.median(corners.blur_px) - np.hypot(blur, 12**-0.5)) < 0.1
        chi2 += np.einsum("ni,nij,nj->n", error, np.linalg.inv(corners.cov_px2), error).tolist()
        errors.append(error)
    # 108 corners: the mean of chi2 with 2 degrees of freedom is 2 +- 0.19
    assert 1 / 1.5**2 < np.mean(chi2) / 2 < 1.5**2, (np.mean(chi2) / 2, np.std(errors))


def turned_back(xy, turn, size):
    """Carry points of an image turned by np.rot90 back into the image."""
    width, height = size
    x, y = xy.T
    return np.stack(
        {1: (width - 1 - y, x), 2: (width - 1 - x, height - 1 - y), 3: (y, height - 1 - x)}[turn],
        -1,
    )


def test_the_real_board_is_found_in_all_26_images(shared):
    board = Chessboard(6, 9, 25.0)
    row, column = np.mgrid[:6, :9]
    places = np.stack([column.ravel(), row.ravel()], -1).astype(np.float64)
    for path in sorted((shared / "data" / "opencv-stereo-chessboard").glob("*.jpg")):
        image = cv2.imread(str(path), cv2.IMREAD_GRAYSCALE)
        xy = find_chessboard(Frame("a", image), board).xy_px
        matrix, _ = cv2.findHomography(places, xy)
        assert np.linalg.det(matrix[:2, :2]) > 0
        fitted = cv2.perspectiveTransform(places[:, None], matrix).reshape(-1, 2)
        # barrel distortion only: a wrong label would be off by a square
        square = np.linalg.norm(np.diff(xy.reshape(6, 9, 2), axis=1), axis=2).min()
        assert np.linalg.norm(fitted - xy, axis=1).max() < 0.4 * square, path.name
        # dark at the upper left, and so at the lower left: light in the two others
        step = xy.reshape(6, 9, 2)
        inner = (step[0, 0] + step[1, 1]) / 2
        beside = (step[0, 1] + step[1, 2]) / 2
        assert image[*np.rint(inner[::-1]).astype(int)] < image[*np.rint(beside[::-1]).astype(int)]


def test_both_finders_and_all_turns_give_the_same_rows(shared):
    board = Chessboard(6, 9, 25.0)
    for name in ("left01", "right04"):
        path = shared / "data" / "opencv-stereo-chessboard" / f"{name}.jpg"
        image = cv2.imread(str(path), cv2.IMREAD_GRAYSCALE)
        xy = find_chessboard(Frame("a", image), board).xy_px
        ok, rough = cv2.findChessboardCorners(image, (9, 6))
        assert ok
        ok, other = cv2.findChessboardCornersSB(image, (9, 6), flags=cv2.CALIB_CB_NORMALIZE_IMAGE)
        assert ok
        for found in (rough, other):
            order = canonical_order(found.reshape(6, 9, 2).astype(float), image, board)
            assert np.abs(order.reshape(-1, 2) - xy).max() < 3.0  # squares are 30 px
        for turn in (1, 2, 3):
            frame = Frame("a", np.ascontiguousarray(np.rot90(image, turn)))
            again = turned_back(find_chessboard(frame, board).xy_px, turn, image.shape[::-1])
            assert np.abs(again - xy).max() < 0.02, (name, turn)


@pytest.mark.parametrize(("rows", "columns"), [(5, 7), (6, 6)])
def test_a_symmetric_board_must_be_upright(rows, columns):
    board = Chessboard(rows, columns, 25.0)
    for roll in (0, 44):
        rng = np.random.default_rng(3)
        matrix = homography(rows, columns, 36, roll, rng, squeeze=1.0)
        frame = Frame("a", board_image(rows, columns, matrix, rng))
        error = find_chessboard(frame, board).xy_px - mapped(matrix, rows, columns)
        assert np.abs(error).max() < 0.1
    matrix = homography(rows, columns, 36, 45, rng, squeeze=1.0)
    with pytest.raises(DetectionError, match=r"same after a turn.*rolled by 4[45].[0-9] degrees"):
        find_chessboard(Frame("a", board_image(rows, columns, matrix, rng)), board)


def test_sixteen_bits_give_the_same_corners():
    rng = np.random.default_rng(0)
    matrix = homography(6, 9, 36, 10, rng)
    image = board_image(6, 9, matrix, rng)
    eight = find_chessboard(Frame("a", image), Chessboard(6, 9, 25.0))
    sixteen = find_chessboard(Frame("a", image.astype(np.uint16) * 16), Chessboard(6, 9, 25.0))
    assert np.abs(eight.xy_px - sixteen.xy_px).max() < 1e-3
    assert np.allclose(eight.cov_px2, sixteen.cov_px2, rtol=0.05, atol=1e-6)


def test_saturation_and_blur_are_flagged():
    rng = np.random.default_rng(0)
    matrix = homography(6, 9, 30, 10, rng)
    bright = board_image(6, 9, matrix, rng, high=300)
    flags = find_chessboard(Frame("a", bright), Chessboard(6, 9, 25.0)).flags
    assert (flags & Flag.saturated).all()
    matrix = homography(6, 9, 30, 10, rng)
    soft = board_image(6, 9, matrix, rng, blur=5.3, noise=1.0)  # 0.22 of the 24 px between lines
    corners = find_chessboard(Frame("a", soft), Chessboard(6, 9, 25.0))
    assert (corners.flags & Flag.blurred).mean() > 0.9
    assert np.abs(corners.xy_px - mapped(matrix, 6, 9)).max() < 0.15


@pytest.mark.parametrize("part", [(3, 3), (4, 7)])
def test_a_part_of_a_larger_board_is_refused(part, shared):
    path = shared / "data" / "opencv-stereo-chessboard" / "left01.jpg"
    rng = np.random.default_rng(0)
    drawn = board_image(6, 9, homography(6, 9, 30, 10, rng), rng)
    # left01 also shows a screen with a small board, of which 3 x 3 corners may be read
    real = cv2.imread(str(path), cv2.IMREAD_GRAYSCALE)
    for image in (drawn, real) if part != (3, 3) else (drawn,):
        with pytest.raises(DetectionError, match=r"goes on beyond|no chessboard"):
            find_chessboard(Frame("a", image), Chessboard(*part, 25.0))


def test_no_board_is_refused_by_size():
    frame = Frame("a", np.full((200, 200), 90, np.uint8), source="grey.png")
    with pytest.raises(DetectionError, match=r"6 x 9 inner corners found in grey\.png") as caught:
        find_chessboard(frame, Chessboard(6, 9, 25.0))
    assert "inner corners, not squares" in caught.value.remedy


CHARUCO = Charuco(5, 7, 40.0, 28.0, "DICT_4X4_50")


def charuco_image(matrix, rng, *, size=600, noise=3.0):
    """Warp OpenCV's own drawing of the board, four times finer than the pixels."""
    dictionary = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_4X4_50)
    layout = cv2.aruco.CharucoBoard((7, 5), 40.0, 28.0, dictionary)
    drawing = layout.generateImage((7 * 120, 5 * 120), marginSize=0)
    framed = cv2.copyMakeBorder(drawing, 60, 60, 60, 60, cv2.BORDER_CONSTANT, value=255)
    # corner (0, 0) lies between pixels 179 and 180 of the framed drawing
    place = np.array([[1 / 120, 0, -179.5 / 120], [0, 1 / 120, -179.5 / 120], [0, 0, 1]])
    finer = np.array([[4, 0, 1.5], [0, 4, 1.5], [0, 0, 1.0]])
    warped = cv2.warpPerspective(
        framed.astype(np.float32), finer @ matrix @ place, (4 * size, 4 * size),
        flags=cv2.INTER_LINEAR, borderValue=255.0,
    )  # fmt: skip
    image = cv2.GaussianBlur(
        cv2.resize(warped, (size, size), interpolation=cv2.INTER_AREA), (0, 0), 0.7
    )
    return np.clip(np.rint(40 + 0.63 * image + rng.normal(0, noise, image.shape)), 0, 255).astype(
        np.uint8
    )


@pytest.mark.parametrize("roll", [4, 97, 184, 290])
def test_charuco_corners_at_any_roll(roll):
    rng = np.random.default_rng(roll)
    matrix = homography(4, 6, 60, roll, rng, size=600)
    corners = find_charuco(Frame("a", charuco_image(matrix, rng)), CHARUCO)
    error = corners.xy_px - mapped(matrix, 4, 6)
    assert np.isfinite(error).all()
    assert np.abs(error).max() < 0.15
    chi2 = np.einsum("ni,nij,nj->n", error, np.linalg.inv(corners.cov_px2), error)
    assert 1 / 1.5**2 < chi2.mean() / 2 < 1.5**2, chi2.mean() / 2


def test_hidden_charuco_corners_are_not_found_and_a_mirror_is_refused():
    rng = np.random.default_rng(1)
    matrix = homography(4, 6, 60, 10, rng, size=600)
    image = charuco_image(matrix, rng)
    truth = mapped(matrix, 4, 6)
    with pytest.raises(DetectionError, match="of 24 corners"):
        find_charuco(Frame("a", np.ascontiguousarray(image[:, ::-1])), CHARUCO)
    x, y = truth.reshape(4, 6, 2)[0, 0].astype(int)
    image[: y + 40, : x + 40] = 128
    corners = find_charuco(Frame("a", image), CHARUCO)
    hidden = np.isnan(corners.xy_px).any(axis=1)
    assert hidden[0]
    assert hidden.sum() < 12
    assert (corners.flags[hidden] == Flag.not_found).all()
    assert np.abs(corners.xy_px - truth)[~hidden].max() < 0.2
