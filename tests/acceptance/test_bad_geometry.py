"""Impossible and weak geometry through the command line: items 20, 23, 26 to 29, 38, 40 to 42, 62.

Each test is named after its item and feeds the files themselves.
"""

from __future__ import annotations

import csv
import json

import numpy as np
import pytest

from closerange.rig.camera_fit import fit_camera
from closerange.verification.scenes import looking_at_origin, rig_a


def positions_of(path):
    with path.open(newline="", encoding="utf-8") as stream:
        return list(csv.DictReader(stream))


def flags_of(path):
    return [set(filter(None, row["flags"].split("|"))) for row in positions_of(path)]


def relabel(new):
    """Return a change that renames ``r{r}c{c}``."""

    def change(row):
        r, c = int(row["point"][1]), int(row["point"][3])
        row["point"] = new(r, c)

    return change


# Mirrored labels look alike on parallel flat targets: the causes that fit are all named.
MIRRORED = {
    "rows and columns exchanged": lambda r, c: f"r{c}c{r}",
    "columns counted from the other side": lambda r, c: f"r{r}c{2 - c}",
    "counted from the other side": lambda r, c: f"r{2 - r}c{c}",
}


@pytest.mark.parametrize("cause", MIRRORED)
@pytest.mark.parametrize("cameras", [["left"], ["right"], ["left", "right"]])
def test_item_23_labels_of_all_placements_mirrored(tables, refused, cause, cameras):
    for camera in cameras:
        tables.edit(f"{camera}.csv", relabel(MIRRORED[cause]))
    refused(tables.calibrate, 1, f"camera {cameras[0]!r}", cause, "the residual", once=True)


def turned_in(placements):
    """Return a change that turns the labels of some placements by half a turn."""
    turn = relabel(lambda r, c: f"r{2 - r}c{2 - c}")
    return lambda row: turn(row) if row["placement"] in placements else None


def test_item_22_labels_of_one_placement_turned_by_half_a_turn(tables, refused):
    """What a symmetric board does to one image: the placement and the cause are named."""
    tables.edit("left.csv", turned_in({"z2"}))
    refused(
        tables.calibrate, 1, "camera 'left', placement 'z2'", "turned by half a turn", once=True
    )


def test_item_22_labels_of_some_placements_turned_by_half_a_turn(tables, refused):
    tables.edit("left.csv", turned_in({"z2", "z4", "z5"}))
    refused(tables.calibrate, 1, "placements and cameras are named rightly", once=True)


def test_item_20_cameras_exchanged_in_some_placements(tables, refused):
    tables_exchanged(tables, {"z1", "z3", "z5"})
    refused(tables.calibrate, 1, "cameras are named rightly", once=True)


def test_item_20_cameras_exchanged_in_one_placement(tables, refused):
    tables_exchanged(tables, {"z3"})
    refused(tables.calibrate, 1, "camera 'left', placement 'z3'", "cameras exchanged", once=True)


def tables_exchanged(tables, placements):
    """Exchange the image positions of the two cameras in some placements."""
    seen = {}
    for camera in ("left", "right"):
        tables.edit(
            f"{camera}.csv",
            lambda row: seen.update(
                {(row["camera"], row["placement"], row["point"]): (row["x_px"], row["y_px"])}
            ),
        )

    def exchange(row):
        if row["placement"] in placements:
            other = {"left": "right", "right": "left"}[row["camera"]]
            row["x_px"], row["y_px"] = seen[other, row["placement"], row["point"]]

    for camera in ("left", "right"):
        tables.edit(f"{camera}.csv", exchange)


def test_item_20_cameras_exchanged_when_measuring(tables, run, tmp_path):
    """The pair is symmetric: many exchanged rays meet, yet not all, and none where they should."""
    tables_exchanged(tables, {f"z{k}" for k in range(7)})
    output = tmp_path / "positions.csv"
    outcome = run(*tables.measure, "-o", output)
    assert outcome.code == 1
    assert "error: the rays of 28 of 63 points miss each other" in outcome.stderr
    assert "with 'left' as 'right', 'right' as 'left', 63 of 63 points fit" in outcome.stderr
    assert np.mean(["residual" in flags for flags in flags_of(output)]) > 0.25  # 28 of 63


@pytest.mark.parametrize("count", [1, 5])
@pytest.mark.parametrize("model", ["auto", "dlt", "brown"])
def test_item_26_fewer_than_six_points(scene, refused, count, model):
    xyz = np.array([[-40, -40, -40], [40, -40, 0], [-40, 40, 10], [40, 40, 40], [0, 0, 20]])
    tables = scene(xyz[:count])
    refused([*tables.calibrate, "--model", model], 1, "'left'", f"{count} different", "6")


def test_item_26_points_without_any_control(tables, refused):
    tables.edit("control.csv", lambda row: row.update(point=f"other-{row['point']}"))
    refused(tables.calibrate, 1)


