"""The rig file: exact both ways, readable, strict."""

from __future__ import annotations

import copy
import json
import pickle
import sys

import numpy as np
import pytest

from closerange.errors import FileError, SchemaError
from closerange.flags import Flag
from closerange.geometry.transform import RigidTransform, rotation_from_vector
from closerange.rig.camera import Camera
from closerange.rig.distortion import BrownIdeal, BrownObserved
from closerange.rig.rig import Residuals, Rig, Trust
from closerange.rig.rig_file import read_rig, rig_from_document, rig_to_document, write_rig


def make_rig(*, trust: bool = True) -> Rig:
    """Fill every field, with numbers that have no short decimal form."""
    rng = np.random.default_rng(5)
    lenses = (
        BrownIdeal(*rng.normal(0, 0.1, 5)),
        BrownObserved(*rng.normal(0, 1e-9, 5), centre_px=(639.5, 511.5), unit_px=(1 / 3, 1 / 7)),
    )
    cameras = tuple(
        Camera(
            name,
            (1280, 1024),
            [[1300 + rng.normal(), 1 / 3, 640.1], [0, 1300 / 7, 512.3], [0, 0, 1]],
            RigidTransform(rotation_from_vector(rng.normal(size=3)), rng.normal(size=3) * 300),
            lens,
        )
        for name, lens in zip(("links.oben", "camera 2 \u00e9"), lenses, strict=True)
    )
    parameters = tuple(f"{camera.name}.{p}" for camera in cameras for p in ("fx", "k1", "tz"))
    factor = rng.normal(size=(6, 6))
    residual = rng.normal(0, 0.05, (4, 2))
    residual[3] = np.nan
    return Rig(
        cameras=cameras,
        volume_mm=[[-75, -75, -1 / 3], [75, 75, 1e-300]],
        parameters=parameters,
        parameter_cov=factor @ factor.T * 1e-7,
        noise_px=0.1 + 0.2,
        tau_px=0.1 / 3,
        dof=2,
        model="brown",
        residuals=Residuals(
            camera=("links.oben", "links.oben", "camera 2 \u00e9", "camera 2 \u00e9"),
            placement=("", "z 1", "z 1", "z 1"),
            point=("r0c0", "01", "1", 'a "quoted", one'),
            xyz_mm=rng.normal(size=(4, 3)) * 75,
            xy_px=rng.normal(size=(4, 2)) * 500,
            residual_px=residual,
            fitted=[True, True, False, False],
            flags=[0, int(Flag.outlier | Flag.blurred), 0, int(Flag.not_found)],
        ),
        trust=Trust("untrustworthy", [0.004, np.nan, np.inf], [1 / 3, 0, 5e-324], ("why",))
        if trust
        else None,
        report={"fixed": {"skew": 0.0}, "models": [1, None, True, "x"], "empty": {}, "none": []},
        provenance={"version": "0.1", "inputs": {"points.csv": "ab" * 32}, "n": 2**60},
    )


def assert_same(a: Rig, b: Rig) -> None:
    for name in ("parameters", "model", "dof"):
        assert getattr(a, name) == getattr(b, name)
    assert dict(a.report) == dict(b.report)
    assert dict(a.provenance) == dict(b.provenance)
    assert np.float64(a.noise_px).tobytes() == np.float64(b.noise_px).tobytes()
    for name in ("volume_mm", "parameter_cov"):
        assert getattr(a, name).tobytes() == getattr(b, name).tobytes()
    for name in ("camera", "placement", "point"):
        assert getattr(a.residuals, name) == getattr(b.residuals, name)
    for name in ("xyz_mm", "xy_px", "residual_px", "fitted", "flags"):
        assert np.array_equal(
            getattr(a.residuals, name),
            getattr(b.residuals, name),
            equal_nan=name.endswith(("mm", "px")),
        )
    for one, other in zip(a.cameras, b.cameras, strict=True):
        assert (one.name, one.size_px) == (other.name, other.size_px)
        assert one.matrix_px.tobytes() == other.matrix_px.tobytes()
        for name in ("rotation", "translation_mm"):
            mine, theirs = one.camera_from_world, other.camera_from_world
            assert getattr(mine, name).tobytes() == getattr(theirs, name).tobytes()
        assert type(one.distortion) is type(other.distortion)
        for name in ("k1", "k2", "k3", "p1", "p2"):
            assert getattr(one.distortion, name) == getattr(other.distortion, name)
    assert (a.trust is None) == (b.trust is None)
    if a.trust is not None and b.trust is not None:
        assert (a.trust.verdict, a.trust.reasons) == (b.trust.verdict, b.trust.reasons)
        for name in ("predicted_mm", "calibration_mm"):
            assert np.array_equal(getattr(a.trust, name), getattr(b.trust, name), equal_nan=True)


