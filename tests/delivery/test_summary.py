import json

import numpy as np

from closerange.delivery.summary import json_summary, text_summary


def test_text_is_aligned_and_says_what_to_believe(rig, points, positions, acceptance):
    text = text_summary(
        rig=rig,
        points=points,
        positions=positions,
        checks=[acceptance],
        notes=["first", "second\nand its remedy"],
        more=[("Report", "report.html")],
    )
    lines = text.split("\n")
    assert [line[:13].rstrip() for line in lines] == [
        *("Rig", "Trust", "", "Points", "Measured", "Verified", "Warning", "", "", "Report")
    ]
    assert lines[0][13:] == "2 cameras, 27 points in 1 placement, model brown, image noise 0.020 px"
    assert lines[1][13:] == (
        "fair: predicted error 4.1 um (X) 4.2 um (Y) 9.3 um (Z) inside 80 x 80 x 80 mm"
    )
    assert lines[3][13:] == (
        "53 of 54 found by 2 cameras, 1 placement, 2 flagged (not_found 1, saturated 1)"
    )
    assert lines[4][13:] == "24 positions of 25, 2 flagged (residual 1, single_view 1)"
    assert lines[5].endswith(": reject")
    assert text.isascii()


def test_text_of_control_and_lengths(control_check, length_check):
    lines = text_summary(checks=[control_check, length_check]).split("\n")
    check = control_check.groups["check"]
    assert lines[0].startswith(
        f"Control      3 check points: rms error {1e3 * check.rms_mm[0]:.1f} um"
    )
    assert lines[1] == "Lengths      1 length: rms error 4.0 um, largest 4.0 um"


def test_what_is_not_known_is_a_plain_dash(length_check):
    document = {**length_check.to_document(), "rms_mm": None, "max_mm": None}
    assert text_summary(checks=[document]) == "Lengths      1 length: rms error -, largest -"


def test_nothing_gives_an_empty_text():
    assert text_summary() == ""


def test_json_is_strict_and_holds_the_figures(
    rig,
    points,
    positions,
    acceptance,
    control_check,
    error_map,
):
    document = json_summary(
        title="Cell",
        rig=rig,
        points=points,
        positions=positions,
        checks=[acceptance, control_check],
        error_map=error_map,
        provenance={"program": "closerange 9"},
        notes=["mind <this>"],
    )
    again = json.loads(json.dumps(document, allow_nan=False))
    assert again == document
    assert document["rig"]["trust"]["predicted_mm"] == [0.0041, 0.0042, 0.0093]
    assert document["rig"]["fitted"] == 52
    assert document["points"]["flags"] == {"not_found": 1, "saturated": 1}
    assert document["positions"]["measured"] == 24
    assert np.isclose(document["predicted_error_mm"]["rms"][1], 0.004)
    single = document["checks"][0]
    assert single["accuracy"]["max_mm"] == acceptance.accuracy.max_mm.tolist()
    assert single["decision"] == "reject"
    assert single["cycle_time_s"] is None
    assert "rows" not in single
    assert document["verdict"].startswith("Rejected: repeatability Z is")
    assert document["warnings"] == ["mind <this>"]


def test_json_of_nothing_says_so():
    assert json_summary(title="x") == {
        "title": "x",
        "verdict": "Nothing was measured.",
        "warnings": [],
    }
