"""The shapes file: exact round trip, and every damage named."""

from __future__ import annotations

import json

import numpy as np
import pytest
from numpy.testing import assert_array_equal

from closerange.errors import InputError, SchemaError
from closerange.features.shapes import Shape
from closerange.features.shapes_file import read_shapes, write_shapes


def disc(name="disc", **options):
    mask = np.hypot(*np.mgrid[-9:10, -9:10]) < 9.3
    return Shape(name, mask, "dark", 61.25, 0.1 + 0.2, **options)


def test_round_trip_is_exact(tmp_path):
    first = disc()
    second = disc("Ölring | 2", margin_px=1.5, ring_px=4.0, rotation_step_deg=7.5)
    write_shapes([first, second], tmp_path / "shapes.json")
    again = read_shapes(tmp_path / "shapes.json")
    for old, new in zip((first, second), again, strict=True):
        assert_array_equal(old.mask, new.mask)
        for key in ("name", "polarity", "contrast", "sharpness", "margin_px", "ring_px",
                    "rotation_step_deg"):  # fmt: skip
            assert getattr(old, key) == getattr(new, key)


def test_masks_are_cropped_and_frozen():
    shape = Shape("a", np.pad(np.ones((9, 7), bool), 5), "bright", 10.0, 0.9)
    assert shape.mask.shape == (9, 7)
    with pytest.raises(ValueError, match="read-only"):
        shape.mask[0, 0] = False


def document(tmp_path):
    write_shapes([disc()], tmp_path / "shapes.json")
    return json.loads((tmp_path / "shapes.json").read_text())


@pytest.mark.parametrize(
    ("damage", "named"),
    [
        (lambda d: d.update(schema="closerange.shapes/2"), "shapes/2"),
        (lambda d: d.update(extra=1), "extra"),
        (lambda d: d.update(shapes={}), "no list"),
        (lambda d: d.update(shapes=[]), "0 shapes"),
        (lambda d: d["shapes"].append(d["shapes"][0]), "occurs twice"),
        (lambda d: d["shapes"].append(3), r"shapes\[1\]: expected an object"),
        (lambda d: d["shapes"][0].pop("rows"), "missing key 'rows'"),
        (lambda d: d["shapes"][0].update(colour="red"), "unknown key 'colour'"),
        (lambda d: d["shapes"][0].update(name=7), r"name: 7 is no text"),
        (lambda d: d["shapes"][0].update(name=" "), "no name"),
        (lambda d: d["shapes"][0].update(polarity="grey"), "grey"),
        (lambda d: d["shapes"][0].update(margin_px="2"), "margin_px"),
        (lambda d: d["shapes"][0].update(margin_px=True), "margin_px"),
        (lambda d: d["shapes"][0].update(margin_px=10**400), "margin_px"),
        (lambda d: d["shapes"][0].update(margin_px=1e9), "margin_px"),
        (lambda d: d["shapes"][0].update(margin_px=12.0), "nothing of it"),
        (lambda d: d["shapes"][0].update(ring_px=0), "ring_px is 0"),
        (lambda d: d["shapes"][0].update(contrast=-1), "contrast is -1"),
        (lambda d: d["shapes"][0].update(sharpness=11), "sharpness is 11"),
        (lambda d: d["shapes"][0].update(rotation_step_deg=0.1), "rotation_step_deg is 0.1"),
        (lambda d: d["shapes"][0].update(rows=[]), "texts"),
        (lambda d: d["shapes"][0].update(rows=["##", "#"]), r"rows\[1\]"),
        (lambda d: d["shapes"][0].update(rows=["#x#"]), "other signs"),
        (lambda d: d["shapes"][0].update(rows=["..."] * 9), "no pixel"),
        (lambda d: d["shapes"][0].update(rows=[""]), "no row"),
        (lambda d: d["shapes"][0].update(rows=["#"] * 2049), "1 to 2048"),
        (lambda d: d["shapes"][0].update(rows=[5]), "no row"),
    ],
)
def test_damaged_files_are_refused_by_name(tmp_path, damage, named):
    damaged = document(tmp_path)
    damage(damaged)
    path = tmp_path / "damaged.json"
    path.write_text(json.dumps(damaged))
    with pytest.raises(SchemaError, match=named) as refused:
        read_shapes(path)
    assert "damaged.json" in refused.value.message
    assert refused.value.remedy


@pytest.mark.parametrize("text", ["[]", "3", '{"shapes": []}', "{"])
def test_other_documents_are_refused(tmp_path, text):
    path = tmp_path / "other.json"
    path.write_text(text)
    with pytest.raises(SchemaError, match=r"other\.json"):
        read_shapes(path)


def test_nothing_and_twins_are_not_written(tmp_path):
    for shapes in ([], [disc(), disc()]):
        with pytest.raises(InputError):
            write_shapes(shapes, tmp_path / "shapes.json")
    assert not (tmp_path / "shapes.json").exists()
