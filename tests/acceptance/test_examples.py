"""The examples run and say what they promise."""

from __future__ import annotations

import runpy
from pathlib import Path

EXAMPLES = Path(__file__).parents[2] / "examples"


def test_two_cameras_and_a_plate(capsys):
    runpy.run_path(str(EXAMPLES / "two_cameras_and_a_plate.py"), run_name="__main__")
    trust, measured, _ = capsys.readouterr().out.splitlines()
    assert trust.startswith("good: predicted error")
    x, y, z = (float(measured.split()[i]) for i in (1, 6, 11))
    # the rendered truth; a reading is good to 1, 1 and 4 um
    assert abs(x - 30.5003) < 0.004
    assert abs(y - 30.7941) < 0.004
    assert abs(z - 1.5326) < 0.016
