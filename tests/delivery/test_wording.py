import math

import pytest

from closerange.delivery.wording import (
    DASH,
    FLAG_WORDS,
    counted,
    fixed,
    flag_names,
    micrometres,
    mm,
    percent,
    printed,
    short_length,
    significant,
    three_micrometres,
)
from closerange.flags import Flag


def test_every_flag_is_explained():
    assert set(FLAG_WORDS) == set(Flag)


@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf])
def test_what_is_not_known_is_a_dash(value):
    assert {f(value) for f in (mm, micrometres, significant, short_length, percent)} == {DASH}
    assert fixed(value, 3) == DASH


def test_numbers():
    assert mm(-0.0001) == "0.000"
    assert mm(12.34567) == "12.346"
    assert micrometres(0.00912) == "9.1"
    assert micrometres(0.0123) == "12"
    assert short_length(0.0042) == "4.2 µm"
    assert short_length(1.254) == "1.25 mm"
    assert three_micrometres([0.004, 0.0051, 0.012]) == "4.0 µm (X) 5.1 µm (Y) 12 µm (Z)"
    assert significant(0.0132) == "0.0132"
    assert significant(1.5e-9, 2) == "1.5e-09"
    assert percent(0.944) == "94.4 %"


def test_micrometres_of_terminal_texts_are_set_properly():
    assert printed("40 um (X), album um") == "40 µm (X), album um"


def test_counts_and_flags():
    assert counted(1, "camera") == "1 camera"
    assert counted(2, "camera") == "2 cameras"
    assert flag_names(int(Flag.saturated | Flag.at_border)) == ["at_border", "saturated"]
