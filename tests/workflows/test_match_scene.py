"""Matching in a project, and the pictures of a match in a folder."""

from __future__ import annotations

import json
import shutil
from importlib.resources import files
from pathlib import Path

import cv2
import numpy as np
import pytest
from typer.testing import CliRunner

from closerange.apps.cli.commands import app
from closerange.errors import DetectionError, FileError
from closerange.images.frame import Frame
from closerange.rig.rig_file import write_rig
from closerange.settings import read_settings
from closerange.workflows.match import Wanted, match_images
from closerange.workflows.match_overlay import write_match_pictures
from closerange.workflows.match_scene import centroids_of, match_scene
from closerange.workflows.report import report
from closerange.workflows.run import run

DEMO = Path(str(files("closerange.workflows") / "demo_data"))

PICTURES = ["depth.png", "edge-strength.png", "element.png", "flags.png", "space.png"]


@pytest.fixture(scope="module")
def part(box_scene, tmp_path_factory):
    """Write rig, images and parts of the rendered boxes into a folder."""
    folder = tmp_path_factory.mktemp("boxes")
    write_rig(box_scene.rig, folder / "rig.json")
    for name, pixels in box_scene.images.items():
        cv2.imwrite(str(folder / f"{name}.png"), pixels)
    rows = ["part,shape,x_mm,y_mm,z_mm,size_x_mm,size_y_mm,rotation_deg,height_mm"]
    for number, (x, y, long, wide, turn, top) in enumerate(box_scene.boxes):
        rows.append(f"box{number},box,{x},{y},{top},{long},{wide},{turn},{top + 20}")
    (folder / "parts.csv").write_text("\n".join(rows) + "\n", encoding="utf-8")
    return folder


def named(folder):
    return {name: folder / f"{name}.png" for name in ("left", "right")}


def scene_of(folder, extra="", match="edges"):
    """Match the boxes as a job of a project."""
    text = f"""
schema = "closerange.project/1"
[calibration]
target = "plate.toml"
control = "control.csv"
images = {{ left = ["left.png"], right = ["right.png"] }}
[[job]]
name = "boxes"
match = "{match}"
images = {{ left = ["left.png"], right = ["right.png"] }}
{extra}
"""
    (folder / "closerange.toml").write_text(text, encoding="utf-8")
    settings = read_settings(folder / "closerange.toml")
    return settings, settings.job[0]


def silent(_done, _total):
    return None


def test_edges_of_a_job_are_matched_measured_and_pictured(part, box_scene):
    scene = match_scene(*scene_of(part), box_scene.rig, progress=silent)
    assert scene.matches.clean.sum() > 300
    assert scene.positions.keys() == scene.matches.keys()
    assert [view.source for view in scene.pictures.views] == ["left.png", "right.png"]
    assert scene.pictures.element is not None
    assert scene.pictures.centroids == ()


def test_centroids_of_a_job_are_compared_with_those_of_the_other_view(part, box_scene):
    scene = match_scene(
        *scene_of(part, 'method = "literal"\nelement_px = 101', "centroids"), box_scene.rig,
        progress=silent,
    )  # fmt: skip
    assert scene.matches.point == ("face1", "face2", "face3")
    found = scene.pictures.centroids
    assert scene.pictures.method == "literal"
    apart = [np.linalg.norm(np.subtract(e["expected_px"], e["found_px"])) for e in found]
    assert len(apart) == 3
    assert max(apart) < 1.0  # the thesis' Table 5.3: within a pixel
    top = sorted(box[-1] for box in box_scene.boxes)
    # a pixel is 0.96 mm of height here, and half of one may be lost by rounding
    np.testing.assert_allclose(sorted(scene.positions.xyz_mm[:, 2]), top, atol=0.8)


def test_a_job_matches_one_image_of_each_camera(part, box_scene, tmp_path):
    folder = tmp_path / "two"
    shutil.copytree(part, folder)
    shutil.copy(folder / "left.png", folder / "left2.png")
    settings, _ = scene_of(folder)
    text = (folder / "closerange.toml").read_text(encoding="utf-8")
    start, _, end = text.rpartition('left = ["left.png"]')
    changed = f'{start}left = ["left*.png"]{end}'
    (folder / "closerange.toml").write_text(changed, encoding="utf-8")
    settings = read_settings(folder / "closerange.toml")
    with pytest.raises(FileError, match="job 'boxes': 2 images of camera 'left'"):
        match_scene(settings, settings.job[0], box_scene.rig, progress=silent)


def test_an_image_without_faces_has_no_centroids():
    noise = np.random.default_rng(1).normal(90, 3, (120, 160)).astype(np.uint8)
    with pytest.raises(DetectionError, match="no bright face"):
        centroids_of(Frame("left", noise, None, ""))


