"""The verb `demo`: the whole chain on images that come with the program."""

from __future__ import annotations

from importlib.resources import as_file, files
from pathlib import Path

from closerange.workflows.run import Announce, RunResult, run

FOLDER = "closerange-demo"


def demo(
    output: Path | str = FOLDER, *, overwrite: bool = False, announce: Announce | None = None
) -> RunResult:
    """Calibrate two cameras, measure 90 positions, bars and blocks, and verify them.

    Parameters
    ----------
    output : Path or str, optional
        Folder of the results; its folder ``inputs`` gets the images, targets and tables.
    overwrite : bool, optional
        Replace an existing folder of results.
    announce : callable, optional
        Called with (what is being done, done, total).

    Returns
    -------
    RunResult
        As `run`.

    Raises
    ------
    FileError
        If the folder exists already or cannot be written.
    """
    with as_file(files("closerange.workflows") / "demo_data") as folder:
        return run(
            folder / "closerange.toml",
            output=output,
            overwrite=overwrite,
            keep_inputs=True,
            announce=announce,
        )
