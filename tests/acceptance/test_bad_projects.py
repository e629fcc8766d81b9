"""Bad project files and folders of results: items 47 and 49 of the list of bad inputs."""

from __future__ import annotations

import pytest


def names_in(folder):
    """Name everything in a folder, hidden files too."""
    return sorted(path.name for path in folder.iterdir())


UNSAFE = ["../outside.csv", "/etc/passwd", "a/../../outside.csv", "link.csv", "linked/outside.csv"]


@pytest.mark.parametrize("unsafe", UNSAFE)
@pytest.mark.parametrize("key", ["target", "control", "crops", "images", "folder"])
def test_item_49_paths_that_leave_the_project(project, run_refused, unsafe, key):
    outside = project.parent / "outside.csv"
    outside.write_text("secret\n", encoding="utf-8")
    (project / "link.csv").symlink_to(outside)
    (project / "linked").symlink_to(project.parent, target_is_directory=True)
    path = project / "closerange.toml"
    text = path.read_text(encoding="utf-8")
    changed = {
        "target": text.replace('"plate.toml"', f'"{unsafe}"'),
        "control": text.replace('"control.csv"', f'"{unsafe}"'),
        "crops": text.replace("[calibration]", f'[calibration]\ncrops = "{unsafe}"'),
        "images": text.replace("calibration/left_*.png", unsafe),
        "folder": text + f'\n[outputs]\nfolder = "{unsafe}"\n',
    }[key]
    assert changed != text
    path.write_text(changed, encoding="utf-8")
    run_refused(2, unsafe, "project")
    assert outside.read_text(encoding="utf-8") == "secret\n"


@pytest.mark.parametrize("odd", ["\\u0000", "loop", ".", "calibration", "/", "~/x.csv", "$HOME/x"])
@pytest.mark.parametrize("key", ["target", "control", "images"])
def test_item_49_paths_that_are_none(project, run_refused, odd, key):
    (project / "loop").symlink_to(project / "loop")
    path = project / "closerange.toml"
    text = path.read_text(encoding="utf-8")
    old = {"target": "plate.toml", "control": "control.csv", "images": "calibration/left_*.png"}
    path.write_text(text.replace(old[key], odd), encoding="utf-8")
    run_refused(2)


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ("closerange.project/1", "closerange.project/9", "schema"),
        ('target = "plate.toml"', "", "target"),
        ('target = "plate.toml"', "target = 3", "target"),
        ('target = "plate.toml"', 'target = "plate.toml"\ncolour = "red"', "colour"),
        ("[calibration]", "[calibration", "closerange.toml"),
        ("_(z.*)$", "_(z.*", "regular expression"),
        ("calibration/left_*", "calibration/front_*", "front_"),
    ],
)
def test_item_47_malformed_project(project, run_refused, old, new, words):
    path = project / "closerange.toml"
    text = path.read_text(encoding="utf-8")
    assert old in text
    path.write_text(text.replace(old, new, 1), encoding="utf-8")
    run_refused(2, words)


def test_a_folder_that_is_no_result_is_never_replaced(project, run):
    results = project / "results"
    results.mkdir()
    (results / "thesis.txt").write_text("years of work", encoding="utf-8")
    for options in ([], ["--overwrite"]):
        outcome = run("run", project / "closerange.toml", *options)
        assert outcome.code == 2
        assert "results" in outcome.stderr
        assert names_in(results) == ["thesis.txt"]


@pytest.mark.parametrize("options", [[], ["--overwrite"]])
def test_results_do_not_replace_the_project(project, run, options):
    (project / "run.json").write_text("{}", encoding="utf-8")
    before = names_in(project)
    for folder in (project, project.parent):
        outcome = run("run", project / "closerange.toml", "--output", folder, *options)
        assert outcome.code == 2
        assert "the project lies in it" in outcome.stderr
        assert names_in(project) == before


def test_results_below_a_file(project, run):
    outcome = run("run", project / "closerange.toml", "--output", project / "plate.toml" / "here")
    assert outcome.code == 2
    assert "plate.toml: is a file" in outcome.stderr


def test_refused_run_makes_no_folders_on_the_way(project, run):
    (project / "control.csv").unlink()
    output = project / "new" / "results"
    assert run("run", project / "closerange.toml", "--output", output).code == 2
    assert not (project / "new").exists()