def test_a_run_with_a_scene_writes_matches_and_gives_its_report_again(tmp_path):
    folder = tmp_path / "project"
    (folder / "calibration").mkdir(parents=True)
    for camera in ("left", "right"):
        for z in ("z-50.0", "z+00.0", "z+50.0"):
            shutil.copy(DEMO / f"calibration/{camera}_{z}.png", folder / "calibration")
    for name in ("plate.toml", "control.csv"):
        shutil.copy(DEMO / name, folder / name)
    shutil.copytree(DEMO / "blocks", folder / "blocks")
    (folder / "closerange.toml").write_text(
        """
schema = "closerange.project/1"
[calibration]
target = "plate.toml"
control = "control.csv"
model = "brown"
placement_pattern = "_(z.*)$"
images = { left = ["calibration/left_*.png"], right = ["calibration/right_*.png"] }
[[job]]
name = "all blocks"
match = "edges"
images = { left = ["blocks/left.png"], right = ["blocks/right.png"] }
z_mm = [-52.0, 28.0]
verify = "heights"
truth = "blocks/parts.csv"
""",
        encoding="utf-8",
    )
    steps = []
    result = run(folder / "closerange.toml", announce=lambda *step: steps.append(step))
    names = {path.name for path in result.folder.iterdir()}
    assert {"all-blocks-matches.csv", "all-blocks-positions.csv", "all-blocks-result.json"} < names
    assert "all-blocks-points.csv" not in names
    assert ("matching: all blocks", 1, 1) in steps
    assert result.jobs[0].result.max_mm < 0.1  # measured 0.03 mm
    document = json.loads((result.folder / "run.json").read_text(encoding="utf-8"))
    assert "blocks/parts.csv" in document["provenance"]["inputs"]
    assert "blocks/left.png" in document["provenance"]["inputs"]
    html = report(result.folder / "run.json")
    assert html == (result.folder / "report.html").read_text(encoding="utf-8")
    assert str(folder) not in html
    assert "Matches: all blocks" in html


@pytest.fixture(scope="module")
def matched(part, box_scene):
    return match_images(box_scene.rig, named(part), Wanted())


def test_pictures_are_written_into_a_new_folder(part, box_scene, matched, tmp_path):
    written = write_match_pictures(box_scene.rig, named(part), matched, tmp_path / "a" / "b")
    assert sorted(path.name for path in written) == PICTURES
    for path in written:
        pixels = cv2.imread(str(path))
        assert pixels.shape[1] == 1280
        assert pixels.std() > 5


def test_a_folder_with_something_in_it_is_left_alone(part, box_scene, matched, tmp_path):
    (tmp_path / "holiday.jpg").write_bytes(b"x")
    with pytest.raises(FileError, match="exists and is not empty"):
        write_match_pictures(box_scene.rig, named(part), matched, tmp_path)
    with pytest.raises(FileError, match="is a file"):
        write_match_pictures(box_scene.rig, named(part), matched, tmp_path / "holiday.jpg")
    assert [path.name for path in tmp_path.iterdir()] == ["holiday.jpg"]


def call(*arguments):
    return CliRunner().invoke(app, [str(argument) for argument in arguments])


def test_the_command_line_matches_measures_and_verifies_heights(part, tmp_path):
    images = [f"{name}={path}" for name, path in named(part).items()]
    table, folder = tmp_path / "m.csv", tmp_path / "pictures"
    done = call("match", part / "rig.json", *images, "-o", table, "--overlay", folder, "--json")
    assert done.exit_code == 0, done.output
    assert sorted(path.name for path in folder.iterdir()) == PICTURES
    assert len(json.loads(done.stdout)["overlay"]) == 5
    again = call("match", part / "rig.json", *images, "-o", table, "--overlay", folder)
    assert again.exit_code == 2
    assert call("measure", part / "rig.json", table, "-o", tmp_path / "p.csv").exit_code == 0
    done = call(
        "verify", "heights", tmp_path / "p.csv", "--truth", part / "parts.csv",
        "-o", tmp_path / "h.json", "--report", tmp_path / "h.html", "--json",
    )  # fmt: skip
    assert done.exit_code == 0, done.output
    summary = json.loads(done.stdout)
    assert (summary["kind"], summary["heights"], summary["missing"]) == ("heights", 3, [])
    assert summary["max_mm"] < 0.1
    assert "Heights of known parts" in (tmp_path / "h.html").read_text(encoding="utf-8")
    assert report(tmp_path / "h.json").rstrip().endswith("</html>")


def test_parts_are_no_control_points(part, tmp_path):
    (tmp_path / "p.csv").write_text("point,x_mm,y_mm,z_mm\n", encoding="utf-8")
    done = call(
        "verify", "control", tmp_path / "p.csv", "--truth", part / "parts.csv",
        "-o", tmp_path / "h.json",
    )  # fmt: skip
    assert done.exit_code == 2
