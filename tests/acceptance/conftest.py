"""The acceptance tests: their command line, good tables to spoil, and what a refusal is."""

from __future__ import annotations

import csv
import shutil
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from importlib.resources import files
from pathlib import Path

import cv2
import numpy as np
import pytest
from numpy.typing import ArrayLike, NDArray
from typer.testing import CliRunner

from closerange.apps.cli.commands import app
from closerange.apps.cli.console import DEFECT
from closerange.features.control import ControlPoints, write_control
from closerange.features.image_points import ImagePoints
from closerange.features.points_table import write_points
from closerange.rig.camera import Camera
from closerange.rig.rig_file import write_rig
from closerange.verification.scenes import observe, rig_a
from closerange.workflows.calibrate import calibrate
from closerange.workflows.detect import detect

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
    assert result.exit_code != DEFECT, result.stderr
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


@pytest.fixture
def project(demo_data: Path, tmp_path: Path) -> Path:
    """Copy three placements of the demo's calibration as a project without jobs."""
    folder = tmp_path / "project"
    (folder / "calibration").mkdir(parents=True)
    for height in ("-50.0", "+00.0", "+50.0"):
        for camera in ("left", "right"):
            shutil.copy(
                demo_data / "calibration" / f"{camera}_z{height}.png", folder / "calibration"
            )
    for name in ("plate.toml", "control.csv"):
        shutil.copy(demo_data / name, folder)
    text = (demo_data / "closerange.toml").read_text(encoding="utf-8")
    (folder / "closerange.toml").write_text(text[: text.index("[[job]]")], encoding="utf-8")
    return folder


def names_in(folder: Path) -> list[str]:
    """Name everything directly in a folder, hidden files too."""
    return sorted(path.name for path in folder.iterdir())


@pytest.fixture
def run_refused(project: Path) -> Callable[..., str]:
    """Run the project, which must be refused and leave its folder, and the one above, alone."""

    def check(code: int, *words: str) -> str:
        before = names_in(project), names_in(project.parent)
        outcome = command("run", project / "closerange.toml")
        assert outcome.code == code, outcome.stderr
        assert "error: " in outcome.stderr
        assert "\nremedy: " in outcome.stderr
        for word in words:
            assert word in outcome.stderr, f"{word!r} is not in: {outcome.stderr}"
        assert (names_in(project), names_in(project.parent)) == before
        return outcome.stderr

    return check


GOOD_IMAGE = "left_z+00.0.png"


@pytest.fixture(scope="session")
def good(demo_data: Path) -> NDArray[np.uint8]:
    """Pixels of a good image."""
    return cv2.imread(str(demo_data / "calibration" / GOOD_IMAGE), cv2.IMREAD_UNCHANGED)


@pytest.fixture(scope="session")
def good_image(demo_data: Path) -> Path:
    """File of a good image."""
    return demo_data / "calibration" / GOOD_IMAGE


@pytest.fixture(scope="session")
def truth(demo_data: Path) -> NDArray[np.float64]:
    """Centres in the good image, from the same program: what odd formats must give too."""
    image, target = demo_data / "calibration" / GOOD_IMAGE, demo_data / "plate.toml"
    points = detect(image, target=target, camera="left")
    assert not points.flags.any()
    return points.xy_px


@pytest.fixture
def looking(demo_data: Path) -> Callable[..., list[str | Path]]:
    """Return the arguments of ``detect`` without ``-o``."""
    plate = demo_data / "plate.toml"

    def args(*images: Path, target: Path = plate) -> list[str | Path]:
        return ["detect", *images, "--target", target, "--camera", "left"]

    return args


class Rows(list[dict[str, str]]):
    """Rows of a points table."""

    @property
    def xy(self) -> NDArray[np.float64]:
        """Positions; NaN where a cell is blank."""
        return np.array([[float(row[name] or "nan") for name in ("x_px", "y_px")] for row in self])

    @property
    def flags(self) -> list[set[str]]:
        """Names of each row's flags."""
        return [set(filter(None, row["flags"].split("|"))) for row in self]


@pytest.fixture
def detected(
    looking: Callable[..., list[str | Path]], tmp_path: Path
) -> Callable[..., tuple[Outcome, Rows]]:
    """Detect in images that are not refused; return outcome and rows."""

    def read(*images: Path, **options: Path) -> tuple[Outcome, Rows]:
        output = tmp_path / "points.csv"
        outcome = command(*looking(*images, **options), "-o", output)
        assert output.is_file(), outcome.stderr
        with output.open(newline="", encoding="utf-8") as stream:
            return outcome, Rows(csv.DictReader(stream))

    return read


@pytest.fixture(scope="session")
def save() -> Callable[..., Path]:
    """Encode pixels by the path's ending."""

    def write(path: Path, pixels: NDArray[np.generic], *options: int) -> Path:
        assert cv2.imwrite(str(path), pixels, list(options))
        return path

    return write
