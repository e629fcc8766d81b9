"""The positions table: the public contract of results."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from closerange.errors import CloseRangeWarning, TableError
from closerange.flags import Flag
from closerange.position.positions import Positions
from closerange.position.positions_table import read_positions, write_positions

HEADER = (
    "placement,point,x_mm,y_mm,z_mm,cov_xx_mm2,cov_xy_mm2,cov_xz_mm2,cov_yy_mm2,cov_yz_mm2,"
    "cov_zz_mm2,residual_px,cameras,flags"
)


NOISE = "noise_xx_mm2,noise_xy_mm2,noise_xz_mm2,noise_yy_mm2,noise_yz_mm2,noise_zz_mm2"


def positions(reading=("", "", ""), *, noise=False):
    rng = np.random.default_rng(1)
    root = rng.normal(size=(3, 3, 3))
    cov = root @ np.swapaxes(root, 1, 2)
    cov = (cov + np.swapaxes(cov, 1, 2)) / 2
    cov[1] = np.nan
    xyz = rng.normal(size=(3, 3)) / 3
    xyz[1] = np.nan
    return Positions(
        placement=("", "z 1.0", "z 1.0"),
        point=("a", "01", "1"),
        xyz_mm=xyz,
        cov_mm2=cov,
        residual_px=np.array([0.1, np.nan, 1 / 3]),
        cameras=np.array([2, 1, 3]),
        flags=np.array([0, int(Flag.single_view), int(Flag.residual | Flag.blurred)]),
        reading=reading,
        noise_cov_mm2=cov / 7 if noise else np.array(np.nan),
    )


@pytest.fixture
def read(tmp_path):
    def of(text):
        path = tmp_path / "positions.csv"
        path.write_text(text, "utf-8")
        return read_positions(path)

    return of


def test_columns_are_those_of_the_contract(tmp_path):
    positions().to_csv(tmp_path / "p.csv")
    lines = (tmp_path / "p.csv").read_text().splitlines()
    assert lines[0] == HEADER
    assert lines[2] == "z 1.0,01" + "," * 11 + "1,single_view"


def test_reading_joins_the_key_when_there_is_one(tmp_path):
    positions(("1", "1", "2")).to_csv(tmp_path / "p.csv")
    assert (tmp_path / "p.csv").read_text().startswith("placement,reading,point,")
    assert read_positions(tmp_path / "p.csv").reading == ("1", "1", "2")


@pytest.mark.parametrize("noise", [False, True])
@pytest.mark.parametrize("reading", [("", "", ""), ("1", "1", "2")])
def test_round_trip_is_exact_and_byte_identical(tmp_path, reading, noise):
    written = positions(reading, noise=noise)
    written.to_csv(tmp_path / "a.csv")
    back = read_positions(tmp_path / "a.csv")
    assert back.keys() == written.keys()
    for name in ("xyz_mm", "cov_mm2", "noise_cov_mm2", "residual_px", "cameras", "flags"):
        np.testing.assert_array_equal(getattr(back, name), getattr(written, name))
    assert back.dof is None
    write_positions(back, tmp_path / "b.csv")
    assert (tmp_path / "a.csv").read_bytes() == (tmp_path / "b.csv").read_bytes()


def test_noise_has_columns_where_there_is_any(tmp_path):
    positions(noise=True).to_csv(tmp_path / "p.csv")
    header = (tmp_path / "p.csv").read_text().splitlines()[0]
    assert header == HEADER.replace(",residual_px", f",{NOISE},residual_px")


def test_five_columns_are_enough(read):
    back = read("z_mm,y_mm,x_mm,point,placement\n3,2,1,a,\n")
    assert back.xyz_mm.tolist() == [[1, 2, 3]]
    assert np.isnan(back.cov_mm2).all()
    assert back.noise_cov_mm2.shape == (1, 3, 3)
    assert np.isnan(back.noise_cov_mm2).all()
    assert back.cameras.tolist() == [0]
    assert back.measured.tolist() == [True]


def test_a_row_without_position_needs_a_flag(read):
    back = read("placement,point,x_mm,y_mm,z_mm,flags\n,a,1,,,single_view\n")
    assert np.isnan(back.xyz_mm).all()
    assert back.measured.tolist() == [False]
    with pytest.raises(TableError, match=r"row 2, .*no flag"):
        read("placement,point,x_mm,y_mm,z_mm\n,a,1,2,\n")


def test_a_row_that_appears_twice(read):
    with pytest.raises(TableError, match="is also in row 2") as caught:
        read("placement,point,x_mm,y_mm,z_mm\np,a,1,2,3\np,a,1,2,4\n")
    assert "reading" in caught.value.remedy
    assert len(read("placement,reading,point,x_mm,y_mm,z_mm\np,1,a,1,2,3\np,2,a,1,2,4\n")) == 2


@pytest.mark.parametrize("terms", ["1,2,0,1,0,1", "-1,0,0,1,0,1", "1,0,0,1,0,", "0,0,0,0,0,0"])
def test_what_is_not_a_covariance_is_refused(read, terms):
    with pytest.raises(TableError, match=r"row 2, .*positive definite"):
        read(f"{HEADER}\n,a,1,2,3,{terms},0.1,2,\n")
    with pytest.raises(TableError, match=r"row 2, column 'noise_xx_mm2': .*positive definite"):
        read(f"placement,point,x_mm,y_mm,z_mm,{NOISE}\n,a,1,2,3,{terms}\n")


@pytest.mark.parametrize("count", ["1.5", "-1", "x"])
def test_cameras_are_counted(read, count):
    with pytest.raises(TableError, match="row 2, column 'cameras'"):
        read(f"{HEADER}\n,a,1,2,3,1,0,0,1,0,1,0.1,{count},\n")


def test_unknown_flags_and_columns(read):
    with pytest.raises(TableError, match="row 2, column 'flags': unknown flag"):
        read(f"{HEADER}\n,a,1,2,3,1,0,0,1,0,1,0.1,2,broken\n")
    with pytest.warns(CloseRangeWarning, match="colour"):
        read("placement,point,x_mm,y_mm,z_mm,colour\n,a,1,2,3,red\n")


def test_select():
    whole = positions(noise=True)
    np.testing.assert_array_equal(whole.select([2, 0]).noise_cov_mm2, whole.noise_cov_mm2[[2, 0]])
    assert whole.select(whole.measured).point == ("a", "1")
    assert whole.select([2, 0]).flags.tolist() == [int(Flag.residual | Flag.blurred), 0]
    assert len(whole.select([])) == 0


def test_degrees_of_freedom_are_carried(tmp_path):
    """A 95 % region read from a file is the one that was measured."""
    replace(positions(), dof=96).to_csv(tmp_path / "p.csv")
    lines = (tmp_path / "p.csv").read_text().splitlines()
    assert lines[0] == HEADER.replace("residual_px", "dof,residual_px")
    assert read_positions(tmp_path / "p.csv").dof == 96


ROWS = "placement,point,x_mm,y_mm,z_mm,dof\n,a,1,2,3,{}\n,b,1,2,3,{}\n"


@pytest.mark.parametrize(("cells", "dof"), [(("96", "40"), 40), (("96", ""), 96), (("", ""), None)])
def test_of_different_degrees_of_freedom_the_smallest_counts(read, cells, dof):
    assert read(ROWS.format(*cells)).dof == dof


@pytest.mark.parametrize("cell", ["0", "-3", "1.5", "1e20"])
def test_impossible_degrees_of_freedom(read, cell):
    with pytest.raises(TableError, match=r"row 2.*not a number of degrees of freedom"):
        read(ROWS.format(cell, "9"))
