"""The thesis' examples of chapter 5 run and say what they promise."""

from __future__ import annotations

import re
import runpy
import sys
from pathlib import Path

import pytest

EXAMPLE = Path(__file__).parents[2] / "examples" / "point_of_correspondence.py"


def test_point_of_correspondence(shared, capsys, monkeypatch):
    scenes = shared / "data" / "rendered"
    monkeypatch.setattr(sys, "argv", [str(EXAMPLE), "--scenes", str(scenes)])
    runpy.run_path(str(EXAMPLE), run_name="__main__")
    text = capsys.readouterr().out
    for table in ("5.1", "5.2", "5.3", "5.4"):
        assert f"Table {table}" in text
    # centroids of five blocks and of nine discs: 0.88 and 0.60 px found, the thesis says 1
    differences = [float(value) for value in re.findall(r"largest difference ([\d.]+) px", text)]
    assert len(differences) == 2
    assert max(differences) <= 1.0
    assert "With 59 x 59, 4 of 5 elements have no edge" in text
    # 7 of 9, 4 of 9 and 6 of 11 are right: it is the literal method
    shares = [tuple(map(int, pair)) for pair in re.findall(r"within 1 px: (\d+) of (\d+)", text)]
    assert [total for _, total in shares] == [9, 9, 11]
    assert all(right >= least for (right, _), least in zip(shares, (6, 3, 5), strict=True))
    # heights of Table 5.4: a pixel is 0.66 mm; up to 0.43 mm found
    rows = re.findall(r"^ +\d +-?[\d.]+ +([\d.]+) +([\d.]+)$", text, flags=re.MULTILINE)
    assert len(rows) == 5
    assert all(abs(float(measured) - float(actual)) < 0.7 for measured, actual in rows)


def test_a_missing_folder_is_said(tmp_path, monkeypatch):
    monkeypatch.setattr(sys, "argv", [str(EXAMPLE), "--scenes", str(tmp_path)])
    with pytest.raises(SystemExit, match="--scenes"):
        runpy.run_path(str(EXAMPLE), run_name="__main__")
