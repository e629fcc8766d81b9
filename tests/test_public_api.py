"""What `import closerange` offers, and what it costs."""

from __future__ import annotations

import inspect
import subprocess
import sys

import pytest

import closerange


@pytest.mark.parametrize("name", closerange.__all__)
def test_every_name_loads_and_is_documented(name):
    value = getattr(closerange, name)
    if name == "__version__":
        assert value.count(".") == 2
        return
    assert inspect.getdoc(value)
    if inspect.isfunction(value) or inspect.isclass(value):
        assert value.__name__ == name


def test_names_are_sorted_and_listed():
    assert dir(closerange) == sorted(closerange.__all__)
    assert len(set(closerange.__all__)) == len(closerange.__all__)


def test_an_unknown_name_is_an_attribute_error():
    with pytest.raises(AttributeError, match="no attribute 'frobnicate'"):
        closerange.frobnicate  # noqa: B018
    assert not hasattr(closerange, "numpy")


def test_a_verb_stays_a_function_after_its_room_was_imported():
    """A submodule of the same name would hide it."""
    for verb in ("calibrate", "detect", "measure", "verify"):
        __import__(f"closerange.workflows.{verb}")
        assert callable(getattr(closerange, verb))


def modules_after(statement):
    code = f"import sys; {statement}; print(' '.join(sys.modules))"
    run = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    return set(run.stdout.split())


def test_importing_the_package_loads_no_library():
    loaded = modules_after("import closerange; dir(closerange); closerange.__version__")
    assert not loaded & {"numpy", "cv2", "scipy", "typer", "rich", "pydantic", "jinja2"}


def test_reading_a_rig_and_measuring_need_no_door():
    loaded = modules_after("from closerange import read_rig, read_points, measure")
    assert "numpy" in loaded
    assert not loaded & {"typer", "rich", "jinja2", "matplotlib"}