@pytest.mark.parametrize("trust", [True, False])
def test_round_trip_is_exact_and_rewrites_the_same_bytes(tmp_path, trust):
    rig = make_rig(trust=trust)
    write_rig(rig, tmp_path / "a.json")
    back = read_rig(tmp_path / "a.json")
    assert_same(rig, back)
    observed = back.cameras[1].distortion
    assert observed.unit_px.tolist() == [1 / 3, 1 / 7]
    assert observed.centre_px.tolist() == [639.5, 511.5]
    write_rig(back, tmp_path / "b.json")
    assert (tmp_path / "a.json").read_bytes() == (tmp_path / "b.json").read_bytes()


def test_document_round_trip_without_a_file():
    rig = make_rig()
    document = rig_to_document(rig)
    json.dumps(document, allow_nan=False)
    assert_same(rig, rig_from_document(document))


def test_a_bare_rig_round_trips(tmp_path):
    rig = make_rig()
    bare = Rig(
        cameras=rig.cameras[:1],
        volume_mm=rig.volume_mm,
        parameters=(),
        parameter_cov=np.empty((0, 0)),
        noise_px=float("nan"),
        dof=0,
        model="dlt",
        residuals=Residuals(
            (), (), (), np.empty((0, 3)), np.empty((0, 2)), np.empty((0, 2)), [], []
        ),
        trust=Trust("untrustworthy", [np.nan] * 3, [np.nan] * 3, ("nothing is known",)),
    )
    write_rig(bare, tmp_path / "a.json")
    assert_same(bare, read_rig(tmp_path / "a.json"))


def test_a_person_can_read_it(tmp_path):
    write_rig(make_rig(), tmp_path / "a.json")
    lines = (tmp_path / "a.json").read_text(encoding="utf-8").splitlines()
    assert lines[1] == ' "schema": "closerange.rig/2",'
    assert '  "predicted_mm": [0.004, null, "infinite"],' in lines
    row = next(line for line in lines if '"z 1", "01"' in line)  # one residual, one line
    assert row.rstrip(",").endswith('true, "blurred|outlier"]')
    assert any("\u00e9" in line for line in lines)
    assert len(lines) < 110  # 97: three rows of a matrix are three lines


def test_numpy_values_in_a_report_are_written_as_numbers(tmp_path):
    rig = make_rig()
    odd = {"a": np.float64(0.5), "b": np.arange(3), "c": (1, 2), "d": float("nan"), "e": np.True_}
    changed = Rig(
        rig.cameras, rig.volume_mm, rig.parameters, rig.parameter_cov, rig.noise_px, rig.dof,
        rig.model, rig.residuals, report=odd,
    )  # fmt: skip
    write_rig(changed, tmp_path / "a.json")
    assert read_rig(tmp_path / "a.json").report == {
        "a": 0.5, "b": [0, 1, 2], "c": [1, 2], "d": None, "e": True,
    }  # fmt: skip


def test_what_cannot_be_read_back_is_not_written(tmp_path):
    rig, path = make_rig(), tmp_path / "a.json"
    path.write_text("old")
    camera = rig.cameras[0]
    holed = Camera("a", (10, 10), [[np.nan, 0, 0], [0, 1, 0], [0, 0, 1]], camera.camera_from_world)
    for cameras, noise, report in (
        ((holed,), 0.1, {}),
        (rig.cameras, float("inf"), {}),
        (rig.cameras, 0.1, {"x": object()}),
        (rig.cameras, 0.1, {"x": float("inf")}),
    ):
        bad = Rig(
            cameras, rig.volume_mm, (), np.empty((0, 0)), noise, 1, "brown",
            Residuals((), (), (), np.empty((0, 3)), np.empty((0, 2)), np.empty((0, 2)), [], []),
            report=report,
        )  # fmt: skip
        with pytest.raises(SchemaError):
            write_rig(bad, path)
    assert path.read_text() == "old"


def changed(*steps, value):
    """Return an edit of a document: follow the steps, set or delete the last."""

    def edit(document):
        place = document
        for step in steps[:-1]:
            place = place[step]
        if value is ...:
            del place[steps[-1]]
        else:
            place[steps[-1]] = value

    return edit


