"""The command line: helps, exit codes, JSON, and one chain from images to a report."""

from __future__ import annotations

import json
import subprocess
import sys
from importlib.resources import files
from pathlib import Path

import pytest
from typer.testing import CliRunner

from closerange.apps.cli import app
from closerange.version import __version__

DEMO = Path(str(files("closerange.workflows") / "demo_data"))
VERBS = ("detect", "calibrate", "match", "measure", "verify", "run", "demo", "report", "volume")
HEIGHTS = ("z-50.0", "z+00.0", "z+50.0")
SIZES = ("--image-size", "left=640x512", "--image-size", "right=640x512")
CUBE = ("--volume", "-50", "-50", "-50", "50", "50", "50")


def command(*args, code=0):
    """Run the command line; a traceback or another exit code fails the test."""
    result = CliRunner().invoke(app, [str(arg) for arg in args])
    if result.exception is not None and not isinstance(result.exception, SystemExit):
        raise result.exception
    assert result.exit_code == code, result.output
    return result


def summary_of(*args, code=0):
    """Run with ``--json``; stdout must be one JSON document and nothing else."""
    result = command(*args, "--json", code=code)
    return json.loads(result.stdout)


def detect(camera, output, *more, job="calibration"):
    if job == "calibration":
        images = [DEMO / f"calibration/{camera}_{height}.png" for height in HEIGHTS]
        options = ["--target", DEMO / "plate.toml", "--placement-pattern", "_(z.*)$"]
    else:
        images = [DEMO / f"verify/p{n:02}_{camera}_r{r}.png" for n in range(3) for r in range(3)]
        options = [
            "--target", DEMO / "disc.toml", "--crops", DEMO / "verify/crops.csv",
            "--placement-pattern", r"^(p\d+)_(?:left|right)_r(?P<reading>\d+)$",
        ]  # fmt: skip
    return ["detect", *images, *options, "--camera", camera, "-o", output, *more]


@pytest.fixture(scope="module")
def chain(tmp_path_factory):
    """Detect, calibrate, measure and verify; the folder and each verb's summary."""
    folder = tmp_path_factory.mktemp("chain")
    found = {}
    for camera in ("left", "right"):
        found[camera] = summary_of(*detect(camera, folder / f"{camera}.csv"))
        found[f"{camera} disc"] = summary_of(
            *detect(camera, folder / f"{camera}-disc.csv", job="verify")
        )
    found["calibrate"] = summary_of(
        "calibrate", folder / "left.csv", folder / "right.csv", "--control", DEMO / "control.csv",
        *SIZES, *CUBE, "--report", folder / "rig.html", "-o", folder / "rig.json",
    )  # fmt: skip
    found["measure"] = summary_of(
        "measure", folder / "rig.json", folder / "left-disc.csv", folder / "right-disc.csv",
        "-o", folder / "positions.csv",
    )  # fmt: skip
    found["verify"] = summary_of(
        "verify", "single-point", folder / "positions.csv", "--truth", DEMO / "verify/truth.csv",
        "--rig", folder / "rig.json", "--accuracy-limit", "0.05", "0.05", "0.05",
        "--report", folder / "verify.html", "-o", folder / "result.json",
    )  # fmt: skip
    return folder, found


@pytest.mark.parametrize("verb", VERBS)
def test_every_help_shows_an_example(verb):
    for option in ("--help", "-h"):
        text = command(verb, option).stdout
        assert f"  closerange {verb} " in text.partition("Example")[2]


def test_the_first_help_names_all_verbs_and_a_beginning():
    text = command("--help").stdout
    assert "closerange demo" in text
    assert all(f"  {verb} " in text for verb in VERBS)


def test_version():
    assert command("--version").stdout == f"closerange {__version__}\n"


def test_detection(chain):
    found = chain[1]["left"]
    assert found["rows"] == found["found"] == found["unflagged"] == 27  # 9 discs, 3 heights
    assert found["image_size"] == {"left": [640, 512]}
    assert found["flags"] == {}
    assert [entry["camera"] for entry in found["thresholds"]] == ["left"] * 3
    assert all(entry["threshold"] in entry["fixed_points"] for entry in found["thresholds"])
    assert chain[1]["right disc"]["found"] == 9  # 3 positions, 3 readings


