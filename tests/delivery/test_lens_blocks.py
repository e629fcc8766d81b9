"""The radial distortion of a rig's lenses in a report."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from closerange.delivery.calibration_section import calibration_section
from closerange.delivery.lens_blocks import lens_blocks
from closerange.delivery.sheet import Contents
from closerange.rig.distortion import BrownIdeal, BrownObserved


def test_table_says_how_far_out_a_point_lies(rig):
    words, figure, table = lens_blocks(rig.cameras)
    assert "dr is subtracted" in words.text
    assert figure.picture.count("Camera left") == 1
    assert table.head == ("r [px]", "dr of left [px]", "dr of right [px]")
    radii = [float(row[0]) for row in table.rows]
    assert radii == [50 * i for i in range(9)]  # the corner lies at 400 px
    # k1 = -0.1, f = 2000: r_d = r (1 - 0.1 r^2)
    ideal = np.linspace(0, 0.21, 2001)
    observed = 2000 * ideal * (1 - 0.1 * ideal**2)
    for row, radius in zip(table.rows, radii, strict=True):
        delta = radius - 2000 * np.interp(radius, observed, ideal)
        assert float(row[1]) == pytest.approx(delta, abs=0.001)
        assert row[1] == row[2]


def test_a_lens_beyond_its_range_has_no_number_there(rig):
    first, second = rig.cameras
    folding = replace(second, distortion=BrownIdeal(k1=-12.0))
    table = lens_blocks((first, folding))[2]
    assert table.rows[-1][1] not in ("\u2013", "0.000")
    assert table.rows[-1][2] == "\u2013"


def test_rigs_without_distortion_say_nothing(rig):
    plain = tuple(replace(camera, distortion=BrownIdeal()) for camera in rig.cameras)
    assert lens_blocks(plain) == []


def test_it_stands_in_the_section_on_the_calibration(rig):
    captions = [getattr(b, "caption", "") for b in calibration_section(Contents("t", rig)).blocks]
    assert sum("Radial distortion" in caption for caption in captions) == 2


def test_corrections_of_observed_points_have_the_other_sign(rig):
    lens = BrownObserved(k1=1e-8, centre_px=np.array([320.0, 240.0]))
    table = lens_blocks((replace(rig.cameras[0], distortion=lens),))[2]
    # eq. (6.5) adds k1 r^3, so the point lay too near to the centre by as much
    assert [row[1] for row in table.rows][-1] == "-0.640"
