"""What `closerange.features` offers by name, and what asking for it costs."""

from __future__ import annotations

import inspect
import subprocess
import sys

import pytest

import closerange.features as room


@pytest.mark.parametrize("name", room.__all__)
def test_every_name_loads_and_is_documented(name):
    value = getattr(room, name)
    assert value.__name__ == name
    assert inspect.getdoc(value)


def test_names_are_sorted_and_none_hides_a_module():
    assert dir(room) == room.__all__ == sorted(room._HOME)
    assert not set(room.__all__) & set(room._HOME.values())


def test_an_unknown_name_is_an_attribute_error():
    with pytest.raises(AttributeError, match="no attribute 'frobnicate'"):
        room.frobnicate  # noqa: B018


def test_importing_the_room_loads_no_library():
    code = "import sys, closerange.features; print(' '.join(sys.modules))"
    run = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert not set(run.stdout.split()) & {"numpy", "cv2", "scipy"}
