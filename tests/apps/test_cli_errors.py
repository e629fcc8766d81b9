"""What goes wrong at the command line: words for people, one object for machines, no traceback."""

from __future__ import annotations

import json
import os
import re
import warnings
from pathlib import Path

import pytest
from typer.testing import CliRunner

from closerange.apps.cli import app
from closerange.apps.cli.console import DEFECT
from closerange.errors import CloseRangeWarning

# what each verb needs, with files that do not exist; the first letter of a file tells its part
GOOD = {
    "detect": ["i.png", "--target", "t.toml", "--camera", "left", "-o", "o.csv"],
    "calibrate": ["p.csv", "--control", "c.csv", "--image-size", "left=64x48", "-o", "o.json"],
    "measure": ["r.json", "p.csv", "-o", "o.csv"],
    "verify": ["control", "p.csv", "--truth", "t.csv", "-o", "o.json"],
    "run": ["p.toml"],
    "demo": [],
    "report": ["r.json", "-o", "o.html"],
    "shapes teach": ["i.png", "--name", "disc", "--at", "3", "4", "-o", "o.json"],
    "shapes find": ["i.png", "--shapes", "s.json", "--camera", "left", "-o", "o.csv"],
}
WRITES = [verb for verb in GOOD if "-o" in GOOD[verb]]
READS = [verb for verb in GOOD if verb != "demo"]
CONTENT = "what stood here before\n"


@pytest.fixture(autouse=True)
def here(tmp_path, monkeypatch):
    """Work in an empty folder."""
    monkeypatch.chdir(tmp_path)
    return tmp_path


def listing(folder):
    return sorted(path.relative_to(folder).as_posix() for path in folder.rglob("*"))


def wrong(*args, code=2):
    """Run a command that must fail, without and with --json; return the error as an object."""
    before = listing(Path())
    for more in ([], ["--json"]):
        result = CliRunner().invoke(app, [*map(str, args), *more])
        assert isinstance(result.exception, SystemExit), result.exception
        assert result.exit_code == code, result.stderr
        lines = result.stderr.splitlines()
        assert any(line.startswith("error: ") for line in lines)
        assert any(line.startswith("remedy: ") for line in lines)
        assert "Traceback" not in result.stderr
        if not more:
            assert result.stdout == ""
    document = json.loads(result.stdout)
    error = document["error"]
    assert set(error) == {"message", "remedy", "exit_code", "kind"}
    assert error["exit_code"] == code
    assert error["message"]
    assert error["message"].splitlines()[0] in result.stderr
    assert error["remedy"]
    assert isinstance(document["warnings"], list)
    assert listing(Path()) == before
    return error


@pytest.mark.parametrize("verb", GOOD)
def test_unknown_option(verb):
    error = wrong(*verb.split(), *GOOD[verb], "--colour", "red")
    assert "--colour" in error["message"]
    assert f"closerange {verb} --help" in error["remedy"]


@pytest.mark.parametrize("verb", READS)
def test_nothing_but_the_verb(verb):
    error = wrong(*verb.split())
    assert error["message"].startswith("missing argument ")
    assert f"for instance closerange {verb} " in error["remedy"]


@pytest.mark.parametrize("verb", [verb for verb in WRITES if verb != "shapes teach"])
def test_forgotten_output(verb):
    args = GOOD[verb][: GOOD[verb].index("-o")]
    assert "'-o'" in wrong(*verb.split(), *args)["message"]


@pytest.mark.parametrize("verb", WRITES)
def test_output_without_its_name(verb):
    """Without --json, which would be taken for the name."""
    result = CliRunner().invoke(app, [*verb.split(), *GOOD[verb][:-1]])
    assert result.exit_code == 2
    assert "error: option '-o' requires an argument\nremedy: " in result.stderr


@pytest.mark.parametrize("verb", READS)
def test_missing_file(verb):
    error = wrong(*verb.split(), *GOOD[verb])
    assert "o such file" in error["message"]
    assert re.search(r"\b[a-z]\.(png|toml|csv|json)", error["message"])


