"""Teaching and finding shapes, in Python and at the command line."""

from __future__ import annotations

import json

import cv2
import numpy as np
import pytest
from typer.testing import CliRunner

from closerange.apps.cli import app
from closerange.errors import DetectionError, InputError
from closerange.features.points_table import read_points
from closerange.features.shapes_file import read_shapes
from closerange.flags import Flag
from closerange.images import Frame
from closerange.workflows.shapes import find_shapes, teach_shape


def picture(*discs, noise=2.0, seed=0):
    y, x = np.mgrid[0:120, 0:140]
    image = np.full(x.shape, 50.0)
    for cx, cy, radius in discs:
        image += 110 * np.clip(radius - np.hypot(x - cx, y - cy) + 0.5, 0, 1)
    image += np.random.default_rng(seed).normal(0, noise, image.shape)
    return np.clip(np.rint(image), 0, 255).astype(np.uint8)


@pytest.fixture
def folder(tmp_path):
    cv2.imwrite(str(tmp_path / "one.png"), picture((40, 50, 15)))
    cv2.imwrite(str(tmp_path / "many.png"), picture((100, 30, 15), (40, 80, 15), (100, 90, 11)))
    cv2.imwrite(str(tmp_path / "none.png"), picture((60, 60, 11), seed=4))
    return tmp_path


def run(*args, code=0):
    result = CliRunner().invoke(app, ["shapes", *(str(arg) for arg in args)])
    if result.exception is not None and not isinstance(result.exception, SystemExit):
        raise result.exception
    assert result.exit_code == code, result.output
    return result


def test_rows_are_named_so_that_no_false_pair_can_arise(folder):
    shape = teach_shape(folder / "one.png", name="disc", at_px=(40, 50))
    images = [folder / name for name in ("one.png", "many.png", "none.png")]
    steps = []
    points = find_shapes(images, shapes=[shape], camera="left", progress=lambda *a: steps.append(a))
    assert steps == [(1, 3), (2, 3), (3, 3)]
    assert points.point == ("disc", "disc-left-1", "disc-left-2", "disc")
    assert points.placement == ("one", "many", "many", "none")
    assert np.abs(points.xy_px[:3] - [(40, 50), (100, 30), (40, 80)]).max() < 0.5
    assert np.isnan(points.xy_px[3]).all()
    assert list(points.flags) == [0, 0, 0, Flag.not_found]
    assert points.size_px == {"left": (140, 120)}


def test_frames_without_files_work_too():
    frame = Frame("left", picture((40, 50, 15)))
    shape = teach_shape(frame, name="disc", at_px=(40, 50))
    points = find_shapes(frame, shapes=[shape], camera="left", placement="now")
    assert points.keys() == [("left", "now", "", "disc")]


def test_mistakes_are_refused(folder):
    shape = teach_shape(folder / "one.png", name="disc", at_px=(40, 50))
    with pytest.raises(DetectionError, match=r"one\.png.*no region"):
        teach_shape(folder / "one.png", name="table", at_px=(3, 3))
    with pytest.raises(InputError, match="no shape"):
        find_shapes(folder / "one.png", shapes=[], camera="left")
    with pytest.raises(InputError, match="no image"):
        find_shapes([], shapes=[shape], camera="left")
    with pytest.raises(InputError, match="one placement name for 2"):
        find_shapes([folder / "one.png", folder / "none.png"], shapes=[shape], camera="left",
                    placement="p")  # fmt: skip


def test_command_line_from_teaching_to_points(folder):
    shapes, points = folder / "shapes.json", folder / "points.csv"
    taught = json.loads(
        run(
            "teach", folder / "one.png", "--name", "disc", "--at", 40, 50, "-o", shapes, "--json"
        ).stdout
    )
    assert all(29 <= side <= 31 for side in taught["size_px"])
    assert taught["polarity"] == "bright"
    run("teach", folder / "none.png", "--name", "small", "--at", 60, 60, "-o", shapes, "--add")
    assert [shape.name for shape in read_shapes(shapes)] == ["disc", "small"]
    run("teach", folder / "many.png", "--name", "disc", "--at", 40, 80, "-o", shapes, "--add",
        "--rotations", 90, "--margin", 12)  # fmt: skip
    assert [shape.name for shape in read_shapes(shapes)] == ["small", "disc"]
    run("teach", folder / "one.png", "--name", "disc", "--at", 40, 50, "-o", shapes)
    assert [shape.name for shape in read_shapes(shapes)] == ["disc"]  # replaced whole
    found = json.loads(
        run(
            "find",
            folder / "many.png",
            "--shapes",
            shapes,
            "--camera",
            "left",
            "-o",
            points,
            "--json",
        ).stdout
    )
    assert (found["rows"], found["unflagged"]) == (2, 2)
    assert read_points(points).point == ("disc-left-1", "disc-left-2")


def test_command_line_exit_codes(folder):
    shapes, points = folder / "shapes.json", folder / "points.csv"
    run("teach", folder / "one.png", "--name", "disc", "--at", 40, 50, "-o", shapes)
    result = run("find", folder / "none.png", "--shapes", shapes, "--camera", "left",
                 "-o", points, code=1)  # fmt: skip
    assert "none of the shapes" in result.output
    assert read_points(points).flags[0] == Flag.not_found  # written all the same
    run("teach", folder / "one.png", "--name", "x", "--at", 3, 3, "-o", folder / "no.json", code=1)
    assert not (folder / "no.json").exists()
    run("teach", folder / "one.png", "--name", "x", "--at", 300, 3, "-o", shapes, code=2)
    run("teach", folder / "one.png", "--name", "x", "--at", 40, 50, "--polarity", "grey", code=2)
    run("find", folder / "one.png", "--shapes", folder / "one.png", "--camera", "left",
        "-o", points, code=2)  # fmt: skip
    run("teach", folder / "one.png", "--name", "x", "--at", 40, 50, "-o", folder / "one.png",
        code=2)  # fmt: skip
    run(code=2)


@pytest.mark.parametrize("which", ["teach", "find"])
def test_help_has_an_example(which):
    assert f"closerange shapes {which}" in run(which, "--help").output
