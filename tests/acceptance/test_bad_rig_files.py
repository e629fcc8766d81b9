"""Bad rig, target, points and project files: items 45 to 49 and 51, and Ctrl-C.

Each test is named after its item and feeds the files themselves.
"""

from __future__ import annotations

import errno
import json
import os
import pickle
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest


class Bomb:
    """Writes a file when unpickled."""

    def __init__(self, path: Path) -> None:
        self.path = path

    def __reduce__(self):
        return (Path.write_text, (self.path, "unpickled"))


def pickled(path, fuse):
    path.write_bytes(pickle.dumps(Bomb(fuse)))


def pickled_as_text(path, fuse):
    path.write_bytes(pickle.dumps(Bomb(fuse), protocol=0))


def yaml_with_tags(path, fuse):
    path.write_text(
        f"!!python/object/apply:os.system ['touch {fuse}']\nrows: 3\n", encoding="utf-8"
    )


def opencv_yaml(path, _fuse):
    path.write_text("%YAML:1.0\n---\nm: !!opencv-matrix\n   rows: 3\n", encoding="utf-8")


def npz_of_objects(path, fuse):
    with path.open("wb") as stream:
        np.savez(stream, rig=np.array([Bomb(fuse)], dtype=object))


EXECUTABLE = [pickled, pickled_as_text, yaml_with_tags, opencv_yaml, npz_of_objects]


def spoil(tables, name):
    """Return the file of a name and the arguments of the verb that reads it."""
    path = tables.folder / name
    if name == "rig.json":
        return path, tables.measure
    if name == "plate.toml":
        return path, ["detect", "image.png", "--target", str(path), "--camera", "left"]
    return path, tables.calibrate


@pytest.mark.parametrize("name", ["rig.json", "plate.toml", "left.csv", "control.csv"])
@pytest.mark.parametrize("write", EXECUTABLE)
def test_item_45_files_that_could_execute_are_not_read(tables, refused, tmp_path, write, name):
    fuse = tmp_path / "executed"
    path, args = spoil(tables, name)
    write(path, fuse)
    refused(args, 2, name)
    assert not fuse.exists()


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("[" * 100_000, "32 levels"),
        ('{"a":' * 40 + "1" + "}" * 40, "32 levels"),
        ('{"schema": "closerange.rig/1", "schema": "closerange.rig/1"}', "'schema' appears twice"),
        ('{"schema": "closerange.rig/1", "noise_px": 1e999}', "1e999"),
        ('{"schema": "closerange.rig/1", "noise_px": NaN}', "NaN"),
        ('{"schema": "closerange.rig/1", "noise_px": -Infinity}', "Infinity"),
        ('{"schema": "closerange.rig/1", "dof": 1' + "0" * 5000 + "}", "digits"),
        ('{"schema": "closerange.rig/1"', "line 1"),
        ("[]", "schema"),
        ("3", "schema"),
        ("null", "schema"),
        ('"closerange.rig/1"', "schema"),
        ("{}", "schema"),
    ],
)
def test_item_46_json_outside_of_the_dialect(tables, refused, text, words):
    tables.rig.write_text(text, encoding="utf-8")
    refused(tables.measure, 2, "rig.json", words)


def test_item_46_key_twice_deep_inside(tables, refused):
    text = tables.rig.read_text(encoding="utf-8")
    changed = text.replace('"k1": ', '"k1": 0.5, "k1": ', 1)
    assert changed != text
    tables.rig.write_text(changed, encoding="utf-8")
    refused(tables.measure, 2, "rig.json", "'k1' appears twice")


def test_item_46_rig_file_too_large(tables, refused):
    with tables.rig.open("r+b") as stream:
        stream.truncate(65 * 2**20)  # sparse: takes no room
    refused(tables.measure, 2, "rig.json", str(65 * 2**20), str(64 * 2**20))


def test_item_46_target_file_too_large(tables, refused):
    path, args = spoil(tables, "plate.toml")
    with path.open("wb") as stream:
        stream.truncate(65 * 2**20)
    refused(args, 2, "plate.toml", "limit")


@pytest.mark.parametrize("schema", ["closerange.rig/2", "closerange.result/1", "", None, 1])
def test_item_47_unknown_schema(tables, refused, schema):
    edit(tables, lambda document: document.update(schema=schema))
    refused(tables.measure, 2, "rig.json", "schema", "closerange.rig/1")


def test_item_47_unknown_kind_of_target(tables, refused):
    path, args = spoil(tables, "plate.toml")
    path.write_text('kind = "hexagons"\nrows = 3\ncolumns = 3\n', encoding="utf-8")
    refused(args, 2, "plate.toml", "hexagons", "disc-grid")


