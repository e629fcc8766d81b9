"""Bad rig, target and points files: items 45 to 49 of the list of bad inputs.

Each test is named after its item and feeds the files themselves.
"""

from __future__ import annotations

import json
import os
import pickle
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


@pytest.mark.parametrize("schema", ["closerange.rig/3", "closerange.result/1", "", None, 1])
def test_item_47_unknown_schema(tables, refused, schema):
    edit(tables, lambda document: document.update(schema=schema))
    refused(tables.measure, 2, "rig.json", "schema", "closerange.rig/2")


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
    "no noise": (lambda d: d.update(noise_px=0), "noise_px"),
    "unknown noise": (lambda d: d.update(noise_px=None), "noise_px"),
    "unknown covariance": (lambda d: d["parameter_cov"][0].__setitem__(0, None), "parameter_cov"),
    "noise as a truth value": (lambda d: d.update(noise_px=True), "noise_px"),
    "unknown flag": (lambda d: d["residuals"]["rows"][0].__setitem__(11, "odd"), "residuals"),
    "short residual row": (lambda d: d["residuals"]["rows"][0].pop(), "residuals"),
}


@pytest.mark.parametrize("what", BAD_CAMERAS)
def test_item_48_rig_with_impossible_content(tables, refused, what):
    change, words = BAD_CAMERAS[what]
    edit(tables, change)
    refused(tables.measure, 2, "rig.json", words)


def test_item_48_what_an_untrusted_rig_of_unknown_uncertainty_measures_is_marked(
    tables, run, tmp_path
):
    """Positions without covariance: no traceback, no row without a flag, exit code 1."""

    def unknown(document):
        document["trust"]["verdict"] = "untrustworthy"
        document["noise_px"] = None
        document["parameter_cov"][0][0] = None

    edit(tables, unknown)
    outcome = run(*tables.measure, "-o", tmp_path / "positions.csv")
    assert outcome.code == 1
    rows = (tmp_path / "positions.csv").read_text(encoding="utf-8").splitlines()
    assert len(rows) == 64
    for row in rows[1:]:
        assert row.endswith("untrusted")
        assert ",,,,,," in row  # no covariance
        float(row.split(",")[2])


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


def test_output_into_a_folder_that_is_missing(tables, run):
    outcome = run(*tables.measure, "-o", tables.folder / "missing" / "positions.csv")
    assert outcome.code == 2
    assert "remedy: " in outcome.stderr
    assert not (tables.folder / "missing").exists()
