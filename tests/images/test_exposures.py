"""Times of exposure: what belongs to one moment."""

from __future__ import annotations

import math

import pytest

from closerange.errors import InputError, TableError
from closerange.images import Exposures, check_exposures, read_exposures


def exposures(*times, placement="p", reading=""):
    """Give cameras a, b, c, ... one time each."""
    return {(chr(97 + i), placement, reading): time for i, time in enumerate(times)}


def check(times, tolerance_s=0.005):
    check_exposures(times, Exposures("times.csv", times), tolerance_s=tolerance_s)


def test_the_first_and_the_last_exposure_of_a_set_count():
    times = exposures(10.0, 10.002, 10.004)
    check(times, 0.005)
    with pytest.raises(
        InputError, match=r"'a' and 'c' took placement 'p' 0\.004 s apart"
    ) as caught:
        check(times, 0.003)
    assert "the limit is 0.003 s; 1 of 1 sets exceed it" in caught.value.message


def test_sets_are_compared_each_for_itself():
    times = exposures(0.0, 0.001, placement="p1") | exposures(60.0, 60.001, placement="p2")
    times |= exposures(90.0, 90.0, placement="p2", reading="1")
    check(times)
    times |= exposures(120.0, 121.0, placement="p2", reading="2")
    with pytest.raises(InputError, match="placement 'p2', reading '2' 1 s apart"):
        check(times)


def test_times_of_images_that_are_not_used_do_no_harm():
    times = exposures(0.0, 99.0, placement="old") | exposures(1.0, 1.0)
    check_exposures(exposures(1.0, 1.0), Exposures("times.csv", times), tolerance_s=0)


def test_epochs_keep_their_milliseconds():
    now = 1_764_000_000.0
    check(exposures(now, now + 0.004))
    with pytest.raises(InputError, match="apart"):
        check(exposures(now, now + 0.006))


def test_a_constant_difference_is_a_matter_of_clocks():
    sets = {}
    for number, delay in enumerate((0.001, -0.002, 0.0)):
        sets |= exposures(number, number + 7.5 + delay, placement=f"p{number}")
    with pytest.raises(InputError, match=r"7\.501 s apart") as caught:
        check(sets)
    assert "differs by the same 7.4995 s in every set" in caught.value.remedy
    sets |= exposures(9.0, 17.5, placement="p9")  # 8.5 s: no longer the same
    with pytest.raises(InputError) as caught:
        check(sets)
    assert "trigger" in caught.value.remedy


def test_an_image_without_a_time():
    with pytest.raises(InputError, match="no time for camera 'c', placement 'p'"):
        check_exposures([("c", "p", "")], Exposures("t.csv", exposures(1.0)), tolerance_s=1)


@pytest.mark.parametrize("tolerance_s", [-0.1, math.nan, math.inf])
def test_a_tolerance_is_a_duration(tolerance_s):
    with pytest.raises(InputError, match="a time tolerance of"):
        check(exposures(1.0, 1.0), tolerance_s)


def test_tables_with_and_without_readings(tmp_path):
    path = tmp_path / "times.csv"
    path.write_text("time_s,placement,camera\n1.5,p,left\n1.6,p,right\n", encoding="utf-8")
    assert read_exposures(path).time_s == {("left", "p", ""): 1.5, ("right", "p", ""): 1.6}
    path.write_text("camera,placement,reading,time_s\nleft,p,0,1\nleft,p,1,2\n", encoding="utf-8")
    assert read_exposures(path).time_s == {("left", "p", "0"): 1.0, ("left", "p", "1"): 2.0}
    path.write_text("camera,placement,time_s\nleft,p,1\nleft,p,2\n", encoding="utf-8")
    with pytest.raises(TableError, match=r"row 3.*camera 'left', placement 'p' has two times"):
        read_exposures(path)
