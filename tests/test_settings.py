"""The project file: what is read, and every way of being refused."""

from __future__ import annotations

from importlib.resources import as_file, files

import pytest

from closerange.errors import FileError, SchemaError
from closerange.settings import MatchJob, images_of, inside, read_settings

GOOD = """
schema = "closerange.project/1"

[calibration]
target = "plate.toml"
control = "control.csv"
images = { left = ["left_*.png"] }

[[job]]
name = "one disc"
target = "disc.toml"
images = { left = ["disc_*.png"] }
verify = "single-point"
truth = "truth.csv"
"""


@pytest.fixture
def project(tmp_path):
    """Write a project file, with one text replaced; it must have been there."""

    def write(old="", new=""):
        assert old in GOOD
        path = tmp_path / "closerange.toml"
        path.write_text(GOOD.replace(old, new, 1) if old else GOOD, encoding="utf-8")
        return path

    return write


def test_a_small_project_gets_the_defaults(project, tmp_path):
    settings = read_settings(project())
    assert settings.folder == tmp_path
    assert settings.title == "Close-range measurement"
    assert settings.outputs.folder == "results"
    calibration = settings.calibration
    assert (calibration.model, calibration.volume_mm) == ("auto", None)
    assert calibration.estimator == "least-squares"
    assert not calibration.accept_untrusted
    assert [job.verify for job in settings.job] == ["single-point"]


def test_a_project_without_jobs_only_calibrates(project):
    assert read_settings(project(GOOD[GOOD.index("[[job]]") :], "")).job == []


def test_the_shipped_project_reads_and_its_files_exist():
    with as_file(files("closerange.workflows") / "demo_data") as folder:
        settings = read_settings(folder / "closerange.toml")
        names = ["single-point", "bars across", "bars along", "blocks", "centroids"]
        assert [job.name for job in settings.job] == names
        counts = []
        for part in (settings.calibration, *settings.job):
            table = part.truth if isinstance(part, MatchJob) else part.target
            assert inside(settings, table).is_file()
            counts += [len(images_of(settings, part.images[name])) for name in ("left", "right")]
    assert counts == [7, 7, 270, 270, 5, 5, 2, 2, 1, 1, 1, 1]


@pytest.mark.parametrize(
    ("old", "new", "where"),
    [
        ('target = "plate.toml"', 'target = "plate.toml"\ncolour = 1', "calibration.colour"),
        ("[calibration]", "colour = 1\n[calibration]", "colour"),
        ("[calibration]", 'folder = "x"\n[calibration]', "folder: unknown key"),
        ("[[job]]", "[[job]]\ncolour = 1", "job.0.colour"),
        ("[[job]]", '[outputs]\nfile = "x"\n[[job]]', "outputs.file"),
        ('target = "plate.toml"', "", "calibration.target: Field required"),
        ('control = "control.csv"', "", "calibration.control: Field required"),
        ('images = { left = ["left_*.png"] }', "", "calibration.images: Field required"),
        ('schema = "closerange.project/1"', "", "schema: Field required"),
        ('name = "one disc"', "", "job.0.name: Field required"),
        ("closerange.project/1", "closerange.project/2", "schema"),
        ('"plate.toml"', "7", "calibration.target"),
        ('"plate.toml"', '""', "calibration.target"),
        ('["left_*.png"]', '"left_*.png"', "calibration.images.left"),
        ('["left_*.png"]', "[3]", "calibration.images.left.0"),
        ("[calibration]", "[calibration]\nvolume_mm = [0, 0, 0, 1, 1]", "calibration.volume_mm"),
        ("[calibration]", '[calibration]\nvolume_mm = ["0", 0, 0, 1, 1, 1]', "volume_mm.0"),
        ("[calibration]", '[calibration]\naccept_untrusted = "yes"', "accept_untrusted"),
        ("[calibration]", '[calibration]\nestimator = "guess"', "calibration.estimator"),
        ('"one disc"', '"../disc"', "job.0.name"),
        ('"one disc"', '"a/b"', "job.0.name"),
        ('"single-point"', '"points"', "job.0.verify"),
        ('truth = "truth.csv"', "", "verify and truth go together"),
        ('verify = "single-point"', "", "verify and truth go together"),
        ("[calibration]", "[calibration", "closerange.toml"),
    ],
)
def test_a_wrong_project_is_refused_with_its_place(project, old, new, where):
    with pytest.raises(SchemaError) as caught:
        read_settings(project(old, new))
    assert where in caught.value.message
    assert "closerange.toml" in caught.value.message
    assert caught.value.remedy


def test_jobs_that_would_write_the_same_files_are_refused(project):
    """A blank becomes a dash in file names; some file systems know no capital letters."""
    second = '[[job]]\nname = "One-disc"\ntarget = "t.toml"\nimages = { left = ["a"] }\n[[job]]'
    with pytest.raises(SchemaError, match="same files"):
        read_settings(project("[[job]]", second))


def test_a_missing_project_file(tmp_path):
    with pytest.raises(FileError, match=r"closerange\.toml"):
        read_settings(tmp_path / "closerange.toml")


def test_settings_are_frozen(project):
    settings = read_settings(project())
    with pytest.raises(ValueError, match="frozen"):
        settings.title = "another"


@pytest.mark.parametrize("read", [inside, lambda settings, path: images_of(settings, [path])])
@pytest.mark.parametrize("path", ["/etc/hosts", "../other.png", "a/../../other.png"])
def test_paths_that_leave_the_folder(project, read, path):
    with pytest.raises(FileError, match="leaves the project's folder"):
        read(read_settings(project()), path)


