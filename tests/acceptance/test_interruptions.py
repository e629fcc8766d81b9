"""A full disk and Ctrl-C, item 51 of the list of bad inputs: whole files or none."""

from __future__ import annotations

import errno
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest


def names_in(folder):
    """Name everything in a folder, hidden files too."""
    return sorted(path.name for path in folder.iterdir())


def full_disk(*_args, **_kwargs):
    raise OSError(errno.ENOSPC, "No space left on device")


@pytest.mark.parametrize("call", ["os.fsync", "pathlib.Path.replace"])
@pytest.mark.parametrize("verb", ["calibrate", "measure"])
def test_item_51_full_disk_leaves_no_part(tables, refused, monkeypatch, call, verb):
    monkeypatch.setattr(call, full_disk)
    refused(getattr(tables, verb), 2, "result.out", "No space left on device", "room")


@pytest.mark.parametrize("call", ["os.fsync", "pathlib.Path.replace"])
def test_item_51_full_disk_leaves_no_part_of_a_run(run_refused, monkeypatch, call):
    monkeypatch.setattr(call, full_disk)
    run_refused(2, "No space left on device")


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
    assert names_in(tmp_path) == ["working"]


def test_ctrl_c_stops_a_run_cleanly_and_keeps_older_results(project, run):
    assert run("run", project / "closerange.toml").code == 0
    before = (project / "results" / "run.json").read_bytes()
    listed = names_in(project), names_in(project / "results")
    args = ["run", "closerange.toml", "--overwrite"]
    code, stderr = interrupt(args, project, project / "working")
    assert code == 130, stderr
    assert "Traceback" not in stderr
    (project / "working").unlink()
    assert (names_in(project), names_in(project / "results")) == listed
    assert (project / "results" / "run.json").read_bytes() == before


def test_ctrl_c_while_older_results_are_replaced_keeps_them(project, run, monkeypatch):
    """Between the two renames: the older results come back."""
    assert run("run", project / "closerange.toml").code == 0
    before = (project / "results" / "run.json").read_bytes()
    listed = names_in(project)
    rename = Path.replace

    def pressed(path, target):
        if path.name == "new":
            raise KeyboardInterrupt
        return rename(path, target)

    monkeypatch.setattr(Path, "replace", pressed)
    assert run("run", project / "closerange.toml", "--overwrite").code == 130
    assert names_in(project) == listed
    assert (project / "results" / "run.json").read_bytes() == before


def test_ctrl_c_while_the_folder_is_written_leaves_nothing(project, run, monkeypatch):
    """The worst moment: some files of the results stand in the folder beside."""

    def pressed(*_args, **_kwargs):
        raise KeyboardInterrupt

    monkeypatch.setattr("closerange.workflows.run.dump_json", pressed)
    before = names_in(project)
    outcome = run("run", project / "closerange.toml")
    assert outcome.code == 130
    assert "interrupted" in outcome.stderr
    assert names_in(project) == before
