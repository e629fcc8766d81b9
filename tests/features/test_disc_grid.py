"""Labelling of disc grids: hundreds of random views, no wrong label, reasoned refusals."""

from __future__ import annotations

from collections import Counter

import numpy as np
import pytest

from closerange.errors import DetectionError
from closerange.features.disc_grid import label_discs
from closerange.features.target import DiscGrid, Target

MARKED = DiscGrid(9, 12, (10, 10), 5.8, mark_discs=((6, 3, 8.0), (6, 8, 8.0), (2, 3, 8.0)))
ONE_MARK = DiscGrid(7, 7, (10, 14), 5, mark_discs=((1, 1, 7.0),))
SMALL_MARKS = DiscGrid(6, 6, (20, 20), 10, mark_discs=((0, 0, 7.0), (0, 5, 7.0), (5, 0, 7.0)))
PLAIN = DiscGrid(3, 3, (45, 45), 16)
OBLONG = DiscGrid(5, 4, (20, 30), 8)
FOUR = DiscGrid(2, 2, (45, 45), 16)
LINE = DiscGrid(1, 5, (20, 20), 8)
COLUMN = DiscGrid(4, 1, (20, 25), 8)

SIZE = np.array([1280.0, 1024.0])


def ellipse_of(outline):
    """Centre and ellipse through points on its outline (exact conic fit)."""
    middle = outline.mean(axis=0)
    scale = np.abs(outline - middle).max()
    x, y = ((outline - middle) / scale).T
    p = np.linalg.lstsq(np.stack([x * x, x * y, y * y, x, y], -1), np.ones(len(x)), rcond=None)[0]
    form = np.array([[p[0], p[1] / 2], [p[1] / 2, p[2]]])
    centre = -np.linalg.solve(2 * form, p[3:])
    values, vectors = np.linalg.eigh(form / (1 + centre @ form @ centre))
    a, b = scale / np.sqrt(values)
    return [*(middle + scale * centre), a, b, np.arctan2(vectors[1, 0], vectors[0, 0])]


def projected(grid, rng, *, tilt=60.0, roll=180.0, k1=0.0, mirror=False):
    """Ellipses (N, 5) of a grid in a random view that holds all of it."""
    target = Target.of(grid)
    turn = np.linspace(0, 2 * np.pi, 16, endpoint=False)
    circle = np.stack([np.cos(turn), np.sin(turn), 0 * turn], -1)
    extent = np.linalg.norm(np.ptp(target.xyz_mm, axis=0)) + 2 * target.diameters_mm.max()
    for _ in range(500):
        a, b, c = rng.uniform(0, 2 * np.pi), np.radians(rng.uniform(0, tilt)), np.radians(roll)
        rotation = about_z(rng.uniform(-c, c)) @ about_z(a) @ about_x(b) @ about_z(-a)
        rotation = rotation @ np.diag([-1.0 if mirror else 1.0, -1.0, -1.0])
        focal = rng.uniform(0.8, 2.0) * SIZE[0]
        distance = extent * focal / (rng.uniform(0.6, 1.0) * SIZE[1])

        def image(xyz, rotation=rotation, focal=focal, distance=distance):
            camera = xyz @ rotation.T + np.array([0, 0, distance])
            q = camera[:, :2] / camera[:, 2:]
            return focal * q * (1 + k1 * (q**2).sum(1, keepdims=True)) + SIZE / 2

        discs = zip(target.xyz_mm, target.diameters_mm, strict=True)
        found = np.array([ellipse_of(image(x + circle * d / 2)) for x, d in discs])
        reach = found[:, 2:4].max(axis=1, keepdims=True)
        xy = found[:, :2]
        if (xy > reach).all() and (xy + reach < SIZE).all() and found[:, 2:4].min() > 2:
            return found
    raise AssertionError("no view found")


def about_z(angle):
    c, s = np.cos(angle), np.sin(angle)
    return np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]])


def about_x(angle):
    c, s = np.cos(angle), np.sin(angle)
    return np.array([[1, 0, 0], [0, c, -s], [0, s, c]])


