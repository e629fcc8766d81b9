"""Reading: only regular files, only up to a size, only UTF-8."""

from __future__ import annotations

import hashlib
import os

import pytest

from closerange.errors import FileError
from closerange.files.limited import read_limited, read_text, sha256


def test_content_up_to_the_limit(tmp_path):
    path = tmp_path / "f"
    path.write_bytes(b"12345")
    assert read_limited(path, 5) == b"12345"
    with pytest.raises(FileError, match="5 bytes, the limit is 4"):
        read_limited(path, 4)


def test_a_giant_file_is_refused_before_it_is_read(tmp_path):
    path = tmp_path / "f"
    with path.open("wb") as stream:
        stream.truncate(2**40)  # sparse: a terabyte that takes no room
    with pytest.raises(FileError, match="limit is 1000"):
        read_limited(path, 1000)


@pytest.mark.parametrize(
    ("name", "text"), [("none", "no such file"), ("bad\0name", "null"), ("x" * 300, "too long")]
)
def test_no_file(tmp_path, name, text):
    with pytest.raises(FileError, match=text):
        read_limited(tmp_path / name, 10)


def test_folder(tmp_path):
    with pytest.raises(FileError):
        read_limited(tmp_path, 10)


def test_empty(tmp_path):
    (tmp_path / "f").touch()
    with pytest.raises(FileError, match="empty"):
        read_limited(tmp_path / "f", 10)


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="needs named pipes")
def test_a_named_pipe_is_refused_without_waiting(tmp_path):
    os.mkfifo(tmp_path / "pipe")
    with pytest.raises(FileError, match="not a regular file"):
        read_limited(tmp_path / "pipe", 10)


@pytest.mark.skipif(os.name != "posix", reason="needs device files")
def test_a_device_is_refused():
    with pytest.raises(FileError, match="not a regular file"):
        read_limited("/dev/zero", 10)


def test_a_link_is_followed(tmp_path):
    (tmp_path / "f").write_bytes(b"x")
    (tmp_path / "link").symlink_to(tmp_path / "f")
    assert read_limited(tmp_path / "link", 10) == b"x"


def test_text_with_and_without_byte_order_mark(tmp_path):
    for mark in (b"", b"\xef\xbb\xbf"):
        (tmp_path / "f").write_bytes(mark + "µm\r\n".encode())
        assert read_text(tmp_path / "f") == "µm\r\n"


def test_other_encodings_are_refused(tmp_path):
    (tmp_path / "f").write_bytes("Größe".encode("latin-1"))
    with pytest.raises(FileError, match="not UTF-8 text \\(byte 2\\)"):
        read_text(tmp_path / "f")


def test_sha256(tmp_path):
    (tmp_path / "f").write_bytes(b"abc")
    assert sha256(tmp_path / "f") == hashlib.sha256(b"abc").hexdigest()
    with pytest.raises(FileError):
        sha256(tmp_path / "none")
    with pytest.raises(FileError):
        sha256(tmp_path)
    with pytest.raises(FileError):
        sha256(tmp_path / "bad\0name")