def test_calibration(chain):
    folder, found = chain
    rig = found["calibrate"]
    assert rig["cameras"] == ["left", "right"]
    assert rig["volume_mm"] == [[-50.0] * 3, [50.0] * 3]
    assert rig["points_fitted"] == 54
    assert rig["trust"]["verdict"] == "good"
    lens = rig["radial_distortion"]["right"]
    assert lens["delta_px"][0] == 0
    assert lens["radius_px"][-1] > 380  # from the centre of 640 x 512 px to a corner
    # noise of the images is below 0.01 px; measured 0.0036 px
    assert 0 < rig["noise_px"] < 0.01
    assert (folder / "rig.html").read_text(encoding="utf-8").startswith("<!")
    assert json.loads((folder / "rig.json").read_text(encoding="utf-8"))["cameras"]


def test_positions_and_verification(chain):
    folder, found = chain
    assert found["measure"]["measured"] == found["measure"]["rows"] == 9
    result = found["verify"]
    assert (result["kind"], result["positions"]) == ("single-point", 3)
    # within its limits, but of the 90 positions that were to be tested 87 were not
    assert result["decision"] == "undecided"
    assert result["reservations"] == ["87 of 90 actual positions have no usable reading"]
    # 3.4 px a mm: 0.02 px are 0.006 mm, three times that in depth; measured 0.0028 mm
    assert max(result["accuracy_mm"]) < 0.02
    assert (folder / "verify.html").is_file()


@pytest.mark.parametrize("name", ["rig.json", "result.json"])
def test_reports_of_stored_results(chain, tmp_path, name):
    output = tmp_path / "report.html"
    assert summary_of("report", chain[0] / name, "-o", output)["report"] == str(output)
    assert output.read_text(encoding="utf-8").rstrip().endswith("</html>")


def test_without_json_people_read_what_was_found(chain, tmp_path):
    folder = chain[0]
    told = command("measure", folder / "rig.json", folder / "left-disc.csv",
                   folder / "right-disc.csv", "-o", tmp_path / "p.csv")  # fmt: skip
    assert told.stdout.startswith("Positions    9 of 9 measured\n")
    same = (tmp_path / "p.csv").read_bytes() == (folder / "positions.csv").read_bytes()
    assert same


def test_what_is_missing_exits_with_2_and_writes_nothing(tmp_path):
    output = tmp_path / "out.csv"
    result = command("measure", tmp_path / "rig.json", tmp_path / "a.csv", "-o", output, code=2)
    assert result.stderr.startswith("error: ")
    assert "\nremedy: " in result.stderr
    assert result.stdout == ""
    assert not output.exists()


def test_an_image_without_the_target_exits_with_1(tmp_path):
    """A board is looked for where there are discs."""
    board = tmp_path / "board.toml"
    board.write_text(
        'kind = "chessboard"\nrows = 6\ncolumns = 7\nsquare_mm = 10.0\n', encoding="utf-8"
    )
    image = DEMO / "calibration/left_z+00.0.png"
    output = tmp_path / "out.csv"
    told = summary_of("detect", image, "--target", board, "--camera", "left", "-o", output, code=1)
    assert told["error"]["exit_code"] == 1
    assert "left_z+00.0.png" in told["error"]["message"]
    assert told["error"]["remedy"]
    assert not output.exists()


def test_an_untrustworthy_rig_exits_with_1_unless_accepted(chain, tmp_path):
    """A stated volume that no camera sees."""
    folder, output = chain[0], tmp_path / "rig.json"
    args = ["calibrate", folder / "left.csv", folder / "right.csv", "--control",
            DEMO / "control.csv", *SIZES, "--volume", *["-2000"] * 3, *["-1900"] * 3,
            "-o", output]  # fmt: skip
    told = summary_of(*args, code=1)
    assert "untrustworthy" in told["error"]["message"]
    assert "--accept-untrusted" in told["error"]["remedy"]
    assert not output.exists()
    told = summary_of(*args, "--accept-untrusted")
    assert told["trust"]["verdict"] == "untrustworthy"
    assert told["trust"]["reasons"]
    assert output.is_file()