def candidates(discs, rng, *, clutter=0, missing=0):
    """Disturb, leave out, add, shuffle; return xy, ellipse and the true row of each disc."""
    count = len(discs)
    discs = discs.copy()
    discs[:, :2] += rng.normal(0, 0.1, (count, 2))
    discs[:, 2:4] *= 1 + rng.normal(0, 0.03, (count, 2))
    seen = np.sort(rng.permutation(count)[missing:])
    size = discs[:, 2].mean() * np.exp(rng.normal(0, 0.4, clutter))
    other = np.column_stack(
        [rng.uniform(0, 1, (clutter, 2)) * SIZE, size, size * rng.uniform(0.5, 1, clutter),
         rng.uniform(0, np.pi, clutter)]
    )  # fmt: skip
    gap = np.linalg.norm(other[:, None, :2] - discs[None, :, :2], axis=2)
    other = other[(gap > size[:, None] + discs[None, :, 2]).all(axis=1)]
    both = np.vstack([discs[seen], other])
    both[both[:, 2] < both[:, 3]] = both[both[:, 2] < both[:, 3]][:, [0, 1, 3, 2, 4]] + [
        0, 0, 0, 0, np.pi / 2,
    ]  # fmt: skip
    order = rng.permutation(len(both))
    truth = np.full(count, -1)
    truth[seen] = np.argsort(order)[: len(seen)]
    return both[order, :2], both[order, 2:], truth


def trials(grid, count, *, clutter=0, missing=0, **view):
    """Label many random views and count outcomes."""
    outcome = Counter()
    for seed in range(count):
        rng = np.random.default_rng(seed)
        xy, ellipse, truth = candidates(
            projected(grid, rng, **view), rng, clutter=clutter, missing=missing
        )
        try:
            index = label_discs(xy, ellipse, grid)
        except DetectionError as error:
            complete = error.message.startswith(f"{len(xy)} disc candidates") and error.remedy
            outcome["refused" if complete else "refused without saying why"] += 1
            continue
        wrong = (index >= 0) & (index != truth)
        outcome["wrong" if wrong.any() else "right" if (index == truth).all() else "fewer"] += 1
    return outcome


@pytest.mark.parametrize(
    ("grid", "count", "view", "least_right"),
    [
        (MARKED, 4, {}, 4),
        (MARKED, 4, {"k1": -0.25}, 4),
        (ONE_MARK, 8, {}, 8),
        (SMALL_MARKS, 8, {}, 8),
        (PLAIN, 40, {"roll": 44.0}, 39),
        (PLAIN, 40, {"roll": 44.0, "k1": -0.28}, 39),
        (OBLONG, 12, {"roll": 44.0}, 12),
        (FOUR, 30, {"roll": 44.0}, 28),
        (LINE, 30, {"roll": 55.0}, 28),
        (COLUMN, 30, {"roll": 55.0}, 28),
    ],
)
def test_clean_views_are_labelled(grid, count, view, least_right):
    outcome = trials(grid, count, **view)
    assert outcome["wrong"] == outcome["refused without saying why"] == 0, outcome
    assert outcome["right"] >= least_right, outcome


@pytest.mark.parametrize(
    ("grid", "count", "least_right", "disturbance"),
    [
        (MARKED, 4, 3, {"clutter": 40, "missing": 3}),
        (ONE_MARK, 8, 6, {"clutter": 15, "missing": 2}),
        (PLAIN, 40, 36, {"clutter": 15, "roll": 44.0}),
        (PLAIN, 40, 36, {"missing": 1, "roll": 44.0}),
        (PLAIN, 40, 34, {"clutter": 10, "missing": 1, "roll": 38.0}),
        (OBLONG, 12, 10, {"clutter": 20, "missing": 1, "roll": 38.0}),
        (FOUR, 40, 28, {"clutter": 6, "roll": 38.0}),
        (LINE, 40, 32, {"clutter": 6, "roll": 55.0}),
    ],
)
def test_clutter_and_missing_discs_never_give_a_wrong_label(grid, count, least_right, disturbance):
    outcome = trials(grid, count, **disturbance)
    assert outcome["wrong"] == outcome["refused without saying why"] == 0, outcome
    assert outcome["right"] + outcome["fewer"] >= least_right, outcome


def flat(grid, roll_deg=0.0, scale=4.0):
    """Face-on view of a grid, turned clockwise in the image by an angle."""
    target = Target.of(grid)
    c, s = np.cos(np.radians(roll_deg)), np.sin(np.radians(roll_deg))
    xy = (target.xyz_mm[:, :2] * [1, -1]) @ np.array([[c, s], [-s, c]]) * scale + [640, 512]
    radius = target.diameters_mm / 2 * scale
    return xy, np.column_stack([radius, radius, np.zeros(len(xy))])


