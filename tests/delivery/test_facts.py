import hashlib
import math
import shutil
import subprocess

import pytest

from closerange.delivery.facts import (
    FEW_FILES,
    combined_hash,
    fact_blocks,
    provenance_section,
    words,
)


def test_names_become_words_and_units():
    assert words("cross_validation_px") == "cross validation [px]"
    assert words("cycle_time_s") == "cycle time [s]"
    assert words("s") == "s"
    assert words("model") == "model"


def test_nested_facts_rows_and_hashes_become_tables():
    blocks = fact_blocks(
        "Facts",
        {
            "program": "closerange 1",
            "options": {"volume_mm": [[0, 0.5], [1, 2]], "trust": True, "empty": None, "none": []},
            "choice": [{"model": "a", "rms_px": 0.25}, {"model": "b", "rms_px": None}],
            "inputs": {"a.csv": "0" * 64},
        },
    )
    singles, choice, inputs = blocks
    assert list(singles.rows) == [
        ("program", "closerange 1"),
        ("options: volume [mm]", "0, 0.5000, 1, 2"),
        ("options: trust", "yes"),
    ]
    assert choice.head == ("model", "rms [px]")
    assert [list(row) for row in choice.rows] == [["a", "0.2500"], ["b", "\u2013"]]
    assert choice.texts == {0}
    assert list(inputs.rows) == [("a.csv", "0" * 64)]


def test_infinity_is_a_dash():
    (table,) = fact_blocks("Facts", {"x": math.inf})
    assert list(table.rows) == [("x", "\u2013")]


def test_nothing_known_gives_no_section():
    assert provenance_section({}) is None
    assert provenance_section({"options": {"a": None}}) is None


def test_mappings_of_the_same_names_become_one_table():
    cameras = {"left": {"points": 9, "s_px": 0.5}, "right": {"points": 8, "s_px": None}}
    (table,) = fact_blocks("Facts", {"cameras": cameras})
    assert table.caption == "Cameras"
    assert table.head == ("name", "points", "s [px]")
    assert [list(row) for row in table.rows] == [
        ["left", "9", "0.5000"],
        ["right", "8", "\u2013"],
    ]


def test_many_files_become_one_line_with_one_hash_and_a_folded_list():
    hashes = {f"f{i:02}.png": f"{i:064x}" for i in reversed(range(FEW_FILES + 1))}
    (files,) = fact_blocks("Facts", {"inputs": hashes})
    assert files.kind == "files"
    assert files.entries == tuple(sorted(hashes.items()))
    total = combined_hash(hashes)
    assert files.caption == f"Input files: {len(hashes)} files, combined SHA-256 {total}"
    (few,) = fact_blocks("Facts", {"inputs": dict(list(hashes.items())[1:])})
    assert few.caption == "Input files"
    assert few.rows == tuple(sorted(hashes.items()))[:-1]


def test_anyone_can_recompute_the_combined_hash(tmp_path):
    """The list is what the command of every Unix prints."""
    tool = shutil.which("sha256sum")
    if tool is None:
        pytest.skip("no sha256sum on this machine")
    for name in ("b.csv", "a.csv"):
        (tmp_path / name).write_text(name)
    run = [tool, "a.csv", "b.csv"]
    printed = subprocess.run(run, cwd=tmp_path, capture_output=True, check=True).stdout
    hashes = {name: hashlib.sha256(name.encode()).hexdigest() for name in ("b.csv", "a.csv")}
    assert combined_hash(hashes) == hashlib.sha256(printed).hexdigest()
