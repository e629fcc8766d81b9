import dataclasses

import numpy as np

from closerange.delivery.excerpts import FOLD_ROWS, shown
from closerange.delivery.report import render_report
from closerange.delivery.sheet import Contents
from closerange.delivery.table_sections import points_section, positions_section
from closerange.features.threshold import ThresholdReport
from closerange.position.positions import Positions


def _readings(pairs):
    """Two readings at each of so many positions, 3 um apart in X."""
    count = 2 * pairs
    place = np.repeat(np.arange(pairs), 2)
    xyz = np.zeros((count, 3))
    xyz[:, 0] = 10.0 * place + np.tile([0.0, 0.003], pairs)
    return Positions(
        tuple(f"s{i}" for i in place),
        ("disc",) * count,
        xyz,
        np.broadcast_to(1e-6 * np.eye(3), (count, 3, 3)),
        np.full(count, 0.01),
        np.full(count, 2),
        np.zeros(count, int),
        ("0", "1") * pairs,
    )


def test_jobs_stand_under_their_names(points, positions):
    section = points_section(Contents(title="t", points={"one": points, "two": points}))
    table, flagged = section.blocks
    assert [row[:2] for row in table.rows] == [
        *(("one", "left"), ("one", "right"), ("two", "left"), ("two", "right")),
    ]
    assert [row[0] for row in flagged.rows] == ["one", "one", "two", "two"]
    section = positions_section(Contents(title="t", positions={"a": positions, "b": positions}))
    assert [row[:4] for row in section.blocks[0].rows] == [
        ("a", "25", "24", "23"),
        ("b", "25", "24", "23"),
    ]
    assert "job a, placement s0" in section.blocks[1].caption


def test_one_nameless_job_has_no_column_for_its_name(points):
    table = points_section(Contents(title="t", points={"": points})).blocks[0]
    assert table.head[0] == "camera"
    assert table.texts == {0}


def test_thresholds_that_could_have_been_others_are_listed(points):
    several = ThresholdReport(91.5, (40.25, 91.5), (10.0, 30.0))
    found = {
        ("left", "z0", ""): several,
        ("right", "z0", ""): ThresholdReport(80.0, (80.0,), (20.0,)),
    }
    blocks = points_section(
        Contents(
            title="t", points={"a": dataclasses.replace(points, thresholds=found), "b": points}
        )
    ).blocks
    words, table = blocks[1:3]
    assert "Of 2 images, 1 has more than one" in words.text
    assert table.rows == [("a", "left", "z0", "grey values", "91.50", "40.25, 91.50")]


def test_a_few_readings_at_many_positions_are_drawn_together():
    section = positions_section(Contents(title="t", positions={"": _readings(12)}))
    figure = section.blocks[1]
    assert "All 24 readings in the order of the table" in figure.caption
    assert "(12 positions)" in figure.caption
    # +-1.5 um about the mean, one degree of freedom a pair: sqrt(2) * 1.5 = 2.1
    assert "X 2.1 Y 0.0 Z 0.0" in figure.caption
    assert positions_section(Contents(title="t", positions={"": _readings(5)})).blocks[1].kind == (
        "table"
    )


def test_rows_that_were_compared_are_not_printed_twice(acceptance):
    check = {**acceptance.to_document(), "job": "test"}
    contents = Contents(
        title="t", positions={"test": _readings(3), "other": _readings(3)}, checks=(check,)
    )
    *_, compared, other = positions_section(contents).blocks
    assert (compared.folded, compared.printed) == (True, False)
    assert compared.summary.endswith(": test: 6 rows; not printed")
    assert (other.folded, other.printed) == (False, True)


def test_long_tables_fold_and_blank_columns_are_left_out():
    rows = [("a", "", str(i)) for i in range(FOLD_ROWS + 1)]
    table = shown(rows, "Long", ("name", "flags", "n"), texts=frozenset({0, 1}))
    assert table.folded
    assert table.head == ("name", "n")
    assert table.texts == {0}
    assert table.summary == f"Long: {FOLD_ROWS + 1} rows"
    assert not shown(rows[1:], "Short", ("name", "flags", "n")).folded


def test_what_is_folded_stands_beside_its_switch_and_is_printed():
    """A closed <details> prints nothing in most browsers, hence the rule for screens alone."""
    inputs = {f"f{i}.png": f"{i:064x}" for i in range(50)}
    page = render_report(title="t", provenance={"inputs": inputs})
    assert page.count('</details>\n<div class="files folded">') == 1
    assert "@media screen { details.fold:not([open]) + .folded { display: none; } }" in page
    assert all(digest in page for digest in inputs.values())
    assert page.count("Input files: 50 files, combined SHA-256") == 2


def test_unmeasured_readings_are_no_readings(positions):
    lost = dataclasses.replace(positions, xyz_mm=np.full((25, 3), np.nan))
    blocks = positions_section(Contents(title="t", positions={"": lost})).blocks
    assert [block.kind for block in blocks] == ["table", "table"]