@pytest.mark.parametrize("roll", [0, 44.5, -44.5])
@pytest.mark.parametrize("grid", [PLAIN, OBLONG, FOUR])
def test_upright_holds_up_to_forty_five_degrees(grid, roll):
    xy, ellipse = flat(grid, roll)
    assert label_discs(xy, ellipse, grid).tolist() == list(range(len(xy)))


@pytest.mark.parametrize("roll", [45, 44.95, -45, 135, 225])
@pytest.mark.parametrize("grid", [PLAIN, OBLONG, FOUR])
def test_near_the_limit_of_roll_it_refuses(grid, roll):
    xy, ellipse = flat(grid, roll)
    with pytest.raises(DetectionError, match=r"rolled by|rows x"):
        label_discs(xy, ellipse, grid)


@pytest.mark.parametrize("scale", [0.4, 4.0])
def test_the_limit_of_roll_leaves_what_the_centres_leave_open(scale):
    """A plate of 36 px knows its roll ten times less well than one of 360 px."""
    uncertain = np.degrees(3 * 0.5 / (scale * 45 * np.sqrt(12)))  # 9 centres of 0.5 px each
    assert label_discs(*flat(PLAIN, 44.9 - uncertain, scale), PLAIN).tolist() == list(range(9))
    turned = np.rot90(np.arange(9).reshape(3, 3), -1).ravel()  # upright is now another edge
    index = label_discs(*flat(PLAIN, 45.1 + uncertain, scale), PLAIN)
    assert index.tolist() == turned.tolist()
    with pytest.raises(DetectionError, match=r"read up to 4[0-4]"):
        label_discs(*flat(PLAIN, 45.1 - uncertain, scale), PLAIN)


@pytest.mark.parametrize("roll", [70, 90, 110, -90])
def test_an_oblong_grid_on_its_side_is_refused_with_a_hint(roll):
    square_pitch = DiscGrid(5, 4, (20, 20), 8)
    with pytest.raises(DetectionError, match="4 rows x 5 columns") as caught:
        label_discs(*flat(square_pitch, roll), square_pitch)
    assert "exchange rows and columns" in caught.value.remedy
    with pytest.raises(DetectionError, match="rolled by"):
        label_discs(*flat(OBLONG, roll), OBLONG)


@pytest.mark.parametrize("roll", range(0, 360, 15))
def test_marks_hold_at_any_roll(roll):
    xy, ellipse = flat(ONE_MARK, roll)
    assert label_discs(xy, ellipse, ONE_MARK).tolist() == list(range(49))


def test_a_mirrored_target_is_refused():
    rng = np.random.default_rng(5)
    xy, ellipse, _ = candidates(projected(MARKED, rng, mirror=True), rng)
    with pytest.raises(DetectionError, match="mirrored"):
        label_discs(xy, ellipse, MARKED)


def test_hidden_or_wrong_marks_are_refused():
    xy, ellipse = flat(ONE_MARK)
    rest = np.arange(49) != 8  # the only mark is hidden
    with pytest.raises(DetectionError, match="do not decide"):
        label_discs(xy[rest], ellipse[rest], ONE_MARK)
    other = DiscGrid(7, 7, (10, 14), 5, mark_discs=((2, 3, 7.0),))
    with pytest.raises(DetectionError, match=r"contradict|mirrored"):
        label_discs(xy, ellipse, other)
    upright = DiscGrid(7, 7, (10, 14), 5, orientation="upright", mark_discs=((1, 1, 7.0),))
    assert label_discs(xy, ellipse, upright).tolist() == list(range(49))
    with pytest.raises(DetectionError, match="contradict"):
        label_discs(xy[::-1] * [1, 1], ellipse, upright)  # sizes end up in the wrong places


@pytest.mark.parametrize("row", [slice(0, 3), slice(6, 9), slice(0, 9, 3)])
def test_a_missing_outer_row_or_column_is_refused(row):
    xy, ellipse = flat(PLAIN)
    with pytest.raises(DetectionError, match="cannot be decided"):
        label_discs(np.delete(xy, row, 0), np.delete(ellipse, row, 0), PLAIN)


