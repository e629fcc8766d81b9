"""Readings and references that prove less than they seem to: items 59 to 61 of the list."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np


def test_item_59_reference_worse_than_a_quarter_of_the_limit(tables, run, tmp_path):
    positions, result = tmp_path / "positions.csv", tmp_path / "result.json"
    assert run(*tables.measure, "-o", positions).code == 0
    tables.edit("control.csv", lambda row: row.update(std_mm="0.0127"))
    limits = ["--accuracy-limit", "0.04", "0.04", "0.04"]
    outcome = run(
        "verify", "single-point", positions, "--truth", tables.control, *limits, "-o", result
    )
    assert outcome.code == 0
    assert "is not 4 times better than the accuracy limit" in outcome.stdout + outcome.stderr
    document = json.loads(result.read_text(encoding="utf-8"))
    assert any("4 times better" in text for text in document["warnings"])


def test_item_60_one_reading_has_no_standard_deviation(tables, run, tmp_path):
    positions, result = tmp_path / "positions.csv", tmp_path / "result.json"
    assert run(*tables.measure, "-o", positions).code == 0
    outcome = run("verify", "single-point", positions, "--truth", tables.control, "-o", result)
    assert outcome.code == 0
    assert "one reading has no standard deviation" in outcome.stdout + outcome.stderr
    text = result.read_text(encoding="utf-8")
    assert "NaN" not in text
    document = json.loads(text)
    assert any("one reading" in text for text in document["warnings"])
    assert document["repeatability"]["pooled"]["std_mm"] == [None, None, None]
    assert document["repeatability"]["pooled"]["dof"] == 0
    outcome = run("report", result, "-o", tmp_path / "report.html")
    assert outcome.code == 0
    assert "one reading has no standard deviation" in (tmp_path / "report.html").read_text("utf-8")


def test_item_61_frozen_readings_are_left_out_and_told(tables, run, tmp_path):
    positions, result = repeated_positions(tables, run, tmp_path, frozen=True)
    outcome = run("verify", "single-point", positions, "--truth", tables.control, "-o", result)
    assert outcome.code == 0
    assert "a frozen image" in outcome.stdout + outcome.stderr
    document = json.loads(result.read_text(encoding="utf-8"))
    assert any("frozen image" in text for text in document["warnings"])


def repeated_positions(tables, run, folder: Path, *, frozen: bool) -> tuple[Path, Path]:
    """Measure the points three times over; frozen readings are equal to the last digit."""
    rng = np.random.default_rng(3)
    for name in ("left.csv", "right.csv"):
        lines = (tables.folder / name).read_text(encoding="utf-8").splitlines()
        rows = []
        for line in lines[1:]:
            camera, placement, point, x, y, flags = line.split(",")
            for reading in "123":
                dx, dy = (0.0, 0.0) if frozen else rng.normal(0, 0.05, 2)
                numbers = f"{float(x) + dx},{float(y) + dy}"
                rows.append(f"{camera},{placement},{reading},{point},{numbers},{flags}")
        header = "camera,placement,reading,point,x_px,y_px,flags"
        (tables.folder / name).write_text("\n".join([header, *rows]), encoding="utf-8")
    positions = folder / "positions.csv"
    assert run(*tables.measure, "-o", positions).code == 0
    return positions, folder / "result.json"


def test_item_61_moving_readings_are_not_called_frozen(tables, run, tmp_path):
    positions, result = repeated_positions(tables, run, tmp_path, frozen=False)
    outcome = run("verify", "single-point", positions, "--truth", tables.control, "-o", result)
    assert outcome.code == 0
    assert "frozen" not in outcome.stdout + outcome.stderr