@pytest.mark.parametrize("model", ["auto", "dlt", "brown", "pinhole", "thesis-dlt"])
def test_item_27_points_in_one_plane(tables, refused, model):
    for name in ("left.csv", "right.csv"):
        tables.keep(name, lambda row: row["placement"] == "z2")
    stderr = refused([*tables.calibrate, "--model", model], 1, "plane")
    assert "placement" in stderr.split("remedy:")[1]


def test_item_27_points_in_one_tilted_plane(scene, refused):
    x, y = (grid.ravel() for grid in np.meshgrid(np.linspace(-45, 45, 5), np.linspace(-45, 45, 5)))
    refused(scene(np.column_stack([x, y, 0.5 * x - 0.3 * y])).calibrate, 1, "plane")


@pytest.mark.parametrize("model", ["auto", "dlt"])
def test_item_28_points_on_a_line(scene, refused, model):
    xyz = np.linspace([-45, -30, -50], [45, 40, 50], 20)
    refused([*scene(xyz).calibrate, "--model", model], 1, "line")


@pytest.fixture
def weak(scene):
    """Give nine points on each of two planes only 0.4 mm apart: depth is hardly fixed."""
    x, y = (grid.ravel() for grid in np.meshgrid([-45.0, 0, 45], [-45.0, 0, 45]))
    plane, offset = np.column_stack([x, y, np.zeros(9)]), np.array([0.0, 0.0, 0.2])
    return scene(np.concatenate([plane - offset, plane + offset]))


def test_item_29_badly_conditioned_is_refused_in_mm(weak, refused):
    volume = ["--volume", "-45", "-45", "-50", "45", "45", "50"]
    stderr = refused([*weak.calibrate, *volume], 1, "mm", "--accept-untrusted")
    assert "untrustworthy" in stderr or "plane" in stderr


def test_item_29_accepted_rig_is_marked_and_marks_what_is_measured(weak, run, tmp_path):
    rig, positions, result = (tmp_path / name for name in ("rig.json", "pos.csv", "res.json"))
    volume = ["--volume", "-45", "-45", "-50", "45", "45", "50"]
    outcome = run(*weak.calibrate, *volume, "--accept-untrusted", "-o", rig)
    assert outcome.code == 0
    assert "untrustworthy" in outcome.stdout
    assert json.loads(rig.read_text(encoding="utf-8"))["trust"]["verdict"] == "untrustworthy"
    outcome = run("measure", rig, weak.left, weak.right, "-o", positions)
    assert outcome.code == 1  # no row without a flag
    assert all("untrusted" in flags for flags in flags_of(positions))
    assert all(row["x_mm"] for row in positions_of(positions))  # coordinates are kept
    outcome = run("verify", "single-point", positions, "--truth", weak.control, "-o", result)
    if outcome.code == 0:
        document = json.loads(result.read_text(encoding="utf-8"))
        assert any("untrustworthy rig" in text for text in document["warnings"])


@pytest.mark.parametrize("axis", ["x", "y", "z"])
def test_item_38_left_handed_axes(tables, refused, axis):
    def mirror(row):
        row[f"{axis}_mm"] = repr(-float(row[f"{axis}_mm"]))

    tables.edit("control.csv", mirror)
    refused(tables.calibrate, 1, "left-handed", once=True)


def test_item_38_two_axes_exchanged(tables, refused):
    def exchange(row):
        row["y_mm"], row["z_mm"] = row["z_mm"], row["y_mm"]

    tables.edit("control.csv", exchange)
    refused(tables.calibrate, 1, "left-handed", once=True)


def behind(row):
    """Put one control point 1.5 m behind the cameras that see it."""
    if (row["placement"], row["point"]) == ("z4", "r1c1"):
        row["z_mm"] = "3000"


@pytest.fixture
def with_one_behind(tables):
    """Give three placements, one of whose control points lies behind the cameras."""
    tables.edit("control.csv", behind)
    for name in ("left.csv", "right.csv"):
        tables.keep(name, lambda row: row["placement"] in {"z0", "z4", "z6"})
    return tables


def test_item_40_control_point_behind_the_cameras(with_one_behind, refused):
    refused([*with_one_behind.calibrate, "--model", "brown"], 1, once=True)


def test_item_40_control_point_behind_the_cameras_is_named(with_one_behind, refused):
    refused([*with_one_behind.calibrate, "--model", "brown"], 1, "z4/r1c1", "behind", once=True)


