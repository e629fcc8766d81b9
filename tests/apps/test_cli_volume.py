"""The verb `volume`, and what `match` says of the volume it used."""

from __future__ import annotations

import json
from xml.etree import ElementTree as ET

import cv2
import numpy as np
import pytest
from typer.testing import CliRunner

import closerange as cr
from closerange.apps.cli import app
from closerange.rig.rig_file import write_rig
from closerange.verification.scenes import SyntheticRig


def command(*args, code=0):
    result = CliRunner().invoke(app, [str(arg) for arg in args])
    if result.exception is not None and not isinstance(result.exception, SystemExit):
        raise result.exception
    assert result.exit_code == code, result.output
    return result


@pytest.fixture
def rig(tmp_path, box_scene):
    write_rig(box_scene.rig, tmp_path / "rig.json")
    return tmp_path / "rig.json"


def test_it_says_what_python_says(rig, box_scene, tmp_path):
    told = json.loads(command("volume", rig, "--plot", tmp_path / "v.svg", "--json").stdout)
    found = cr.volume(box_scene.rig)
    assert told["volume_mm"] == found.volume_mm.tolist()
    assert told["std_mm"] == found.std_mm.tolist()
    assert told["calibrated_mm"] == box_scene.rig.volume_mm.tolist()
    assert (told["cameras"], told["least"], told["depth_axis"]) == (["left", "right"], 2, "Z")
    assert set(told["shared"]) == {"left", "right"}
    assert 0 < told["calibrated_seen"] <= 1
    assert told["plot"] == str(tmp_path / "v.svg")
    root = ET.fromstring((tmp_path / "v.svg").read_text(encoding="utf-8"))  # noqa: S314
    assert root.tag == "{http://www.w3.org/2000/svg}svg"


def test_people_read_a_line_that_can_be_used(rig, tmp_path):
    text = command("volume", rig, "--z", -10, 10, "--plot", tmp_path / "v.PNG").stdout
    line = next(line for line in text.splitlines() if line.startswith("To use it"))
    corners = line.partition("--volume ")[2].split()
    np.testing.assert_allclose([float(corners[2]), float(corners[5])], [-10, 10], atol=0.1)
    assert cv2.imread(str(tmp_path / "v.PNG")).shape[1] == 1280
    assert "Calibrated   X -48 to 48, Y -48 to 48, Z -22 to 26 mm" in text


@pytest.mark.parametrize(
    ("options", "code", "words"),
    [
        (["--least", 3], 2, "3 cameras of 2"),
        (["--margin", 128], 2, "a margin of 128"),
        (["--z", 5, 1], 2, "runs from 5.0 to 1.0"),
        (["--z", "nan", 1], 2, "not finite"),
        (["--z", 5000, 6000], 1, "no place within the limits"),
        (["--plot", "v.jpg"], 2, "v.jpg: a drawing is written as .svg or .png"),
        (["--plot", "nowhere/v.svg"], 2, "there is no folder 'nowhere'"),
        (["--least", "x"], 2, "closerange volume --help"),
    ],
)
def test_refusals(rig, options, code, words):
    result = command("volume", rig, *options, code=code)
    assert words in result.stderr
    assert "remedy: " in result.stderr
    assert result.stdout == ""


def test_other_rigs(rig, box_scene, tmp_path):
    assert "no such file" in command("volume", tmp_path / "none.json", code=2).stderr
    kept = rig.read_bytes()
    assert "destroy the input" in command("volume", rig, "--plot", rig, code=2).stderr
    assert rig.read_bytes() == kept
    one = SyntheticRig("one", box_scene.rig.cameras[:1], box_scene.rig.volume_mm, 0.05).true_rig()
    write_rig(one, tmp_path / "one.json")
    assert "1 camera" in command("volume", tmp_path / "one.json", code=2).stderr


@pytest.mark.parametrize(
    ("options", "origin", "words"),
    [
        ([], "rig", "mm, the rig's; --z or --volume replaces it"),
        (["--z", -22, 26], "stated", "Volume       Z -22 to 26 mm\n"),
    ],
)
def test_match_says_which_volume_it_used(rig, box_scene, tmp_path, options, origin, words):
    images = []
    for name, pixels in box_scene.images.items():
        cv2.imwrite(str(tmp_path / f"{name}.png"), pixels)
        images.append(f"{name}={tmp_path / name}.png")
    result = command("match", rig, *images, *options, "-o", tmp_path / "m.csv", "--json")
    told = json.loads(result.stdout)
    assert told["volume_origin"] == origin
    assert words in result.stderr