@pytest.mark.parametrize("verb", READS)
@pytest.mark.parametrize("content", ["", "x,y\n", "\0\1\2"])
def test_files_that_are_none(verb, content):
    """Every file that the verb reads is empty, another table, or no text."""
    for name in GOOD[verb]:
        if re.fullmatch(r"[a-np-z]\.\w+", name):
            Path(name).write_text(content, encoding="utf-8")
    wrong(*verb.split(), *GOOD[verb])


@pytest.mark.parametrize("verb", READS)
def test_folder_in_the_place_of_a_file(verb, here):
    name = next(arg for arg in GOOD[verb] if re.fullmatch(r"[pri]\.\w+", arg))
    (here / name).mkdir()
    error = wrong(*verb.split(), *GOOD[verb])
    # images may lie in a folder; then something else is missing
    expected = "no such file" if verb in ("detect", "shapes find") else "folder"
    assert expected in error["message"]


@pytest.mark.parametrize("verb", WRITES)
def test_output_folder_that_is_missing(verb):
    error = wrong(*verb.split(), *GOOD[verb][:-1], "missing/out.csv")
    assert "'missing'" in error["message"]
    assert "make the folder first" in error["remedy"]


@pytest.mark.parametrize("verb", WRITES)
def test_output_that_is_a_folder(verb, here):
    (here / "results").mkdir()
    assert "is a folder" in wrong(*verb.split(), *GOOD[verb][:-1], "results")["message"]


@pytest.mark.parametrize("verb", WRITES)
def test_output_that_is_write_protected(verb, here):
    path = here / "old.csv"
    path.write_text(CONTENT, encoding="utf-8")
    path.chmod(0o444)
    assert "write-protected" in wrong(*verb.split(), *GOOD[verb][:-1], path.name)["message"]
    assert path.read_text(encoding="utf-8") == CONTENT


@pytest.mark.parametrize("verb", WRITES)
def test_output_that_is_a_device(verb):
    """An administrator could replace it by a table."""
    error = wrong(*verb.split(), *GOOD[verb][:-1], os.devnull)
    assert "regular file" in error["message"]


@pytest.mark.parametrize("verb", WRITES)
def test_output_that_is_an_input(verb, here):
    """Also under another name of the same file."""
    name = next(arg for arg in GOOD[verb] if re.fullmatch(r"[pri]\.\w+", arg))
    (here / name).write_text(CONTENT, encoding="utf-8")
    for output in (name, f"../{here.name}/{name}"):
        error = wrong(*verb.split(), *GOOD[verb][:-1], output)
        assert "destroy the input" in error["message"]
    assert (here / name).read_text(encoding="utf-8") == CONTENT


@pytest.mark.parametrize("verb", ["calibrate", "verify"])
def test_report_of_the_same_name(verb):
    error = wrong(*verb.split(), *GOOD[verb], "--report", GOOD[verb][-1])
    assert "two outputs" in error["message"]


@pytest.mark.parametrize("verb", ["calibrate", "verify"])
def test_report_into_a_missing_folder_writes_nothing_else(verb):
    error = wrong(*verb.split(), *GOOD[verb], "--report", "missing/report.html")
    assert "missing" in error["message"]


@pytest.mark.parametrize(
    ("args", "word"),
    [
        (["calibrate", "a.csv", "--volume", "1", "2", "-o", "rig.json"], "--volume"),
        (["verify", *GOOD["verify"], "--cycle-time", "soon"], "given: soon"),
        (["verify", *GOOD["verify"], "--accuracy-limit", "1", "2", "x"], "--accuracy-limit"),
        (["verify", "beauty", *GOOD["verify"][1:]], "beauty"),
        (["calibrate", *GOOD["calibrate"], "--image-size", "left=64x48"], "twice"),
        (["calibrate", *GOOD["calibrate"], "--times", "t.csv"], "--times was given alone"),
        (["measure", *GOOD["measure"], "--time-tolerance", "1"], "--time-tolerance was given"),
    ],
)
def test_values_that_are_none(args, word):
    assert word in wrong(*args)["message"]


