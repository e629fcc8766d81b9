"""Targets whose labels are in doubt: items 22 to 25 of the list of bad inputs."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from closerange.features.points_table import read_points
from closerange.flags import Flag


def board(rows, columns, square=40):
    """Draw a chessboard with the given numbers of inner corners, on white."""
    cells = np.indices((rows + 1, columns + 1)).sum(axis=0) % 2
    image = np.kron(np.where(cells, 220, 30), np.ones((square, square))).astype(np.uint8)
    image = cv2.copyMakeBorder(image, 60, 60, 60, 60, cv2.BORDER_CONSTANT, value=220)
    return cv2.GaussianBlur(image, None, 1.0)


@pytest.fixture
def board_target(tmp_path):
    def write(rows, columns):
        path = tmp_path / "board.toml"
        text = f'kind = "chessboard"\nrows = {rows}\ncolumns = {columns}\nsquare_mm = 10.0\n'
        path.write_text(text, encoding="utf-8")
        return path

    return write


@pytest.mark.parametrize(
    ("rows", "columns", "symmetric"), [(4, 6, True), (5, 7, True), (4, 7, False), (5, 6, False)]
)
def test_item_22_board_that_looks_alike_after_half_a_turn(
    detected, board_target, tmp_path, rows, columns, symmetric, save
):
    """Upright it is labelled, with a warning; calibration finds out single turned images."""
    target = board_target(rows, columns)
    image = save(tmp_path / "board.png", board(rows, columns))
    outcome, found = detected(image, target=target)
    assert outcome.code == 0
    assert len(found) == rows * columns
    assert ("warning: " in outcome.stderr) == symmetric
    assert ("looks the same after half a turn" in outcome.stderr) == symmetric


def test_item_22_symmetric_board_turned_by_a_quarter(
    refused, looking, board_target, tmp_path, save
):
    turned = np.ascontiguousarray(np.rot90(board(4, 6)))
    image = save(tmp_path / "turned.png", turned)
    refused(looking(image, target=board_target(4, 6)), 1, "turned.png", "odd and one even")


def test_item_22_unsymmetric_board_keeps_its_labels_upside_down(
    detected, board_target, tmp_path, save
):
    """The same corner keeps its name: r0c0 moves to the opposite corner of the image."""
    upright = board(4, 7)
    target = board_target(4, 7)
    _, before = detected(save(tmp_path / "up.png", upright), target=target)
    turned = np.ascontiguousarray(upright[::-1, ::-1])
    _, after = detected(save(tmp_path / "down.png", turned), target=target)
    last = np.array(upright.shape[::-1]) - 1
    np.testing.assert_allclose(after.xy, last - before.xy, atol=0.02)


def test_item_23_image_turned_by_a_quarter(detected, good, tmp_path, save):
    """Orientation "upright" holds within 45 degrees of roll: labels follow the image."""
    turned = np.ascontiguousarray(np.rot90(good))
    outcome, rows = detected(save(tmp_path / "turned.png", turned))
    assert outcome.code == 0
    centres = rows.xy.reshape(3, 3, 2)
    assert (np.diff(centres[:, :, 0], axis=1) > 0).all()
    assert (np.diff(centres[:, :, 1], axis=0) > 0).all()


def test_item_24_disc_cut_by_the_border_is_dropped_and_told(detected, good, truth, tmp_path, save):
    left = int(truth[:, 0].min())  # cut through the middle of the leftmost disc
    cropped = np.ascontiguousarray(good[:, left:])
    outcome, rows = detected(save(tmp_path / "cut.png", cropped))
    assert outcome.code == 0
    assert "cut by the image border" in outcome.stderr
    cut = [row for row in rows if "at_border" in row["flags"]]
    assert cut
    assert not any(row["x_px"] or row["y_px"] for row in cut)
    whole = np.array([row["flags"] == "" for row in rows])
    np.testing.assert_allclose(rows.xy[whole], truth[whole] - [left, 0], atol=0.01)


def with_disc(pixels, centre, radius=26):
    """Add one more white disc of the size of the plate's."""
    added = pixels.copy()
    shift, scale = 8, 256
    middle = tuple(round(scale * value) for value in centre)
    cv2.circle(added, middle, radius * scale, int(pixels.max()), -1, cv2.LINE_AA, shift)
    return cv2.GaussianBlur(added, None, 0.7)


def test_item_25_extra_disc_that_makes_the_labels_ambiguous(
    refused, looking, good, truth, tmp_path, save
):
    """A tenth disc continues a row: two grids of three columns fit."""
    grid = truth.reshape(3, 3, 2)
    column = 2 * grid[:, 2] - grid[:, 1]
    column[:, 0] = np.minimum(column[:, 0], good.shape[1] - 30)
    crowded = good
    for centre in column:
        crowded = with_disc(crowded, centre)
    refused(looking(save(tmp_path / "twelve.png", crowded)), 1, "twelve.png")


def test_item_25_speck_beside_the_plate_does_no_harm(detected, good, truth, tmp_path, save):
    speck = with_disc(good, (20, 20), radius=5)
    outcome, rows = detected(save(tmp_path / "speck.png", speck))
    assert outcome.code == 0
    np.testing.assert_allclose(rows.xy, truth, atol=0.05)


def test_item_25_disc_that_is_missing_is_not_invented(run, looking, good, truth, tmp_path, save):
    """A covered disc is NaN with a flag, or the whole image is refused; never a wrong label."""
    covered = good.copy()
    x, y = truth[4].round().astype(int)
    covered[y - 40 : y + 40, x - 40 : x + 40] = np.median(good)
    output = tmp_path / "points.csv"
    outcome = run(*looking(save(tmp_path / "covered.png", covered)), "-o", output)
    if outcome.code:
        assert "covered.png" in outcome.stderr
        assert not output.exists()
        return
    points = read_points(output)
    assert points.flags[4] & Flag.not_found
    others = [i for i in range(9) if i != 4]
    np.testing.assert_allclose(points.xy_px[others], truth[others], atol=0.01)
