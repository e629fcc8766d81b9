"""Bad moments and bad dials through the command line: items 21 and 37 of the list of bad inputs.

Both spoil whole placements at once: cameras that do not expose together, and a positioning
device that is not where its dial says.
"""

from __future__ import annotations

import json
import shutil

import numpy as np
import pytest

HEIGHTS = ("z-50.0", "z+00.0", "z+50.0")
LATE_S = 0.65


def write_times(path, late=(), offset_s=0.0, placements=None, header="camera,placement,time_s"):
    """Write times of a rig with 0.2 ms of jitter; some sets of the right camera come late."""
    lines = [header]
    for number, placement in enumerate(placements or [f"z{k}" for k in range(7)]):
        moment = 1000 + 2.5 * number
        right = moment + 0.0002 + offset_s + (LATE_S if placement in late else 0)
        lines += [f"left,{placement},{moment}", f"right,{placement},{right}"]
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")
    return path


@pytest.fixture
def timed(tables):
    """Return the arguments of a verb with times of exposure; without ``-o``."""

    def args(verb, times, tolerance="0.001"):
        return [*getattr(tables, verb), "--times", times, "--time-tolerance", tolerance]

    return args


@pytest.mark.parametrize("verb", ["calibrate", "measure"])
def test_item_21_times_apart(timed, refused, tmp_path, verb):
    times = write_times(tmp_path / "times.csv", late={"z4", "z5"})
    refused(
        timed(verb, times), 2, "times.csv", "'left' and 'right'", "placement 'z", "0.6502 s apart",
        "the limit is 0.001 s", "2 of 7 sets", "trigger the cameras together",
    )  # fmt: skip


@pytest.mark.parametrize("verb", ["calibrate", "measure"])
def test_item_21_times_within_the_tolerance(timed, run, tmp_path, verb):
    times = write_times(tmp_path / "times.csv")
    outcome = run(*timed(verb, times), "-o", tmp_path / "out")
    assert (outcome.code, outcome.stderr) == (0, "")
    assert run(*timed(verb, times, "0.0001"), "-o", tmp_path / "again").code == 2


def test_item_21_a_clock_that_is_off_is_told_from_late_images(timed, refused, tmp_path):
    times = write_times(tmp_path / "times.csv", offset_s=-3600.0)
    refused(timed("measure", times), 2, "by the same -3600 s in every set", "clock", "subtract")


def test_item_21_image_without_a_time(timed, refused, tmp_path):
    times = write_times(tmp_path / "times.csv", placements=["z0", "z1"])
    refused(timed("measure", times), 2, "no time for camera 'left', placement 'z2'")


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ("time_s", "time", "'time_s' is missing"),
        ("1002.5", "1002,5", "row 4"),
        ("1002.5", "", "the cell is empty"),
        ("1002.5", "12:40:02", "'12:40:02' is not a number"),
        ("right,z0", "left,z0", "has two times"),
        ("left,z0", ",z0", "the cell is empty"),
    ],
)
def test_item_21_malformed_times(timed, refused, tmp_path, old, new, words):
    times = write_times(tmp_path / "times.csv")
    text = times.read_text(encoding="utf-8")
    assert old in text
    times.write_text(text.replace(old, new, 1), encoding="utf-8")
    refused(timed("measure", times), 2, "times.csv", words)


@pytest.mark.parametrize("tolerance", ["-1", "nan", "inf"])
def test_item_21_tolerance_that_is_none(timed, refused, tmp_path, tolerance):
    times = write_times(tmp_path / "times.csv")
    refused(timed("measure", times, tolerance), 2, f"{float(tolerance)} s", "0 or more")


@pytest.mark.parametrize("alone", ["--times", "--time-tolerance"])
def test_item_21_one_option_without_the_other(tables, refused, tmp_path, alone):
    write_times(tmp_path / "times.csv")
    value = tmp_path / "times.csv" if alone == "--times" else "0.001"
    refused([*tables.measure, alone, value], 2, f"{alone} was given alone")