IDENTITY = [[1, 0, 0], [0, 1, 0], [0, 0, 1]]
MIRRORED = [[1, 0, 0], [0, 1, 0], [0, 0, -1]]
BROKEN = {
    "other schema": (("schema",), "closerange.target/1", "not a rig file"),
    "no schema": (("schema",), ..., "not a rig file: schema nothing"),
    "later version": (("schema",), "closerange.rig/3", "reads 'closerange.rig/2' and 'closera"),
    "missing key": (("noise_px",), ..., "missing key 'noise_px'"),
    "missing lens": (("cameras", 1, "distortion"), ..., r"cameras\[1\]'.*missing key 'distortion'"),
    "unknown key": (("cameras", 0, "distortion", "k4"), 0.1, r"cameras\[0\].distortion.*'k4'"),
    "unknown lens": (("cameras", 0, "distortion", "model"), "kannala", "lens model 'kannala'"),
    "no cameras": (("cameras",), [], "or there is none"),
    "same names": (("cameras", 1, "name"), "links.oben", "not different"),
    "empty name": (("cameras", 1, "name"), "", "text is empty"),
    "reflection": (
        ("cameras", 0, "camera_from_world", "rotation"), MIRRORED,
        r"cameras\[0\].camera_from_world.*det R = -1",
    ),
    "no rotation": (
        ("cameras", 0, "camera_from_world", "rotation"), [[2, 0, 0], *IDENTITY[1:]],
        "not orthonormal",
    ),
    "null in a pose": (
        ("cameras", 0, "camera_from_world", "translation_mm"), [1, None, 2],
        r"translation_mm\[1\]'.*found nothing",
    ),
    "negative focus": (
        ("cameras", 1, "matrix_px"), [[-1300, 0, 640], [0, 1300, 512], [0, 0, 1]], "fx, fy > 0",
    ),
    "wrong shape": (("cameras", 1, "matrix_px"), IDENTITY[:2], "2 entries, expected 3"),
    "ragged": (("cameras", 1, "matrix_px", 1), [0, 1], r"matrix_px\[1\]'.*2 entries, expected 3"),
    "text as number": (("cameras", 1, "matrix_px", 0, 0), "1300", r"matrix_px\[0\]\[0\].*'1300'"),
    "true as number": (("noise_px",), True, "expected a number, found True"),
    "endless integer": (("noise_px",), 10**400, "integer of 1329 bits is not finite"),
    "negative noise": (("noise_px",), -0.1, "negative"),
    "no noise": (("noise_px",), 0, "no image is free of noise"),
    "unknown noise": (("noise_px",), None, "nothing would say so"),
    "unknown covariance": (("parameter_cov",), [[None] * 6] * 6, "nothing would say so"),
    "unknown freedom": (("dof",), 0, "nothing would say so"),
    "negative tau": (("tau_px",), -0.1, "negative"),
    "unknown tau": (("tau_px",), None, "expected a number, found nothing"),
    "tau in version 1": (("schema",), "closerange.rig/1", "unknown key 'tau_px'"),
    "size": (("cameras", 0, "size_px"), [1280, 0], "0 is not within 1"),
    "fraction of a pixel": (("cameras", 0, "size_px"), [1280.5, 10], "expected a whole number"),
    "three sizes": (("cameras", 0, "size_px"), [1280, 10, 3], "3 entries, expected 2"),
    "volume upside down": (("volume_mm",), [[1, 1, 1], [0, 2, 2]], "lower corner"),
    "covariance size": (("parameter_cov",), [[1.0]], "1 entries, expected 6"),
    "asymmetric": (("parameter_cov", 0, 1), 1.0, r"entries \[0\]\[1\] and \[1\]\[0\]"),
    "half unknown": (("parameter_cov", 2, 1), None, "not symmetric"),
    "negative variance": (("parameter_cov", 3, 3), -1e-9, "variance 3 is negative"),
    "unknown parameter": (("parameters", 0), "links.oben.f", "'links.oben.f' is not a camera"),
    "parameter of no camera": (("parameters", 0), "left.fx", "'left.fx' is not a camera"),
    "parameter twice": (("parameters", 1), "links.oben.fx", "stands twice"),
    "verdict": (("trust", "verdict"), "superb", r"key 'trust'.*'superb' is not good"),
    "unit": (("cameras", 1, "distortion", "unit_px"), [0, 1], "unit of length 0"),
    "columns": (("residuals", "columns", 0), "kamera", "residuals.columns"),
    "short row": (("residuals", "rows", 2), ["a"], r"residuals.rows\[2\]'.*1 entries, expected 12"),
    "unknown flag": (("residuals", "rows", 0, 11), "dirty", "unknown flag 'dirty'"),
    "stranger": (("residuals", "rows", 0, 0), "right", "camera 'right' is not in the rig"),
    "fitted": (("residuals", "rows", 0, 10), 1, "expected true or false, found 1"),
    "list as object": (("report",), [], "expected an object, found a list of 0"),
    "object as list": (("cameras",), {}, "expected a list"),
    "dof": (("dof",), -1, "-1 is not within 0"),
}  # fmt: skip