def edit(tables, change):
    """Change the rig file's document in place."""
    document = json.loads(tables.rig.read_text(encoding="utf-8"))
    change(document)
    tables.rig.write_text(json.dumps(document), encoding="utf-8")


def camera(key, value):
    """Return a change of one entry of the first camera."""
    return lambda document: document["cameras"][0].update({key: value})


MIRROR = [[1, 0, 0], [0, 1, 0], [0, 0, -1]]
BAD_CAMERAS = {
    "mirrored rotation": (
        lambda d: d["cameras"][0]["camera_from_world"].update(rotation=MIRROR),
        "rotation",
    ),
    "stretched rotation": (
        lambda d: d["cameras"][0]["camera_from_world"].update(
            rotation=[[2, 0, 0], [0, 1, 0], [0, 0, 0.5]]
        ),
        "rotation",
    ),
    "rotation of zeros": (
        lambda d: d["cameras"][0]["camera_from_world"].update(rotation=[[0] * 3] * 3),
        "rotation",
    ),
    "rotation of two rows": (
        lambda d: d["cameras"][0]["camera_from_world"]["rotation"].pop(),
        "rotation",
    ),
    "translation of two numbers": (
        lambda d: d["cameras"][0]["camera_from_world"]["translation_mm"].pop(),
        "translation_mm",
    ),
    "matrix of 3 x 4": (camera("matrix_px", [[1, 0, 0, 0]] * 3), "matrix_px"),
    "negative focal length": (camera("matrix_px", [[-1, 0, 9], [0, 1, 9], [0, 0, 1]]), "matrix_px"),
    "matrix of texts": (camera("matrix_px", [["1", "0", "9"]] * 3), "matrix_px"),
    "matrix with null": (camera("matrix_px", [[None, 0, 9], [0, 1, 9], [0, 0, 1]]), "matrix_px"),
    "size of three": (camera("size_px", [640, 512, 3]), "size_px"),
    "size of zero": (camera("size_px", [0, 512]), "size_px"),
    "size of fractions": (camera("size_px", [640.5, 512]), "size_px"),
    "no name": (camera("name", ""), "name"),
    "the other camera's name": (camera("name", "right"), "right"),
    "unknown lens": (camera("distortion", {"model": "fisheye"}), "fisheye"),
    "unknown key": (camera("gain", 2), "gain"),
    "no cameras": (lambda d: d.update(cameras=[]), "cameras"),
    "volume upside down": (lambda d: d["volume_mm"].reverse(), "volume_mm"),
    "volume of one corner": (lambda d: d["volume_mm"].pop(), "volume_mm"),
    "covariance too small": (lambda d: d["parameter_cov"].pop(), "parameter_cov"),
    "negative variance": (lambda d: d["parameter_cov"][0].__setitem__(0, -1.0), "parameter_cov"),
    "asymmetric covariance": (lambda d: d["parameter_cov"][0].__setitem__(1, 9.0), "parameter_cov"),
    "unknown parameter": (lambda d: d["parameters"].__setitem__(0, "left.zoom"), "parameters"),
    "unknown verdict": (lambda d: d["trust"].update(verdict="excellent"), "trust"),
    "negative noise": (lambda d: d.update(noise_px=-0.1), "noise_px"),
    "noise as a truth value": (lambda d: d.update(noise_px=True), "noise_px"),
    "unknown flag": (lambda d: d["residuals"]["rows"][0].__setitem__(11, "odd"), "residuals"),
    "short residual row": (lambda d: d["residuals"]["rows"][0].pop(), "residuals"),
}


@pytest.mark.parametrize("what", BAD_CAMERAS)
def test_item_48_rig_with_impossible_content(tables, refused, what):
    change, words = BAD_CAMERAS[what]
    edit(tables, change)
    refused(tables.measure, 2, "rig.json", words)


def test_item_48_verify_reads_the_rig_as_strictly(tables, run, refused, tmp_path):
    positions = tmp_path / "positions.csv"
    assert run(*tables.measure, "-o", positions).code == 0
    edit(tables, BAD_CAMERAS["mirrored rotation"][0])
    args = ["verify", "control", positions, "--truth", tables.control, "--rig", tables.rig]
    refused(args, 2, "rig.json", "rotation")


@pytest.mark.parametrize("special", ["/dev/zero", "/dev/null", "pipe", "folder"])
def test_item_49_rig_that_is_a_device_or_a_pipe(tables, refused, special):
    tables.rig.unlink()
    if special == "pipe":
        os.mkfifo(tables.rig)
    elif special == "folder":
        tables.rig.mkdir()
    else:
        tables.rig.symlink_to(special)
    refused(tables.measure, 2, "rig.json")