@pytest.fixture
def timed_project(project):
    """Let the project state a table of times and a tolerance."""
    path = project / "closerange.toml"
    keys = '[calibration]\ntimes = "times.csv"\ntime_tolerance_s = 0.001'
    text = path.read_text(encoding="utf-8")
    path.write_text(text.replace("[calibration]", keys), encoding="utf-8")
    return project


def test_item_21_project_with_late_images(timed_project, run):
    write_times(timed_project / "times.csv", late={"z+00.0"}, placements=HEIGHTS)
    outcome = run("run", timed_project / "closerange.toml")
    assert outcome.code == 2
    assert "took placement 'z+00.0' 0.6502 s apart, the limit is 0.001 s" in outcome.stderr
    assert not (timed_project / "results").exists()


def test_item_21_project_with_images_taken_together(timed_project, run):
    write_times(timed_project / "times.csv", placements=HEIGHTS)
    assert run("run", timed_project / "closerange.toml").code == 0
    document = json.loads((timed_project / "results" / "run.json").read_text(encoding="utf-8"))
    assert "times.csv" in document["provenance"]["inputs"]


@pytest.mark.parametrize("key", ['times = "times.csv"\n', "time_tolerance_s = 0.001\n"])
def test_item_21_project_that_states_half(timed_project, run, key):
    path = timed_project / "closerange.toml"
    path.write_text(path.read_text(encoding="utf-8").replace(key, ""), encoding="utf-8")
    outcome = run("run", path)
    assert outcome.code == 2
    assert "times and time_tolerance_s go together" in outcome.stderr


# a turn of a dial with 0.1 inch a turn
TURN_MM = 2.54
SUSPECT = "Was the positioning device"


def shifted(placements, mm=TURN_MM, axis="z_mm"):
    """Return a change of control rows: an error of whole placements along one axis."""

    def change(row):
        if row["placement"] in placements:
            row[axis] = str(float(row[axis]) + mm)

    return change


@pytest.fixture
def calibrated(tables, run, tmp_path):
    """Calibrate with a spoiled control table; return warnings and summary."""

    def calibrate(*more):
        outcome = run(*tables.calibrate, *more, "-o", tmp_path / "rig.json", "--json")
        assert outcome.code == 0, outcome.stderr
        summary = json.loads(outcome.stdout)
        hints = [text for text in summary["warnings"] if SUSPECT in text]
        assert all(f"warning: {hint}" in outcome.stderr for hint in hints)
        return hints, summary

    return calibrate


def test_item_37_good_control_raises_no_suspicion(calibrated):
    assert calibrated()[0] == []


@pytest.mark.parametrize("placement", ["z0", "z3", "z6"])
@pytest.mark.parametrize("axis", ["x_mm", "z_mm"])
def test_item_37_a_turn_lost_and_found_again(tables, calibrated, placement, axis):
    """One placement is off by a turn: which one, and how far."""
    tables.edit("control.csv", shifted({placement}, axis=axis))
    (hint,), _ = calibrated("--model", "brown")
    assert f"placement '{placement}'" in hint
    found = np.array([float(text) for text in hint.split("(")[1].split(")")[0].split(", ")])
    expected = np.where(np.array(["x_mm", "y_mm", "z_mm"]) == axis, TURN_MM, 0)
    # one placement of nine points at 0.05 px: 0.01 mm across, 0.03 mm in depth
    np.testing.assert_allclose(found, expected, atol=0.1)


def test_item_37_a_turn_lost_for_good(tables, calibrated):
    """All later placements are off: they stay in the fit, which they spoil tenfold."""
    tables.edit("control.csv", shifted({"z5", "z6"}))
    (hint,), summary = calibrated()
    assert "z_mm is +2.5" in hint or "z_mm is +2.6" in hint
    assert "in the placements from z = 35.87" in hint  # as written: 33.33 and a turn
    assert summary["noise_px"] > 0.2


