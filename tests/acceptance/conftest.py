"""The acceptance tests: their command line, good tables to spoil, and what a refusal is."""

from __future__ import annotations

import csv
import shutil
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from importlib.resources import files
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import ArrayLike
from typer.testing import CliRunner

from closerange.apps.cli.commands import app
from closerange.features.control import ControlPoints, write_control
from closerange.features.image_points import ImagePoints
from closerange.features.points_table import write_points
from closerange.rig.camera import Camera
from closerange.rig.rig_file import write_rig
from closerange.verification.scenes import observe, rig_a
from closerange.workflows.calibrate import calibrate

BEFORE = "what stood here before\n"

SYNTHETIC_PX = "1280x1024"
DEMO_PX = "640x512"


@dataclass(frozen=True)
class Outcome:
    """What a command left behind."""

    code: int
    stdout: str
    stderr: str


@dataclass(frozen=True)
class Tables:
    """A folder of good tables, of which a test spoils its own copy."""

    folder: Path
    size: str = SYNTHETIC_PX

    @property
    def left(self) -> Path:
        return self.folder / "left.csv"

    @property
    def right(self) -> Path:
        return self.folder / "right.csv"

    @property
    def control(self) -> Path:
        return self.folder / "control.csv"

    @property
    def rig(self) -> Path:
        return self.folder / "rig.json"

    @property
    def calibrate(self) -> list[str]:
        """Arguments of ``calibrate`` without ``-o``."""
        return [
            "calibrate", str(self.left), str(self.right), "--control", str(self.control),
            "--image-size", f"left={self.size}", "--image-size", f"right={self.size}",
        ]  # fmt: skip

    @property
    def measure(self) -> list[str]:
        """Arguments of ``measure`` without ``-o``."""
        return ["measure", str(self.rig), str(self.left), str(self.right)]

    def edit(self, name: str, change: Callable[[dict[str, str]], object]) -> None:
        """Let a function change each row of a table in place."""
        path = self.folder / name
        with path.open(newline="", encoding="utf-8") as stream:
            rows = list(csv.DictReader(stream))
        for row in rows:
            change(row)
        with path.open("w", newline="", encoding="utf-8") as stream:
            writer = csv.DictWriter(stream, list(rows[0]), lineterminator="\n")
            writer.writeheader()
            writer.writerows(rows)

    def keep(self, name: str, wanted: Callable[[dict[str, str]], bool]) -> None:
        """Keep some rows of a table."""
        path = self.folder / name
        with path.open(newline="", encoding="utf-8") as stream:
            rows = [row for row in csv.DictReader(stream) if wanted(row)]
        with path.open("w", newline="", encoding="utf-8") as stream:
            writer = csv.DictWriter(stream, list(rows[0]), lineterminator="\n")
            writer.writeheader()
            writer.writerows(rows)


def command(*args: str | Path) -> Outcome:
    """Run the command line in this process; a traceback fails the test."""
    result = CliRunner().invoke(app, [str(arg) for arg in args])
    if result.exception is not None and not isinstance(result.exception, SystemExit):
        raise result.exception
    assert "Traceback" not in result.stderr
    return Outcome(result.exit_code, result.stdout, result.stderr)


def listing(folder: Path) -> list[str]:
    """Name every file and folder below a folder."""
    return sorted(path.relative_to(folder).as_posix() for path in folder.rglob("*"))


@pytest.fixture
def run() -> Callable[..., Outcome]:
    """Run a command in this process."""
    return command