@pytest.fixture
def project(demo_data, tmp_path):
    """Copy two placements of the demo's calibration as a project of its own, without jobs."""
    folder = tmp_path / "project"
    (folder / "calibration").mkdir(parents=True)
    for image in (demo_data / "calibration").glob("*_z?50.0.png"):
        shutil.copy(image, folder / "calibration")
    for name in ("plate.toml", "control.csv"):
        shutil.copy(demo_data / name, folder)
    text = (demo_data / "closerange.toml").read_text(encoding="utf-8")
    (folder / "closerange.toml").write_text(text[: text.index("[[job]]")], encoding="utf-8")
    return folder


def without_parts(folder):
    """Name everything in a folder, hidden files too."""
    return sorted(path.name for path in folder.iterdir())


def run_refused(run, project, code, *words):
    """Run a project that must be refused and leave its folder as it was."""
    before = without_parts(project), without_parts(project.parent)
    outcome = run("run", project / "closerange.toml")
    assert outcome.code == code, outcome.stderr
    assert "error: " in outcome.stderr
    assert "\nremedy: " in outcome.stderr
    for word in words:
        assert word in outcome.stderr
    assert (without_parts(project), without_parts(project.parent)) == before


UNSAFE = ["../outside.csv", "/etc/passwd", "a/../../outside.csv", "link.csv", "linked/outside.csv"]


@pytest.mark.parametrize("unsafe", UNSAFE)
@pytest.mark.parametrize("key", ["target", "control", "crops", "images", "folder"])
def test_item_49_paths_that_leave_the_project(project, run, unsafe, key):
    outside = project.parent / "outside.csv"
    outside.write_text("secret\n", encoding="utf-8")
    (project / "link.csv").symlink_to(outside)
    (project / "linked").symlink_to(project.parent, target_is_directory=True)
    path = project / "closerange.toml"
    text = path.read_text(encoding="utf-8")
    changed = {
        "target": text.replace('"plate.toml"', f'"{unsafe}"'),
        "control": text.replace('"control.csv"', f'"{unsafe}"'),
        "crops": text.replace("[calibration]", f'[calibration]\ncrops = "{unsafe}"'),
        "images": text.replace("calibration/left_*.png", unsafe),
        "folder": text + f'\n[outputs]\nfolder = "{unsafe}"\n',
    }[key]
    assert changed != text
    path.write_text(changed, encoding="utf-8")
    run_refused(run, project, 2, unsafe, "project")
    assert outside.read_text(encoding="utf-8") == "secret\n"


@pytest.mark.parametrize("odd", ["\\u0000", "loop", ".", "calibration", "/", "~/x.csv", "$HOME/x"])
@pytest.mark.parametrize("key", ["target", "control", "images"])
def test_item_49_paths_that_are_none(project, run, odd, key):
    (project / "loop").symlink_to(project / "loop")
    path = project / "closerange.toml"
    text = path.read_text(encoding="utf-8")
    old = {"target": "plate.toml", "control": "control.csv", "images": "calibration/left_*.png"}
    path.write_text(text.replace(old[key], odd), encoding="utf-8")
    run_refused(run, project, 2)


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ("closerange.project/1", "closerange.project/9", "schema"),
        ('target = "plate.toml"', "", "target"),
        ('target = "plate.toml"', "target = 3", "target"),
        ('target = "plate.toml"', 'target = "plate.toml"\ncolour = "red"', "colour"),
        ("[calibration]", "[calibration", "closerange.toml"),
        ("_(z.*)$", "_(z.*", "regular expression"),
        ("calibration/left_*", "calibration/front_*", "front_"),
    ],
)
def test_item_47_malformed_project(project, run, old, new, words):
    path = project / "closerange.toml"
    text = path.read_text(encoding="utf-8")
    assert old in text
    path.write_text(text.replace(old, new, 1), encoding="utf-8")
    run_refused(run, project, 2, words)


def test_a_folder_that_is_no_result_is_never_replaced(project, run):
    results = project / "results"
    results.mkdir()
    (results / "thesis.txt").write_text("years of work", encoding="utf-8")
    for options in ([], ["--overwrite"]):
        outcome = run("run", project / "closerange.toml", *options)
        assert outcome.code == 2
        assert "results" in outcome.stderr
        assert without_parts(results) == ["thesis.txt"]


@pytest.mark.parametrize("options", [[], ["--overwrite"]])
def test_results_do_not_replace_the_project(project, run, options):
    (project / "run.json").write_text("{}", encoding="utf-8")
    before = without_parts(project)
    for folder in (project, project.parent):
        outcome = run("run", project / "closerange.toml", "--output", folder, *options)
        assert outcome.code == 2
        assert "the project lies in it" in outcome.stderr
        assert without_parts(project) == before


