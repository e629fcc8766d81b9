"""One example for each verb, which works as it stands after ``closerange demo``."""

from __future__ import annotations

EXAMPLES = {
    "detect": (
        "closerange detect closerange-demo/inputs/calibration/left_*.png",
        "--target closerange-demo/inputs/plate.toml --camera left",
        "--placement-pattern '_(z.*)$' -o left.csv",
    ),
    "calibrate": (
        "closerange calibrate closerange-demo/calibration-points.csv",
        "--control closerange-demo/inputs/control.csv",
        "--image-size left=640x512 --image-size right=640x512 -o rig.json",
    ),
    "match": (
        "closerange match closerange-demo/rig.json",
        "left=closerange-demo/inputs/blocks/left.png",
        "right=closerange-demo/inputs/blocks/right.png",
        "--edges --z -52 28 -o matches.csv --overlay match-pictures",
    ),
    "volume": ("closerange volume closerange-demo/rig.json --z -50 30 --plot volume.svg",),
    "measure": (
        "closerange measure closerange-demo/rig.json",
        "closerange-demo/single-point-points.csv -o positions.csv",
    ),
    "verify": (
        "closerange verify single-point closerange-demo/single-point-positions.csv",
        "--truth closerange-demo/inputs/verify/truth.csv",
        "-o result.json --report report.html",
    ),
    "run": ("closerange run closerange-demo/inputs/closerange.toml",),
    "demo": ("closerange demo --output closerange-demo",),
    "report": ("closerange report closerange-demo/run.json -o report.html",),
    "shapes": (
        "closerange shapes teach closerange-demo/inputs/calibration/left_z+00.0.png",
        "--name disc --at 317 241 -o shapes.json",
    ),
    "shapes teach": (
        "closerange shapes teach closerange-demo/inputs/calibration/left_z+00.0.png",
        "--name disc --at 317 241 -o shapes.json",
    ),
    "shapes find": (
        "closerange shapes find closerange-demo/inputs/calibration/left_z+50.0.png",
        "--shapes shapes.json --camera left -o shape-points.csv",
    ),
}


def epilog(verb: str) -> str:
    r"""Return the end of a verb's help: lines that a shell joins, which may be pasted as one.

    Parameters
    ----------
    verb : str
        Its name.

    Returns
    -------
    str
        Text whose first character, ``\b``, keeps the help from breaking its lines anew.
    """
    after = "" if verb == "demo" else " (after closerange demo)"
    return f"\b\nExample{after}:\n  " + " \\\n    ".join(EXAMPLES[verb])


def line(verb: str) -> str:
    """Return a verb's example as one line.

    Parameters
    ----------
    verb : str
        Its name.

    Returns
    -------
    str
        The command.
    """
    return " ".join(EXAMPLES[verb])