def test_a_missing_outer_row_is_decided_by_marks():
    xy, ellipse = flat(MARKED, 130)
    index = label_discs(xy[12:], ellipse[12:], MARKED)
    assert index.tolist() == [-1] * 12 + list(range(96))


def test_missing_inner_discs_stay_missing():
    xy, ellipse = flat(PLAIN, 20)
    index = label_discs(np.delete(xy, 4, 0), np.delete(ellipse, 4, 0), PLAIN)
    assert index.tolist() == [0, 1, 2, 3, -1, 4, 5, 6, 7]


def test_a_disc_beside_the_grid_in_place_of_a_missing_one_is_ambiguous():
    xy, ellipse = flat(PLAIN)
    beside = xy[1] + (xy[4] - xy[7])  # where row -1 would be
    index = label_discs(np.vstack([xy, beside]), np.vstack([ellipse, ellipse[:1]]), PLAIN)
    assert index.tolist() == list(range(9))  # all nine seen: the tenth cannot be the target's
    xy = np.vstack([np.delete(xy, 7, 0), beside])
    with pytest.raises(DetectionError, match="9 disc candidates found, 9 discs expected"):
        label_discs(xy, ellipse, PLAIN)


def test_two_targets_and_a_larger_grid_are_refused():
    xy, ellipse = flat(PLAIN, scale=2.0)
    two = np.vstack([xy - np.array([300, 0]), xy + np.array([300, 0])])
    with pytest.raises(DetectionError, match="two such targets"):
        label_discs(two, np.vstack([ellipse, ellipse]), PLAIN)
    with pytest.raises(DetectionError, match="4 rows x 4 columns"):
        label_discs(*flat(DiscGrid(4, 4, (45, 45), 16)), PLAIN)


def test_discs_of_another_size_are_not_the_target():
    xy, ellipse = flat(DiscGrid(3, 3, (45, 45), 8))
    with pytest.raises(DetectionError, match="pitch and diameter"):
        label_discs(xy, ellipse, PLAIN)


def test_a_single_disc_must_be_alone_or_far_larger():
    single = DiscGrid(1, 1, (20, 20), 10)
    xy, ellipse = np.array([[50.0, 60.0], [90.0, 20.0]]), np.array([[9.0, 8, 0], [8.5, 8, 0]])
    assert label_discs(xy[:1], ellipse[:1], single).tolist() == [0]
    with pytest.raises(DetectionError, match="2 disc candidates found, 1 disc expected"):
        label_discs(xy, ellipse, single)
    assert label_discs(xy, ellipse / [[4.0, 4, 1], [1, 1, 1]], single).tolist() == [1]


def test_a_line_has_its_own_limit_of_roll_and_must_be_complete():
    for roll in (0, 59, -59):
        assert label_discs(*flat(LINE, roll), LINE).tolist() == [0, 1, 2, 3, 4]
        assert label_discs(*flat(COLUMN, roll), COLUMN).tolist() == [0, 1, 2, 3]
    for roll in (61, 90, -75, 100):
        with pytest.raises(DetectionError, match="rolled by"):
            label_discs(*flat(LINE, roll), LINE)
    xy, ellipse = flat(LINE)
    with pytest.raises(DetectionError, match="4 disc candidates found, 5 discs expected"):
        label_discs(xy[:4], ellipse[:4], LINE)
    with pytest.raises(DetectionError, match="longest of 6"):
        label_discs(*flat(DiscGrid(1, 6, (20, 20), 8)), LINE)


@pytest.mark.parametrize("roll", [0, 90, 180, 270])
def test_marks_turn_a_line(roll):
    line = DiscGrid(1, 5, (20, 20), 8, mark_discs=((0, 1, 11.0),))
    assert label_discs(*flat(line, roll), line).tolist() == [0, 1, 2, 3, 4]


def test_nothing_and_nonsense_are_refused():
    with pytest.raises(DetectionError, match="0 disc candidates found, 9 discs expected"):
        label_discs(np.empty((0, 2)), np.empty((0, 3)), PLAIN)
    with pytest.raises(DetectionError, match="0 disc candidates"):
        label_discs(np.full((9, 2), np.nan), np.ones((9, 3)), PLAIN)
    with pytest.raises(DetectionError):
        label_discs(np.zeros((9, 2)), np.ones((9, 3)), PLAIN)  # all in one place