def test_item_40_rays_that_meet_behind_the_cameras(tables, run, tmp_path):
    """Image points far to the outer sides: the rays run apart and would meet behind."""
    text = "camera,point,x_px,y_px\nleft,p,{},{}\nright,p,{},{}\n"
    tables.left.write_text(text.format(1279, 512, 0, 512), encoding="utf-8")
    document = json.loads(tables.rig.read_text(encoding="utf-8"))
    for camera in document["cameras"]:
        # parallel axes, 1 m apart: with points on the outer sides the rays diverge
        pose = camera["camera_from_world"]
        pose["rotation"] = [[1, 0, 0], [0, -1, 0], [0, 0, -1]]
        side = 500.0 if camera["name"] == "left" else -500.0
        pose["translation_mm"] = [side, 0.0, 1500.0]
    tables.rig.write_text(json.dumps(document), encoding="utf-8")
    tables.left.write_text(text.format(0, 512, 1279, 512), encoding="utf-8")
    output = tmp_path / "positions.csv"
    outcome = run("measure", tables.rig, tables.left, "-o", output)
    assert outcome.code == 1
    assert "behind_camera" in flags_of(output)[0]


def test_item_41_nearly_parallel_rays(run, scene, tmp_path):
    """Cameras 0.5 degrees apart: depth is a hundred times worse than breadth."""
    cameras = [
        looking_at_origin(name, angle_rad=angle, distance_mm=1500.0, focal_px=4800.0)
        for name, angle in (("left", -0.00436), ("right", 0.00436))
    ]
    x, y, z = (grid.ravel() for grid in np.meshgrid(*[[-45.0, -15.0, 15.0, 45.0]] * 3))
    tables = scene(np.column_stack([x, y, z]), cameras=cameras)
    rig, positions = tmp_path / "rig.json", tmp_path / "positions.csv"
    outcome = run(*tables.calibrate, "--accept-untrusted", "-o", rig)
    assert outcome.code == 0
    outcome = run("measure", rig, tables.left, tables.right, "-o", positions)
    assert outcome.code == 1
    assert all("near_parallel" in flags for flags in flags_of(positions))
    row = positions_of(positions)[0]
    assert float(row["cov_zz_mm2"]) > 1.0  # 0.03^2 for rays 40 degrees apart


def test_item_41_skew_rays(tables, run, tmp_path):
    """One point 2 px off its epipolar line, forty times its noise: that row is flagged."""

    def shift(row):
        if (row["placement"], row["point"]) == ("z0", "r0c0"):
            row["y_px"] = repr(float(row["y_px"]) + 2.0)

    tables.edit("right.csv", shift)
    output = tmp_path / "positions.csv"
    assert run(*tables.measure, "-o", output).code == 0
    flags = flags_of(output)
    assert flags[0] == {"residual"}
    assert not any(flags[1:])


def test_item_42_outside_of_the_calibrated_block(tables, run, tmp_path):
    inside, outside = [0.0, 0.0, 0.0], [0.0, 0.0, 180.0]
    lines = ["camera,point,x_px,y_px"]
    for camera in rig_a().cameras:
        for name, xyz in (("in", inside), ("out", outside)):
            x, y = camera.project(np.array([xyz]))[0]
            lines.append(f"{camera.name},{name},{x},{y}")
    tables.left.write_text("\n".join(lines), encoding="utf-8")
    output = tmp_path / "positions.csv"
    assert run("measure", tables.rig, tables.left, "-o", output).code == 0
    within, beyond = positions_of(output)
    assert within["flags"] == ""
    assert beyond["flags"] == "outside_volume"
    # and its uncertainty has grown with the distance from the block
    assert float(beyond["cov_zz_mm2"]) > 1.2 * float(within["cov_zz_mm2"])


@pytest.mark.parametrize(
    ("volume", "code"),
    [
        (["45", "45", "50", "-45", "-45", "-50"], 2),
        (["-45", "-45", "0", "45", "45", "0"], 2),
        (["nan", "-45", "-50", "45", "45", "50"], 2),
    ],
)
def test_impossible_volume(tables, refused, volume, code):
    refused([*tables.calibrate, "--volume", *volume], code, "volume")


def test_item_42_stated_volume_far_from_the_points(tables, refused):
    """Nothing was calibrated there: the predicted error decides, in mm."""
    volume = ["--volume", "-2000", "-2000", "-2000", "-1800", "-1800", "-1800"]
    refused([*tables.calibrate, *volume], 1, "no part of the volume", "--volume")


def test_item_62_unconverged_fit_is_not_trusted(tables, run, refused, monkeypatch, tmp_path):
    """Two steps do not reach the minimum."""
    monkeypatch.setitem(fit_camera.__kwdefaults__, "max_iterations", 2)
    refused([*tables.calibrate, "--model", "brown"], 1, "did not converge", "--accept-untrusted")
    rig = tmp_path / "rig.json"
    outcome = run(*tables.calibrate, "--model", "brown", "--accept-untrusted", "-o", rig)
    assert outcome.code == 0
    document = json.loads(rig.read_text(encoding="utf-8"))
    assert document["trust"]["verdict"] == "untrustworthy"


def test_unknown_model_names_the_known_ones(tables, refused):
    refused([*tables.calibrate, "--model", "fisheye"], 2, "'fisheye'", "brown")