@pytest.fixture
def refused(tmp_path: Path) -> Callable[..., str]:
    """Run a command that must be refused: exit code, words on stderr, nothing written.

    It is run without and with an older file of the output's name; slow ones only with it
    (`once`).
    """

    def check(args: Sequence[str | Path], code: int, *words: str, once: bool = False) -> str:
        folder = tmp_path / "written"
        folder.mkdir(exist_ok=True)
        output = folder / "result.out"
        for before in (True,) if once else (False, True):
            if before:
                output.write_text(BEFORE, encoding="utf-8")
            outcome = command(*args, "-o", output)
            assert outcome.code == code, outcome.stderr
            assert "error: " in outcome.stderr
            assert "\nremedy: " in outcome.stderr
            for word in words:
                assert word in outcome.stderr, f"{word!r} is not in: {outcome.stderr}"
            assert listing(folder) == (["result.out"] if before else [])
        assert output.read_text(encoding="utf-8") == BEFORE
        output.unlink()
        return outcome.stderr

    return check


def synthetic_control() -> ControlPoints:
    """Make a plate of nine points at seven heights, 90 x 90 x 100 mm, named as a grid."""
    rows = [
        (f"z{k}", f"r{r}c{c}", ((c - 1) * 45.0, (1 - r) * 45.0, z))
        for k, z in enumerate(np.linspace(-50.0, 50.0, 7))
        for r in range(3)
        for c in range(3)
    ]
    placement, point, xyz = zip(*rows, strict=True)
    return ControlPoints.of(point, xyz, placement=placement)


def write_scene(folder: Path, cameras: Sequence[Camera], control: ControlPoints) -> ImagePoints:
    """Write control.csv and a points table for each camera; noise 0.05 px."""
    points = observe(cameras, control, noise_px=0.05, rng=np.random.default_rng(1))
    write_control(control, folder / "control.csv")
    for camera in cameras:
        mine = [name == camera.name for name in points.camera]
        write_points(points.select(mine), folder / f"{camera.name}.csv")
    return points


@pytest.fixture(scope="session")
def good_tables(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Write tables of an exact pair of cameras, noise 0.05 px, and the rig they give."""
    folder = tmp_path_factory.mktemp("good")
    control = synthetic_control()
    points = write_scene(folder, rig_a().cameras, control)
    write_rig(calibrate(points, control=control, model="brown"), folder / "rig.json")
    return folder


@pytest.fixture
def scene(tmp_path: Path) -> Callable[..., Tables]:
    """Write the tables of a scene: what the true cameras of rig A, or others, see of points."""

    def write(
        xyz_mm: ArrayLike, placement: str | Sequence[str] = "", cameras: Sequence[Camera] = ()
    ) -> Tables:
        folder = tmp_path / "scene"
        folder.mkdir()
        names = [f"p{i}" for i in range(len(np.asarray(xyz_mm)))]
        control = ControlPoints.of(names, xyz_mm, placement=placement)
        write_scene(folder, cameras or rig_a().cameras, control)
        return Tables(folder)

    return write


@pytest.fixture
def tables(good_tables: Path, tmp_path: Path) -> Tables:
    """Give a copy of the good tables that a test may spoil."""
    folder = tmp_path / "tables"
    shutil.copytree(good_tables, folder)
    return Tables(folder)


@pytest.fixture(scope="session")
def detected_tables(demo_data: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Detect the plate's discs in the rendered images: points tables with ellipses."""
    folder = tmp_path_factory.mktemp("detected")
    shutil.copy(demo_data / "control.csv", folder)
    for camera in ("left", "right"):
        images = sorted((demo_data / "calibration").glob(f"{camera}_*.png"))
        options = ["--target", demo_data / "plate.toml", "--camera", camera]
        output = folder / f"{camera}.csv"
        outcome = command(
            "detect", *images, *options, "--placement-pattern", "_(z.*)$", "-o", output
        )
        assert outcome.code == 0, outcome.stderr
    return folder


@pytest.fixture
def disc_tables(detected_tables: Path, tmp_path: Path) -> Tables:
    """Give a copy of the detected tables that a test may spoil; without a rig."""
    folder = tmp_path / "detected"
    shutil.copytree(detected_tables, folder)
    return Tables(folder, DEMO_PX)


@pytest.fixture(scope="session")
def demo_data() -> Path:
    """Folder of the rendered images that come with the package."""
    return Path(str(files("closerange.workflows") / "demo_data"))