@pytest.mark.parametrize(
    "text",
    ["left", "left=640", "=640x512", "left=640x", "left=0x512", "left=-640x512", "left=640X512",
     "left=6.4x5", "left=640x512x3", "left=\u0666\u0664\u0660x512", "left=9999999x512"],
)  # fmt: skip
def test_malformed_image_sizes(chain, tmp_path, text):
    folder, output = chain[0], tmp_path / "rig.json"
    result = command("calibrate", folder / "left.csv", "--control", DEMO / "control.csv",
                     "--image-size", text, "-o", output, code=2)  # fmt: skip
    assert "expected NAME=WxH" in result.stderr
    assert not output.exists()


def test_one_camera_with_two_image_sizes(chain, tmp_path):
    result = command("calibrate", chain[0] / "left.csv", "--control", DEMO / "control.csv",
                     *SIZES[:2], *SIZES[:2], "-o", tmp_path / "rig.json", code=2)  # fmt: skip
    assert "twice" in result.stderr


def test_unknown_kind_of_verification(chain, tmp_path):
    told = summary_of("verify", "beauty", chain[0] / "positions.csv", "--truth",
                      DEMO / "verify/truth.csv", "-o", tmp_path / "r.json", code=2)  # fmt: skip
    assert "beauty" in told["error"]["message"]
    assert "single-point" in told["error"]["remedy"]


def test_warnings_go_to_stderr_and_into_the_summary(tmp_path):
    """A board that looks the same after half a turn draws a warning before it is looked for."""
    board = tmp_path / "board.toml"
    board.write_text(
        'kind = "chessboard"\nrows = 6\ncolumns = 8\nsquare_mm = 10.0\n', encoding="utf-8"
    )
    result = command(
        "detect", DEMO / "calibration/left_z+00.0.png", "--target", board, "--camera", "left",
        "-o", tmp_path / "out.csv", "--json", code=1,
    )  # fmt: skip
    assert "warning: " in result.stderr
    assert any("half a turn" in text for text in json.loads(result.stdout)["warnings"])


def test_run_of_a_small_project(tmp_path):
    (tmp_path / "images").mkdir()
    for name in ("plate.toml", "control.csv"):
        (tmp_path / name).write_bytes((DEMO / name).read_bytes())
    for camera in ("left", "right"):
        for height in HEIGHTS:
            name = f"{camera}_{height}.png"
            (tmp_path / "images" / name).write_bytes((DEMO / "calibration" / name).read_bytes())
    project = tmp_path / "closerange.toml"
    project.write_text(
        'schema = "closerange.project/1"\n[calibration]\ntarget = "plate.toml"\n'
        'control = "control.csv"\nplacement_pattern = "_(z.*)$"\n'
        'images = { left = ["images/left_*.png"], right = ["images/right_*.png"] }\n',
        encoding="utf-8",
    )
    told = summary_of("run", project)
    assert (told["jobs"], told["rig"]["points_fitted"]) == ([], 54)
    assert Path(told["report"]) == tmp_path / "results" / "report.html"
    again = summary_of("run", project, code=2)
    assert "--overwrite" in again["error"]["remedy"]
    assert summary_of("run", project, "--overwrite")["rig"] == told["rig"]


def test_importing_the_command_line_imports_nothing_heavy():
    """--help answers at once: heavy libraries are imported by the verb that needs them."""
    code = (
        "import sys, closerange.apps.cli; "
        "print([n for n in ('numpy', 'cv2', 'scipy', 'pydantic', 'rich', 'jinja2') "
        "if n in sys.modules])"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout == "[]\n"


def test_a_decision_may_be_asked_to_be_surer(chain, tmp_path):
    folder = chain[0]
    verify = ["verify", "single-point", folder / "positions.csv", "--truth",
              DEMO / "verify/truth.csv", "-o", tmp_path / "r.json"]  # fmt: skip
    limit = ("--accuracy-limit", "0.05", "0.05", "0.05")
    command(*verify, *limit, "--confidence", "0.99")
    stored = (tmp_path / "r.json").read_text(encoding="utf-8")
    assert json.loads(stored)["limits"]["confidence"] == 0.99
    for wrong in ("1", "0.4"):
        told = summary_of(*verify, *limit, "--confidence", wrong, code=2)
        assert "confidence is" in told["error"]["message"]
    told = summary_of(*verify, "--confidence", "0.99", code=2)
    assert "--accuracy-limit" in told["error"]["remedy"]