def test_symbolic_links_that_leave_the_folder(project, tmp_path_factory):
    elsewhere = tmp_path_factory.mktemp("elsewhere")
    (elsewhere / "a.png").touch()
    settings = read_settings(project())
    (settings.folder / "link.png").symlink_to(elsewhere / "a.png")
    (settings.folder / "folder").symlink_to(elsewhere)
    (settings.folder / "loop").symlink_to(settings.folder / "loop")
    for path in ("link.png", "folder/a.png"):
        with pytest.raises(FileError, match="symbolic link"):
            inside(settings, path)
    for pattern in ("li*.png", "folder/*.png"):
        with pytest.raises(FileError, match="symbolic link"):
            images_of(settings, [pattern])


def test_a_symbolic_link_within_the_folder_is_followed(project):
    settings = read_settings(project())
    (settings.folder / "a.png").touch()
    (settings.folder / "link.png").symlink_to("a.png")
    assert images_of(settings, ["link.png"]) == [settings.folder / "link.png"]


@pytest.mark.parametrize("pattern", ["left_*.png", "nowhere/*.png", "left.png", "."])
def test_a_pattern_that_finds_nothing(project, pattern):
    with pytest.raises(FileError) as caught:
        images_of(read_settings(project()), [pattern])
    assert f"{pattern}: no such file" in caught.value.message


def test_a_path_with_a_nul_byte(project):
    with pytest.raises(FileError):
        inside(read_settings(project()), "a\0b")


def test_patterns_find_their_files(project):
    settings = read_settings(project())
    (settings.folder / "deep").mkdir()
    for name in ("left_2.png", "left_1.png", "right_1.png", "deep/left_3.png"):
        (settings.folder / name).touch()
    found = images_of(settings, ["left_*.png", "deep/left_?.png"])
    names = [path.relative_to(settings.folder).as_posix() for path in found]
    assert names == ["left_1.png", "left_2.png", "deep/left_3.png"]


LIMITED = """truth = "truth.csv"
limits = { accuracy_mm = [0.01, 0.01, 0.03], repeatability_mm = 1, confidence = 0.99 }
"""


def test_limits_of_a_job(project):
    (job,) = read_settings(project('truth = "truth.csv"\n', LIMITED)).job
    assert job.limits.accuracy_mm == [0.01, 0.01, 0.03]
    assert (job.limits.repeatability_mm, job.limits.cycle_time_s) == (1.0, None)
    assert job.limits.confidence == 0.99


@pytest.mark.parametrize(
    ("limits", "word"),
    [
        ("accuracy_mm = 0", "accuracy_mm"),
        ("accuracy_mm = [1.0, 2.0]", "accuracy_mm"),
        ("repeatability_mm = [1.0, 2.0, -3.0]", "repeatability_mm"),
        ("cycle_time_s = nan", "cycle_time_s"),
        ("confidence = 0.9", "without any limit"),
        ("accuracy_mm = 1, confidence = 1.0", "confidence"),
        ("speed = 1", "speed"),
    ],
)
def test_impossible_limits(project, limits, word):
    with pytest.raises(SchemaError, match=word):
        read_settings(
            project('truth = "truth.csv"\n', f'truth = "t.csv"\nlimits = {{ {limits} }}\n')
        )


def test_limits_without_a_single_point_test(project):
    text = 'verify = "lengths"\ntruth = "truth.csv"\nlimits = { accuracy_mm = 1.0 }\n'
    with pytest.raises(SchemaError, match="limits are those of"):
        read_settings(project('verify = "single-point"\ntruth = "truth.csv"\n', text))


SCENE = """
[[job]]
name = "blocks"
match = "edges"
images = { left = ["l.png"], right = ["r.png"] }
z_mm = [-50.0, 25.0]
verify = "heights"
truth = "parts.csv"
"""


def with_scene(tmp_path, old="", new=""):
    assert old in SCENE
    path = tmp_path / "closerange.toml"
    path.write_text(GOOD + SCENE.replace(old, new, 1), encoding="utf-8")
    return path


def test_a_job_that_matches_beside_one_that_detects(tmp_path):
    first, second = read_settings(with_scene(tmp_path)).job
    assert (first.name, second.name) == ("one disc", "blocks")
    assert isinstance(second, MatchJob)
    assert (second.method, second.element_px, second.points) == ("default", None, None)
    assert second.z_mm == [-50.0, 25.0]


@pytest.mark.parametrize(
    ("old", "new", "where"),
    [
        ('match = "edges"', 'match = "faces"', "job.1.match"),
        ('match = "edges"', 'match = "edges"\ntarget = "disc.toml"', "job.1.target"),
        ('match = "edges"', 'match = "points"', "points go with match"),
        ('match = "edges"', 'match = "edges"\npoints = "p.csv"', "points go with match"),
        (', right = ["r.png"]', "", "job.1.images"),
        ("z_mm = [-50.0, 25.0]", "z_mm = [-50.0]", "job.1.z_mm"),
        (
            "z_mm = [-50.0, 25.0]",
            "z_mm = [-50.0, 25.0]\nvolume_mm = [0.0, 0.0, 0.0, 1.0, 1.0, 1.0]",
            "exclude each other",
        ),
        ('truth = "parts.csv"', "", "verify and truth go together"),
        ('verify = "heights"', 'verify = "lengths"', "job.1.verify"),
        ('name = "blocks"', 'name = "one disc"', "its own name"),
    ],
)
def test_a_job_that_matches_is_checked(tmp_path, old, new, where):
    with pytest.raises(SchemaError, match=where):
        read_settings(with_scene(tmp_path, old, new))
