"""PLY files, read back byte by byte."""

from __future__ import annotations

import numpy as np
import pytest

from closerange.delivery.ply import write_ply

XYZ = np.array([[1.0, 2.5, -3.25], [0.1, 1e-7, 1234.5678], [4.0, 5.0, 6.0]])


def parts(path):
    head, _, body = path.read_bytes().partition(b"end_header\n")
    return head.decode("ascii").splitlines(), body


def test_binary_points_lines_and_colours(tmp_path):
    path = tmp_path / "a.ply"
    write_ply(path, XYZ, std_mm=[0.01, np.nan, 0.03], lines=[[0, 1], [1, 2]], colour_by=XYZ[:, 2])
    head, body = parts(path)
    assert head[:2] == ["ply", "format binary_little_endian 1.0"]
    assert "element vertex 3" in head
    assert "element edge 2" in head
    assert head.index("property float std") < head.index("property uchar red")
    vertex = np.dtype([("p", "<f8", 3), ("std", "<f4"), ("rgb", "u1", 3)])
    table = np.frombuffer(body, vertex, 3)
    np.testing.assert_array_equal(table["p"], XYZ)
    np.testing.assert_allclose(table["std"], [0.01, np.nan, 0.03], rtol=1e-6)
    assert table["rgb"][1].tolist() == [253, 231, 37], "the highest is yellow"
    assert table["rgb"][0].tolist() == [68, 1, 84]
    edges = np.frombuffer(body, "<i4", 4, offset=3 * vertex.itemsize)
    assert edges.tolist() == [0, 1, 1, 2]
    assert len(body) == 3 * vertex.itemsize + 16


def test_text_holds_the_same_numbers(tmp_path):
    path = tmp_path / "a.ply"
    write_ply(path, XYZ, lines=[[2, 0]], text=True)
    head, body = parts(path)
    assert head[1] == "format ascii 1.0"
    rows = body.decode("ascii").splitlines()
    np.testing.assert_array_equal([[float(v) for v in row.split()] for row in rows[:3]], XYZ)
    assert rows[3:] == ["2 0"]


def test_no_points_are_a_file_too(tmp_path):
    path = tmp_path / "a.ply"
    write_ply(path, np.empty((0, 3)), std_mm=[], lines=[], colour_by=[])
    head, body = parts(path)
    assert "element vertex 0" in head
    assert body == b""


def test_one_height_and_unknown_numbers_have_a_colour(tmp_path):
    path = tmp_path / "a.ply"
    write_ply(path, XYZ, colour_by=[5.0, 5.0, np.nan], text=True)
    rows = parts(path)[1].decode("ascii").splitlines()
    assert [row.split()[3:] for row in rows] == [["33", "145", "140"]] * 2 + [["128"] * 3]


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"lines": [[0, 3]]}, "beyond"),
        ({"lines": [[-1, 0]]}, "beyond"),
        ({"std_mm": [1.0]}, "std has shape"),
    ],
)
def test_what_does_not_fit_together_is_refused(tmp_path, options, words):
    with pytest.raises(ValueError, match=words):
        write_ply(tmp_path / "a.ply", XYZ, **options)
    with pytest.raises(ValueError, match="not known"):
        write_ply(tmp_path / "a.ply", [[np.nan, 0, 0]])
    assert not list(tmp_path.iterdir())
