"""Folders in the order in which a person counts."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from closerange.errors import FileError
from closerange.images import list_images, natural_key


def test_image2_comes_before_image10_whatever_the_listing_order(tmp_path):
    names = ["Image1.PNG", "image2.png", "image10.tif", "image10b.jpeg", "image100.bmp"]
    for name in [*reversed(names), ".image3.png", "notes.txt", "points.csv"]:
        (tmp_path / name).write_bytes(b"x")
    (tmp_path / "folder.png").mkdir()
    assert [path.name for path in list_images(tmp_path)] == names


def test_a_file_stands_for_itself_whatever_its_ending(tmp_path):
    path = tmp_path / "cam1.10001"
    path.write_bytes(b"x")
    assert list_images(str(path)) == [path]


def test_folders_without_images_and_missing_paths_are_file_errors(tmp_path):
    (tmp_path / "readme.txt").write_text("x")
    with pytest.raises(FileError, match="no image in this folder"):
        list_images(tmp_path)
    with pytest.raises(FileError, match="No such file"):
        list_images(tmp_path / "nowhere")
    with pytest.raises(FileError):
        list_images("a\0b")


def test_numbers_sort_by_value_and_ties_by_text():
    assert sorted(["a10", "a9", "a010", "a09"], key=natural_key) == ["a09", "a9", "a010", "a10"]
    assert natural_key("x" + "9" * 5000) < natural_key("x1" + "0" * 5000)
    assert natural_key("a²") != natural_key("a2")


@given(st.lists(st.text(st.sampled_from("ab019.-Ä²"), max_size=6), max_size=8))
def test_any_names_have_one_order(names):
    ordered = sorted(names, key=natural_key)
    backwards = names[::-1]
    assert sorted(backwards, key=natural_key) == ordered
    numbers = [name for name in ordered if name.isascii() and name.isdigit()]
    assert [int(name) for name in numbers] == sorted(map(int, numbers))
