"""A project that states limits decides, and may limit the program's own time."""

from __future__ import annotations

import json
import shutil
from importlib.resources import files
from pathlib import Path

import pytest

from closerange.apps.cli.screens import run_failure, run_summary, run_text
from closerange.flags import Flag
from closerange.workflows.run import run

DEMO = Path(str(files("closerange.workflows") / "demo_data"))
POSITIONS = ("p00", "p01", "p02")


@pytest.fixture
def project(tmp_path):
    """Copy three heights and three positions out of the demonstration; limits are filled in."""
    folder = tmp_path / "project"
    for name in ("calibration", "verify"):
        (folder / name).mkdir(parents=True)
    for camera in ("left", "right"):
        for z in ("z-50.0", "z+00.0", "z+50.0"):
            name = f"calibration/{camera}_{z}.png"
            shutil.copy(DEMO / name, folder / name)
        for image in (DEMO / "verify").glob(f"*_{camera}_*.png"):
            if image.name.startswith(POSITIONS):
                shutil.copy(image, folder / "verify" / image.name)
    for name in ("disc.toml", "plate.toml", "control.csv", "verify/crops.csv"):
        shutil.copy(DEMO / name, folder / name)
    truth = (DEMO / "verify/truth.csv").read_text(encoding="utf-8").splitlines()
    kept = [line for line in truth[1:] if any(name in line for name in POSITIONS)]
    (folder / "verify/truth.csv").write_text("\n".join([truth[0], *kept]), encoding="utf-8")

    def write(limits="", *, exchanged=False):
        job = {"left": "left", "right": "right"}
        if exchanged:
            job = {"left": "right", "right": "left"}
        (folder / "closerange.toml").write_text(
            f"""
schema = "closerange.project/1"
[calibration]
target = "plate.toml"
control = "control.csv"
model = "pinhole"
placement_pattern = "_(z.*)$"
images = {{ left = ["calibration/left_*.png"], right = ["calibration/right_*.png"] }}
[[job]]
name = "test"
target = "disc.toml"
placement_pattern = '^(p\\d+)_(?:left|right)_r(?P<reading>\\d+)$'
images = {{ left = ["verify/*_{job["left"]}_*.png"], right = ["verify/*_{job["right"]}_*.png"] }}
crops = "verify/crops.csv"
verify = "single-point"
truth = "verify/truth.csv"
{limits}
""",
            encoding="utf-8",
        )
        return folder / "closerange.toml"

    return write


def result_of(done):
    return json.loads((done.folder / "test-result.json").read_text(encoding="utf-8"))


@pytest.mark.parametrize(("limit", "decision"), [(0.05, "accept"), (0.0001, "reject")])
def test_limits_of_the_project_decide(project, limit, decision):
    done = run(project(f"limits = {{ accuracy_mm = {limit}, confidence = 0.9 }}"))
    document = result_of(done)
    assert document["decision"] == decision
    assert document["limits"]["confidence"] == 0.9
    # no clock has a part in the results unless it is asked for
    assert document["cycle_time_s"] is None
    assert f"Decision     {decision}" in run_text(done)
    assert run_failure(done) is None


def test_the_program_s_own_time_is_measured_and_limited_where_asked_for(project):
    done = run(project("limits = { cycle_time_s = 60.0 }"))
    document = result_of(done)
    (job,) = done.jobs
    assert 0 < job.cycle_time_s < 60.0
    assert document["cycle_time_s"] == job.cycle_time_s
    assert document["decision"] == "accept"
    assert "mean of 9 readings, from the images on disk" in document["cycle_time_includes"]
    assert any("without exposure" in text for text in document["deviations"])
    assert run_summary(done)["jobs"][0]["cycle_time_s"] == job.cycle_time_s
    assert "ms a reading, images on disk to position" in run_text(done)


def test_exchanged_images_are_said_and_all_files_are_written(project):
    done = run(project("limits = { accuracy_mm = 500.0 }", exchanged=True))
    (job,) = done.jobs
    assert (job.positions.flags & int(Flag.residual)).all()
    assert job.result is None  # nothing is left to be compared
    failure = run_failure(done)
    assert failure is not None
    assert (failure.exit_code, "contradict the rig" in failure.message) == (1, True)
    assert done.report.is_file()
    assert (done.folder / "test-positions.csv").is_file()
    assert any("'left' as 'right', 'right' as 'left', 9 of 9" in text for text in done.warnings)
    assert any("'test' is not verified" in text for text in done.warnings)