@pytest.mark.parametrize(
    ("typed", "meant"),
    [("detct", "detect"), ("mesure", "measure"), ("reprot", "report"), ("shaps", "shapes")],
)
def test_a_verb_that_is_nearly_one(typed, meant):
    error = wrong(typed)
    assert f"'{typed}'" in error["message"]
    assert f"did you mean '{meant}'?" in error["remedy"]


@pytest.mark.parametrize("args", [["--colour"], ["xyz"], ["shapes"], ["shapes", "xyz"]])
def test_no_verb_at_all(args):
    assert re.search("closerange( shapes)? --help", wrong(*args)["remedy"])


def test_the_name_alone_shows_the_help():
    result = CliRunner().invoke(app, [])
    assert result.exit_code == 2
    assert "Begin with: closerange demo" in result.stdout


@pytest.mark.parametrize("verb", ["run", "demo"])
def test_results_into_a_foreign_folder(verb, here):
    (here / "photographs").mkdir()
    (here / "photographs" / "holiday.jpg").touch()
    project = here / "p.toml"
    project.write_text(
        'schema = "closerange.project/1"\n[calibration]\ntarget = "t.toml"\ncontrol = "c.csv"\n'
        'images = { left = ["*.png"] }\n',
        encoding="utf-8",
    )
    error = wrong(*verb.split(), *GOOD[verb], "--output", "photographs")
    assert "photographs" in error["message"]
    assert "--overwrite" in error["remedy"]


@pytest.fixture
def failing(monkeypatch):
    """Make the work of `report` raise."""

    def install(error):
        def work(_source):
            raise error

        monkeypatch.setattr("closerange.workflows.report.report", work)

    return install


def test_a_defect_of_the_program_is_named_with_its_place(failing):
    failing(KeyError("gain"))
    error = wrong("report", "r.json", "-o", "o.html", code=DEFECT)
    assert "KeyError: 'gain' (test_cli_errors.py, line " in error["message"]
    assert "report" in error["remedy"]


def test_too_little_memory(failing):
    failing(MemoryError())
    assert "memory" in wrong("report", "r.json", "-o", "o.html", code=1)["message"]


@pytest.mark.parametrize("verb", [verb for verb in WRITES if " " not in verb])
def test_ctrl_c_is_an_object_too(verb, monkeypatch):
    def pressed(*_args, **_kwargs):
        raise KeyboardInterrupt

    monkeypatch.setattr(f"closerange.workflows.{verb}.{verb}", pressed)
    result = CliRunner().invoke(app, [*verb.split(), *GOOD[verb], "--json"])
    assert result.exit_code == 130
    assert "interrupted: nothing was written" in result.stderr
    assert json.loads(result.stdout)["error"]["exit_code"] == 130
    assert listing(Path()) == []


def test_ctrl_c_between_two_outputs_says_what_is_written(monkeypatch):
    """The rig is whole; only its report is missing."""

    def pressed(*_args, **_kwargs):
        raise KeyboardInterrupt

    monkeypatch.setattr("closerange.workflows.calibrate.calibrate", lambda *_, **__: "rig")
    monkeypatch.setattr("closerange.workflows.report.report_of_rig", lambda _: "page")
    monkeypatch.setattr("closerange.rig.rig_file.write_rig", lambda _, path: path.touch())
    monkeypatch.setattr("closerange.files.write_text", pressed)
    args = ["calibrate", *GOOD["calibrate"], "--report", "rig.html"]
    result = CliRunner().invoke(app, args)
    assert result.exit_code == 130
    assert "interrupted: written, whole: o.json" in result.stderr


def test_warnings_stay_in_the_object_when_an_error_follows(monkeypatch):
    def work(_source):
        warnings.warn("look here", CloseRangeWarning, stacklevel=1)
        raise KeyError("x")

    monkeypatch.setattr("closerange.workflows.report.report", work)
    result = CliRunner().invoke(app, ["report", "r.json", "-o", "o.html", "--json"])
    assert json.loads(result.stdout)["warnings"] == ["look here"]