def test_item_37_dial_at_the_end_of_its_travel(tables, calibrated):
    """The table moves on to 33 and 50 mm, the dial stands still at 30."""
    tables.edit("control.csv", lambda row: row.update(z_mm=str(min(float(row["z_mm"]), 30.0))))
    hints, _ = calibrated()
    assert len(hints) == 2
    assert "'z5'" in hints[0]
    assert "'z6'" in hints[1]


@pytest.fixture
def moved_in_x(scene):
    """Write a plate of 3 x 3 points at 3 heights, moved along x by a stage."""
    rows = [
        (f"x{x:+d}z{z:+d}", (c * 30.0 + x, r * 30.0, float(z)))
        for z in (-40, 0, 40)
        for x in (-20, 0, 20)
        for r in (-1, 0, 1)
        for c in (-1, 0, 1)
    ]
    placement, xyz = zip(*rows, strict=True)
    return scene(xyz, placement)


def test_item_37_scale_of_the_travel_against_the_plate(moved_in_x, run, tmp_path):
    """The stage says 20 mm where it moved 19.7: the plate's own pitch contradicts it."""

    def change(row):
        stage = float(row["placement"][1 : row["placement"].index("z")])
        row["x_mm"] = str(float(row["x_mm"]) + 0.015 * stage)

    moved_in_x.edit("control.csv", change)
    outcome = run(*moved_in_x.calibrate, "-o", tmp_path / "rig.json")
    assert outcome.code == 0
    assert "distances along x are +1.4" in outcome.stderr or "x are +1.5" in outcome.stderr
    assert SUSPECT in outcome.stderr


def test_item_37_scale_that_a_calibration_cannot_see_shows_in_verify(tables, run):
    """All depths 1.6 % too long: cameras imitate that. Independent positions tell."""
    true_control = tables.folder / "true.csv"
    shutil.copy(tables.control, true_control)
    tables.edit("control.csv", lambda row: row.update(z_mm=str(float(row["z_mm"]) * 1.016)))
    rig, positions = tables.rig, tables.folder / "positions.csv"
    assert run(*tables.calibrate, "-o", rig).stderr == ""
    assert run(*tables.measure, "-o", positions).code == 0
    for kind in ("control", "single-point"):
        outcome = run(
            "verify", kind, positions, "--truth", true_control, "-o", tables.folder / "r.json"
        )
        assert outcome.code == 0
        assert "distances along z are -1.5" in outcome.stderr or "z are -1.6" in outcome.stderr
        assert SUSPECT in outcome.stderr
    outcome = run("verify", "control", positions, "--truth", tables.control,
                  "-o", tables.folder / "r.json")  # fmt: skip
    assert outcome.stderr == ""


def test_item_37_lost_turn_in_the_truth_of_a_verification(tables, run):
    positions = tables.folder / "positions.csv"
    assert run(*tables.measure, "-o", positions).code == 0
    tables.edit("control.csv", shifted({"z4", "z5", "z6"}, mm=0.5))
    outcome = run("verify", "control", positions, "--truth", tables.control,
                  "-o", tables.folder / "r.json")  # fmt: skip
    assert outcome.code == 0
    assert "z_mm is +0.50" in outcome.stderr or "z_mm is +0.49" in outcome.stderr


def test_item_37_points_that_do_not_move_have_no_travel(run, scene, tmp_path):
    """One placement: nothing is said of a device."""
    axis = (-40.0, 0.0, 40.0)
    tables = scene([(x, y, z) for x in axis for y in axis for z in axis])
    tables.edit("control.csv", lambda row: row["z_mm"] == "40.0" and row.update(z_mm="41.0"))
    outcome = run(*tables.calibrate, "-o", tmp_path / "rig.json")
    assert outcome.code == 0
    assert SUSPECT not in outcome.stderr
