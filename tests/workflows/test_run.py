"""The verb `run`: folders of results that appear whole, and replace only their like."""

from __future__ import annotations

import shutil
from importlib.resources import files
from pathlib import Path

import pytest

from closerange.errors import (
    FileError,
    InputError,
)
from closerange.workflows.run import run

DEMO = Path(str(files("closerange.workflows") / "demo_data"))


HEIGHTS = ("z-50.0", "z+00.0", "z+50.0")


def contents(folder):
    return {path.name: path.read_bytes() for path in sorted(folder.iterdir()) if path.is_file()}


@pytest.fixture
def small(tmp_path):
    """Copy a project of three heights and one bar out of the demonstration."""
    folder = tmp_path / "small"
    for name in ("calibration", "bars"):
        (folder / name).mkdir(parents=True)
    names = [f"calibration/{camera}_{z}.png" for camera in ("left", "right") for z in HEIGHTS]
    names += ["bars/bar0_left.png", "bars/bar0_right.png", "bars/crops.csv"]
    for name in [*names, "bar_across.toml", "plate.toml", "control.csv"]:
        shutil.copy(DEMO / name, folder / name)
    project = folder / "closerange.toml"
    project.write_text(
        """
schema = "closerange.project/1"
[calibration]
target = "plate.toml"
control = "control.csv"
model = "pinhole"
placement_pattern = "_(z.*)$"
images = { left = ["calibration/left_*.png"], right = ["calibration/right_*.png"] }
[[job]]
name = "one bar"
target = "bar_across.toml"
placement_pattern = '^(bar\\d+)_'
images = { left = ["bars/*_left.png"], right = ["bars/*_right.png"] }
crops = "bars/crops.csv"
""",
        encoding="utf-8",
    )
    return project


def test_overwriting_replaces_all_and_repeats_every_byte(small):
    first = run(small)
    assert first.folder == small.parent / "results"
    assert first.jobs[0].result is None
    before = contents(first.folder)
    (first.folder / "left-over.txt").touch()
    second = run(small, overwrite=True)
    after = contents(second.folder)
    assert sorted(after) == sorted(before)
    for name in ("rig.json", "one-bar-points.csv", "one-bar-positions.csv", "run.json"):
        assert after[name] == before[name], name
    assert not [path for path in small.parent.iterdir() if path.name.startswith(".")]


@pytest.mark.parametrize("overwrite", [False, True])
def test_a_foreign_folder_is_left_alone(small, tmp_path, overwrite):
    foreign = tmp_path / "photographs"
    foreign.mkdir()
    (foreign / "holiday.jpg").write_bytes(b"x")
    with pytest.raises(FileError, match="photographs"):
        run(small, output=foreign, overwrite=overwrite)
    assert contents(foreign) == {"holiday.jpg": b"x"}


def test_a_file_in_the_place_of_the_folder(small, tmp_path):
    (tmp_path / "results").write_text("x", encoding="utf-8")
    with pytest.raises(FileError, match="is a file"):
        run(small, output=tmp_path / "results", overwrite=True)


def test_the_folder_of_the_project_is_never_replaced(small):
    (small.parent / "run.json").write_text("{}", encoding="utf-8")
    before = sorted(small.parent.rglob("*"))
    for folder in (small.parent, small.parent.parent):
        with pytest.raises(FileError, match="the project lies in it"):
            run(small, output=folder, overwrite=True)
    assert sorted(small.parent.rglob("*")) == before


def test_a_run_that_fails_writes_nothing(small):
    (small.parent / "control.csv").write_text("point,x_mm\n", encoding="utf-8")
    with pytest.raises(InputError):
        run(small)
    assert not (small.parent / "results").exists()
