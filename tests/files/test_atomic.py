"""Files are written whole or not at all."""

from __future__ import annotations

import errno
import os

import pytest

from closerange.errors import FileError
from closerange.files.atomic import write_bytes, write_text

posix = pytest.mark.skipif(os.name != "posix", reason="rights are POSIX rights")


def names(folder):
    return sorted(path.name for path in folder.iterdir())


def test_new_content_replaces_old(tmp_path):
    path = tmp_path / "rig.json"
    write_bytes(path, b"a much longer old content")
    write_bytes(path, b"new")
    assert path.read_bytes() == b"new"
    assert names(tmp_path) == ["rig.json"]


def test_text_keeps_line_ends_and_unicode(tmp_path):
    write_text(tmp_path / "t.csv", "Grüße\r\nµm\n")
    assert (tmp_path / "t.csv").read_bytes() == "Grüße\r\nµm\n".encode()


def test_half_a_character_from_a_badly_encoded_file_name(tmp_path):
    with pytest.raises(FileError, match="cannot be written as UTF-8"):
        write_text(tmp_path / "t.csv", "placement,\udce4\n")
    assert names(tmp_path) == []


def test_missing_folder(tmp_path):
    with pytest.raises(FileError, match="cannot be written") as caught:
        write_bytes(tmp_path / "none" / "t.csv", b"x")
    assert "none" in caught.value.message
    assert "folder exists" in caught.value.remedy
    assert names(tmp_path) == []


def test_a_file_as_folder(tmp_path):
    (tmp_path / "file").write_bytes(b"x")
    with pytest.raises(FileError):
        write_bytes(tmp_path / "file" / "t.csv", b"x")


def test_target_is_a_folder(tmp_path):
    (tmp_path / "out").mkdir()
    with pytest.raises(FileError, match="is a folder"):
        write_bytes(tmp_path / "out", b"x")
    assert names(tmp_path) == ["out"]


@pytest.mark.parametrize("existed", [True, False])
def test_full_disk_leaves_the_old_file_and_nothing_else(tmp_path, monkeypatch, existed):
    path = tmp_path / "t.csv"
    if existed:
        path.write_bytes(b"old")

    def full(_handle):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(os, "fsync", full)
    with pytest.raises(FileError, match="No space left") as caught:
        write_bytes(path, b"new")
    assert "has room" in caught.value.remedy
    assert names(tmp_path) == (["t.csv"] if existed else [])
    assert not existed or path.read_bytes() == b"old"


@pytest.mark.parametrize("interruption", [KeyboardInterrupt, MemoryError, SystemExit])
def test_an_interruption_leaves_the_old_file_and_nothing_else(tmp_path, monkeypatch, interruption):
    path = tmp_path / "t.csv"
    path.write_bytes(b"old")

    def stop(_handle):
        raise interruption

    monkeypatch.setattr(os, "fsync", stop)
    with pytest.raises(interruption):
        write_bytes(path, b"new")
    assert path.read_bytes() == b"old"
    assert names(tmp_path) == ["t.csv"]


@posix
def test_rights_of_a_replaced_file_are_kept(tmp_path):
    path = tmp_path / "t.csv"
    path.write_bytes(b"old")
    path.chmod(0o640)
    write_bytes(path, b"new")
    assert path.stat().st_mode & 0o777 == 0o640


@posix
def test_a_new_file_has_the_rights_that_the_umask_leaves(tmp_path):
    before = os.umask(0o027)
    try:
        write_bytes(tmp_path / "t.csv", b"new")
        assert os.umask(0o027) == 0o027  # left as it was
    finally:
        os.umask(before)
    assert (tmp_path / "t.csv").stat().st_mode & 0o777 == 0o640


@pytest.mark.parametrize("name", ["x" * 300, "bad\0name"])
def test_impossible_names(tmp_path, name):
    with pytest.raises(FileError, match="cannot be written"):
        write_bytes(tmp_path / name, b"x")
    assert names(tmp_path) == []
