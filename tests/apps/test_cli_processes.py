"""The command line as a process: examples that can be pasted, closed pipes, odd names, Ctrl-C."""

from __future__ import annotations

import json
import os
import shutil
import signal
import subprocess
import sys
import time
from importlib.resources import files
from pathlib import Path

import numpy as np
import pytest

from closerange.apps.cli.examples import line
from closerange.rig.rig_file import read_rig

DEMO = Path(str(files("closerange.workflows") / "demo_data"))
IMAGE = DEMO / "calibration/left_z+00.0.png"
PROGRAM = f'{sys.executable} -c "from closerange.apps.cli import main; main()"'
needs_shell = pytest.mark.skipif(shutil.which("bash") is None, reason="needs a shell to paste into")


def shell(text, folder, **environment):
    """Paste text into a shell in which `closerange` is this program."""
    script = f'set -o pipefail\ncloserange() {{ {PROGRAM} "$@"; }}\n{text}\n'
    return subprocess.run(
        ["bash", "-c", script], cwd=folder, capture_output=True, text=True, check=False,
        encoding="utf-8", errors="backslashreplace", env={**os.environ, **environment},
    )  # fmt: skip


@pytest.fixture(scope="module")
def shown(tmp_path_factory):
    """Run the demonstration as the first example says."""
    folder = tmp_path_factory.mktemp("newcomer")
    done = shell(line("demo"), folder)
    assert done.returncode == 0, done.stderr
    return folder


@needs_shell
@pytest.mark.parametrize(
    ("verb", "written"),
    [
        ("detect", ["left.csv"]),
        ("calibrate", ["rig.json"]),
        ("match", ["matches.csv"]),
        ("volume", ["volume.svg"]),
        ("measure", ["positions.csv"]),
        ("verify", ["result.json", "report.html"]),
        ("run", ["closerange-demo/inputs/results/report.html"]),
        ("report", ["report.html"]),
        ("shapes teach", ["shapes.json"]),
        ("shapes find", ["shape-points.csv"]),
    ],
)
def test_examples_of_the_helps_work_when_pasted_after_the_demo(shown, verb, written):
    text = shell(f"closerange {verb} --help", shown).stdout
    example = text.partition("Example (after closerange demo):")[2]
    if verb == "shapes find":
        shell(line("shapes teach"), shown)
    for name in written:
        (shown / name).unlink(missing_ok=True)
    done = shell(example, shown)
    assert done.returncode == 0, done.stderr
    assert done.stderr == ""
    for name in written:
        assert (shown / name).stat().st_size > 100


@needs_shell
def test_inputs_of_the_demonstration_give_its_rig_again(shown):
    """The example of `calibrate` leads to the cameras that the demonstration wrote."""
    options = "--volume -50 -50 -50 50 50 50"
    done = shell(f"{line('calibrate')} {options}", shown)
    assert done.returncode == 0, done.stderr
    again, before = read_rig(shown / "rig.json"), read_rig(shown / "closerange-demo/rig.json")
    for one, other in zip(again.cameras, before.cameras, strict=True):
        np.testing.assert_array_equal(one.matrix_px, other.matrix_px)


def detection(output, image=IMAGE):
    return f"closerange detect '{image}' --target '{DEMO / 'plate.toml'}' --camera left -o {output}"


@needs_shell
@pytest.mark.parametrize("reader", ["head -c 10", "true"])
@pytest.mark.parametrize("more", ["", "--json"])
def test_a_reader_that_goes_away_does_no_harm(tmp_path, reader, more):
    """The table is written, the work's exit code stays, and nobody sees a traceback."""
    done = shell(f"{detection('points.csv')} {more} | {reader}", tmp_path)
    assert done.returncode == 0, done.stderr
    assert "Traceback" not in done.stderr
    assert "Broken" not in done.stderr
    assert (tmp_path / "points.csv").is_file()


@needs_shell
@pytest.mark.parametrize("command", ["closerange --help", "closerange detct --json"])
def test_helps_and_errors_into_a_closed_pipe(tmp_path, command):
    done = shell(f"{command} | true", tmp_path)
    assert "Traceback" not in done.stderr
    assert "Broken" not in done.stderr


@needs_shell
@pytest.mark.parametrize("more", ["", "--json"])
@pytest.mark.parametrize("name", ["plätze.csv", "点.csv", "$'\\xff.csv'"])
def test_names_that_the_terminal_cannot_show(tmp_path, name, more):
    done = shell(f"{detection(name)} {more}", tmp_path, PYTHONIOENCODING="ascii")
    assert done.returncode == 0, done.stderr
    assert "csv" in done.stdout
    assert len(list(tmp_path.iterdir())) == 1


# the program as it is, except that it makes a mark when it finds the 2nd target: then it works
MARKED = """
import signal, sys
from pathlib import Path
signal.signal(signal.SIGINT, signal.default_int_handler)  # background jobs of shells ignore it
from closerange.apps.cli import main
import closerange.workflows.detect as detect
real, calls = detect.detect_target, []
def marked(*args, **kwargs):
    calls.append(1)
    if len(calls) == 2:
        Path("working").touch()
    return real(*args, **kwargs)
detect.detect_target = marked
main()
"""


def test_ctrl_c_stops_detection_and_keeps_the_older_table(tmp_path):
    older = tmp_path / "points.csv"
    older.write_text("older\n", encoding="utf-8")
    images = sorted((DEMO / "calibration").glob("left_*.png"))
    process = subprocess.Popen(
        [sys.executable, "-c", MARKED, "detect", *map(str, images), "--target",
         str(DEMO / "plate.toml"), "--camera", "left", "-o", "points.csv", "--json"],
        cwd=tmp_path, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
    )  # fmt: skip
    deadline = time.monotonic() + 60
    while not (tmp_path / "working").exists() and process.poll() is None:
        assert time.monotonic() < deadline
        time.sleep(0.01)
    process.send_signal(signal.SIGINT)
    stdout, stderr = process.communicate(timeout=60)
    assert process.returncode == 130, stderr
    assert "interrupted: nothing was written" in stderr
    assert json.loads(stdout)["error"]["exit_code"] == 130
    assert sorted(path.name for path in tmp_path.iterdir()) == ["points.csv", "working"]
    assert older.read_text(encoding="utf-8") == "older\n"