@pytest.mark.parametrize("name", BROKEN)
def test_broken_files_are_refused_with_file_key_and_remedy(tmp_path, name):
    steps, value, message = BROKEN[name]
    document = copy.deepcopy(rig_to_document(make_rig()))
    document["trust"]["verdict"] = "fair"
    changed(*steps, value=value)(document)
    path = tmp_path / "broken.json"
    path.write_text(json.dumps(document), encoding="utf-8")
    with pytest.raises(SchemaError, match=message) as caught:
        read_rig(path)
    assert str(path) in caught.value.message
    assert caught.value.remedy
    assert caught.value.exit_code == 2


def test_unknown_covariance_of_an_untrustworthy_rig_is_read_as_nan_in_pairs():
    document = rig_to_document(make_rig())
    document["parameter_cov"] = [[None] * 6 for _ in range(6)]
    document["trust"]["verdict"] = "untrustworthy"
    rig = rig_from_document(document)
    assert np.isnan(rig.parameter_cov).all()
    assert not rig.trusted
    document["trust"] = None  # nothing would mark what is measured with it
    with pytest.raises(SchemaError, match="nothing would say so"):
        rig_from_document(document)


def test_a_file_of_version_1_is_read_without_what_covariances_leave_out():
    document = rig_to_document(make_rig())
    assert document["tau_px"] == 0.1 / 3
    old = {key: value for key, value in document.items() if key != "tau_px"}
    rig = rig_from_document({**old, "schema": "closerange.rig/1"})
    assert rig.tau_px == 0.0
    assert_same(rig, rig_from_document(rig_to_document(rig)))  # written as version 2
    with pytest.raises(SchemaError, match="missing key 'tau_px'"):
        rig_from_document(old)


@pytest.mark.parametrize("text", ["[]", "3", "null", '"closerange.rig/1"', "{}"])
def test_other_json_is_not_a_rig(tmp_path, text):
    path = tmp_path / "a.json"
    path.write_text(text)
    with pytest.raises(SchemaError, match="not a rig file"):
        read_rig(path)


def test_json_that_breaks_the_dialect_is_refused(tmp_path):
    path = tmp_path / "a.json"
    for text, message in (
        ('{"schema": "closerange.rig/1", "schema": "x"}', "appears twice"),
        ('{"schema": "closerange.rig/1", "noise_px": 1e999}', "not a finite number"),
        ('{"schema": "closerange.rig/1", "noise_px": NaN}', "not a finite number"),
        ("[" * 40 + "]" * 40, "deeper than 32"),
        ('{"schema": "closerange.rig/1",', "line 1"),
    ):
        path.write_text(text)
        with pytest.raises(SchemaError, match=message):
            read_rig(path)


class Trap:
    """Would run code if it were unpickled."""

    def __reduce__(self):
        return sys.exit, ("unpickled",)


def test_pickles_archives_and_yaml_are_refused_unread(tmp_path):
    for protocol in (0, 2, 5):
        path = tmp_path / f"protocol{protocol}.json"
        path.write_bytes(pickle.dumps(Trap(), protocol=protocol))
        with pytest.raises((SchemaError, FileError)):
            read_rig(path)
    archive = tmp_path / "rig.npz"
    np.savez(archive, cameras=np.array([Trap], dtype=object))
    with pytest.raises((SchemaError, FileError)):
        read_rig(archive)
    yaml = tmp_path / "rig.yaml"
    yaml.write_text("!!python/object/apply:os.system ['true']\n")
    with pytest.raises(SchemaError):
        read_rig(yaml)
    with pytest.raises(FileError, match="no such file"):
        read_rig(tmp_path / "none.json")