def test_results_below_a_file(project, run):
    outcome = run("run", project / "closerange.toml", "--output", project / "plate.toml" / "here")
    assert outcome.code == 2
    assert "plate.toml: is a file" in outcome.stderr


def test_refused_run_makes_no_folders_on_the_way(project, run):
    (project / "control.csv").unlink()
    output = project / "new" / "results"
    assert run("run", project / "closerange.toml", "--output", output).code == 2
    assert not (project / "new").exists()


def full_disk(*_args, **_kwargs):
    raise OSError(errno.ENOSPC, "No space left on device")


@pytest.mark.parametrize("call", ["os.fsync", "pathlib.Path.replace"])
@pytest.mark.parametrize("verb", ["calibrate", "measure"])
def test_item_51_full_disk_leaves_no_part(tables, refused, monkeypatch, call, verb):
    monkeypatch.setattr(call, full_disk)
    refused(getattr(tables, verb), 2, "result.out", "No space left on device", "room")


@pytest.mark.parametrize("call", ["os.fsync", "pathlib.Path.replace"])
def test_item_51_full_disk_leaves_no_part_of_a_run(project, run, monkeypatch, call):
    monkeypatch.setattr(call, full_disk)
    run_refused(run, project, 2, "No space left on device")


def test_output_into_a_folder_that_is_missing(tables, run):
    outcome = run(*tables.measure, "-o", tables.folder / "missing" / "positions.csv")
    assert outcome.code == 2
    assert "remedy: " in outcome.stderr
    assert not (tables.folder / "missing").exists()


def interrupt(args, folder, waiting_for):
    """Start the command line as a process of its own and press Ctrl-C while it works."""
    process = subprocess.Popen(
        [sys.executable, "-c", SLOW, *args],
        cwd=folder,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )
    deadline = time.monotonic() + 30
    while not waiting_for.exists() and process.poll() is None and time.monotonic() < deadline:
        time.sleep(0.02)
    process.send_signal(signal.SIGINT)
    _, stderr = process.communicate(timeout=60)
    return process.returncode, stderr


# The program as it is, except that it makes a mark when it reads the 3rd image: then it works.
SLOW = """
import signal, sys
from pathlib import Path
signal.signal(signal.SIGINT, signal.default_int_handler)  # background jobs of shells ignore it
from closerange.apps.cli import main
import closerange.workflows.detect as detect
real, calls = detect.detect_target, []
def marked(*args, **kwargs):
    calls.append(1)
    if len(calls) == 3:
        Path("working").touch()
    return real(*args, **kwargs)
detect.detect_target = marked
main()
"""


def test_ctrl_c_stops_the_demo_cleanly(tmp_path):
    code, stderr = interrupt(["demo", "--output", "here"], tmp_path, tmp_path / "working")
    assert code == 130, stderr
    assert "interrupted: nothing was written" in stderr
    assert "Traceback" not in stderr
    assert without_parts(tmp_path) == ["working"]


def test_ctrl_c_stops_a_run_cleanly_and_keeps_older_results(project, run):
    assert run("run", project / "closerange.toml").code == 0
    before = (project / "results" / "run.json").read_bytes()
    listed = without_parts(project), without_parts(project / "results")
    args = ["run", "closerange.toml", "--overwrite"]
    code, stderr = interrupt(args, project, project / "working")
    assert code == 130, stderr
    assert "Traceback" not in stderr
    (project / "working").unlink()
    assert (without_parts(project), without_parts(project / "results")) == listed
    assert (project / "results" / "run.json").read_bytes() == before


def test_ctrl_c_while_older_results_are_replaced_keeps_them(project, run, monkeypatch):
    """Between the two renames: the older results come back."""
    assert run("run", project / "closerange.toml").code == 0
    before = (project / "results" / "run.json").read_bytes()
    listed = without_parts(project)
    rename = Path.replace

    def pressed(path, target):
        if path.name == "new":
            raise KeyboardInterrupt
        return rename(path, target)

    monkeypatch.setattr(Path, "replace", pressed)
    assert run("run", project / "closerange.toml", "--overwrite").code == 130
    assert without_parts(project) == listed
    assert (project / "results" / "run.json").read_bytes() == before


def test_ctrl_c_while_the_folder_is_written_leaves_nothing(project, run, monkeypatch):
    """The worst moment: some files of the results stand in the folder beside."""

    def pressed(*_args, **_kwargs):
        raise KeyboardInterrupt

    monkeypatch.setattr("closerange.workflows.run.dump_json", pressed)
    before = without_parts(project)
    outcome = run("run", project / "closerange.toml")
    assert outcome.code == 130
    assert "interrupted" in outcome.stderr
    assert without_parts(project) == before
