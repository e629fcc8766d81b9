"""Bad images through the command line: items 1 to 25 of the list of bad inputs.

Each test is named after its item and feeds the file itself. Good images are those that come with
the package: a plate of nine discs, 640 x 512 px, 8 bits.
"""

from __future__ import annotations

import csv
import json
import shutil
import struct
import zlib

import cv2
import numpy as np
import pytest

from closerange.workflows.detect import detect

GOOD = "left_z+00.0.png"


@pytest.fixture(scope="session")
def good(demo_data):
    """Pixels of a good image."""
    return cv2.imread(str(demo_data / "calibration" / GOOD), cv2.IMREAD_UNCHANGED)


@pytest.fixture
def plate(demo_data):
    return demo_data / "plate.toml"


@pytest.fixture
def looking(plate):
    """Return the arguments of ``detect`` without ``-o``."""

    def args(*images, target=plate):
        return ["detect", *images, "--target", target, "--camera", "left"]

    return args


@pytest.fixture
def detected(run, looking, tmp_path):
    """Detect in images that are not refused; return outcome and rows."""

    def read(*images, **options):
        output = tmp_path / "points.csv"
        outcome = run(*looking(*images, **options), "-o", output)
        assert output.is_file(), outcome.stderr
        with output.open(newline="", encoding="utf-8") as stream:
            return outcome, list(csv.DictReader(stream))

    return read


def xy(rows):
    return np.array([[float(row["x_px"] or "nan"), float(row["y_px"] or "nan")] for row in rows])


def flags(rows):
    return [set(filter(None, row["flags"].split("|"))) for row in rows]


def save(path, pixels, *options):
    """Encode by the path's ending."""
    assert cv2.imwrite(str(path), pixels, list(options))
    return path


@pytest.fixture(scope="session")
def truth(good, tmp_path_factory, demo_data):
    """Centres in the good image, from the same program: what odd formats must give too."""
    path = save(tmp_path_factory.mktemp("truth") / GOOD, good)
    points = detect(path, target=demo_data / "plate.toml", camera="left")
    assert not points.flags.any()
    return points.xy_px


def test_the_good_image_gives_nine_points_and_no_warning(detected, demo_data):
    outcome, rows = detected(demo_data / "calibration" / GOOD)
    assert (outcome.code, outcome.stderr) == (0, "")
    assert [row["point"] for row in rows] == [f"r{r}c{c}" for r in range(3) for c in range(3)]
    assert flags(rows) == [set()] * 9


def test_item_01_missing_image(refused, looking, tmp_path):
    refused(looking(tmp_path / "none.png"), 2, "none.png", "o such file")


def test_item_01_folder_without_images(refused, looking, tmp_path):
    (tmp_path / "empty").mkdir()
    refused(looking(tmp_path / "empty"), 2, "empty")


def test_item_01_missing_target(refused, looking, demo_data, tmp_path):
    image = demo_data / "calibration" / GOOD
    refused(looking(image, target=tmp_path / "none.toml"), 2, "none.toml")


@pytest.mark.parametrize("ending", ["png", "jpg", "tif", "bmp"])
def test_item_02_empty_file(refused, looking, tmp_path, ending):
    path = tmp_path / f"image.{ending}"
    path.touch()
    refused(looking(path), 2, path.name, "empty")


@pytest.mark.parametrize("share", [0.001, 0.3, 0.7, 0.98])
@pytest.mark.parametrize("ending", ["png", "jpg", "tif", "bmp"])
def test_item_03_truncated_file(refused, looking, good, tmp_path, ending, share):
    path = save(tmp_path / f"image.{ending}", good)
    content = path.read_bytes()
    path.write_bytes(content[: int(share * len(content))])
    refused(looking(path), 2, path.name)


def test_item_03_one_bad_image_among_good_ones(refused, looking, demo_data, good, tmp_path):
    bad = save(tmp_path / "bad.png", good)
    bad.write_bytes(bad.read_bytes()[:5000])
    refused(looking(demo_data / "calibration" / GOOD, bad), 2, "bad.png")


@pytest.mark.parametrize(
    "content", [b"GIF89a" + bytes(99), b"%PDF-1.7\n", b"\x80\x04\x95", b"text"]
)
def test_item_04_no_image_at_all(refused, looking, tmp_path, content):
    path = tmp_path / "image.png"
    path.write_bytes(content)
    refused(looking(path), 2, "image.png")


@pytest.mark.parametrize(("real", "claimed"), [("png", "tif"), ("tif", "png"), ("bmp", "jpg")])
def test_item_04_wrong_ending_is_read_by_content(detected, good, truth, tmp_path, real, claimed):
    path = tmp_path / f"image.{claimed}"
    save(tmp_path / f"image.{real}", good).rename(path)
    outcome, rows = detected(path)
    assert outcome.code == 0
    name = {"tif": "TIFF"}.get(real, real.upper())
    assert f"warning: {path}: is a {name} file by its content" in outcome.stderr
    np.testing.assert_array_equal(xy(rows), truth)


def png_of(width, height):
    """Return a PNG whose header claims a size, with hardly any pixels."""

    def chunk(kind, body):
        check = struct.pack(">I", zlib.crc32(kind + body))
        return struct.pack(">I", len(body)) + kind + body + check

    header = struct.pack(">IIBBBBB", width, height, 8, 0, 0, 0, 0)
    pixels = zlib.compress(bytes(100))
    return (
        b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", header) + chunk(b"IDAT", pixels) + chunk(b"IEND", b"")
    )


@pytest.mark.parametrize("size", [(100_000, 100_000), (2**31 - 1, 2**31 - 1), (30_000, 30_000)])
def test_item_05_giant_header(refused, looking, tmp_path, size, monkeypatch):
    def never(*_args, **_kwargs):
        raise AssertionError("the pixels were decoded")

    monkeypatch.setattr(cv2, "imdecode", never)
    path = tmp_path / "bomb.png"
    path.write_bytes(png_of(*size))
    refused(looking(path), 2, "bomb.png", str(size[0]))


def test_item_06_tiff_of_several_pages(refused, looking, good, tmp_path):
    path = tmp_path / "pages.tif"
    assert cv2.imwritemulti(str(path), [good, good, good])
    refused(looking(path), 2, "pages.tif", "3 images", "page")


@pytest.mark.parametrize("value", [0.5, np.nan, np.inf])
@pytest.mark.parametrize("kind", [np.float32, np.float64])
def test_item_07_floating_point_pixels(refused, looking, good, tmp_path, value, kind):
    pixels = good.astype(kind)
    pixels[100:110, 100:110] = value
    refused(looking(save(tmp_path / "float.tif", pixels)), 2, "float.tif")


@pytest.mark.parametrize("ending", ["png", "tif"])
def test_item_07_sixteen_bits_are_kept(detected, good, truth, tmp_path, ending):
    """Grey values that 8 bits would all make 0 or 1: only the low byte holds the picture."""
    outcome, rows = detected(save(tmp_path / f"deep.{ending}", good.astype(np.uint16)))
    assert (outcome.code, outcome.stderr) == (0, "")
    np.testing.assert_allclose(xy(rows), truth, atol=1e-3)


def tiff_of(pixels, photometric):
    """Return an uncompressed TIFF of one strip."""
    height, width = pixels.shape
    bits = 8 * pixels.dtype.itemsize
    entries = [
        (256, 4, width), (257, 4, height), (258, 3, bits), (259, 3, 1), (262, 3, photometric),
        (273, 4, 8), (277, 3, 1), (278, 4, height), (279, 4, pixels.nbytes),
    ]  # fmt: skip
    directory = struct.pack("<H", len(entries))
    for tag, kind, value in entries:
        directory += struct.pack("<HHII", tag, kind, 1, value)
    body = pixels.astype(pixels.dtype.newbyteorder("<")).tobytes()
    return b"II*\0" + struct.pack("<I", 8 + len(body)) + body + directory + bytes(4)


@pytest.mark.parametrize("kind", [np.uint8, np.uint16])
@pytest.mark.parametrize("photometric", [0, 1])
def test_item_08_white_is_zero(detected, good, truth, tmp_path, kind, photometric):
    """Both files show white discs; the plate is "white-on-dark"."""
    pixels = good.astype(kind) * (257 if kind is np.uint16 else 1)
    stored = pixels if photometric else np.invert(pixels)
    path = tmp_path / "image.tif"
    path.write_bytes(tiff_of(stored.astype(kind), photometric))
    outcome, rows = detected(path)
    assert outcome.code == 0
    np.testing.assert_allclose(xy(rows), truth, atol=1e-3)


@pytest.mark.parametrize("orientation", [3, 6])
def test_item_09_exif_rotation_is_not_applied(detected, good, tmp_path, orientation):
    path = save(tmp_path / "phone.jpg", good, cv2.IMWRITE_JPEG_QUALITY, 95)
    _, plain = detected(path)
    jpeg = path.read_bytes()
    exif = b"Exif\0\0II*\0\x08\0\0\0\x01\0" + struct.pack("<HHIHHI", 0x112, 3, 1, orientation, 0, 0)
    path.write_bytes(jpeg[:2] + b"\xff\xe1" + struct.pack(">H", len(exif) + 2) + exif + jpeg[2:])
    outcome, rows = detected(path)
    assert outcome.code == 0
    assert f"orientation tag {orientation}" in outcome.stderr
    assert "not applied" in outcome.stderr.replace("\n", " ")
    np.testing.assert_array_equal(xy(rows), xy(plain))


def test_item_10_colour_becomes_grey_by_the_documented_rule(detected, good, truth, tmp_path):
    outcome, rows = detected(save(tmp_path / "colour.png", cv2.cvtColor(good, cv2.COLOR_GRAY2BGR)))
    assert outcome.code == 0
    assert "0.299 R + 0.587 G + 0.114 B" in outcome.stderr
    np.testing.assert_allclose(xy(rows), truth, atol=1e-6)


def test_item_11_images_of_different_sizes(refused, looking, good, demo_data, tmp_path):
    smaller = save(tmp_path / "smaller.png", good[16:-16, 16:-16])
    refused(looking(demo_data / "calibration" / GOOD, smaller), 2, "smaller.png", "640", "608")


def test_item_12_saturated_target_is_flagged(detected, good, tmp_path):
    """Every row is flagged: the table is written all the same, the exit code is 1."""
    bright = np.clip(good.astype(np.int32) * 4, 0, 255).astype(np.uint8)
    outcome, rows = detected(save(tmp_path / "bright.png", bright))
    assert outcome.code == 1
    assert "saturated, the limit is 1%" in outcome.stderr
    assert all("saturated" in names for names in flags(rows))
    assert np.isfinite(xy(rows)).all()


@pytest.mark.parametrize("level", [0, 128, 255])
def test_item_13_uniform_image(refused, looking, good, tmp_path, level):
    refused(looking(save(tmp_path / "u.png", np.full_like(good, level))), 1, "u.png", "uniform")


def test_item_13_noise_without_structure(refused, looking, good, tmp_path):
    noise = np.random.default_rng(1).normal(120, 3, good.shape).round().astype(np.uint8)
    refused(looking(save(tmp_path / "lens-cap.png", noise)), 1, "lens-cap.png", "lens cap")


def test_item_13_structure_but_no_target(refused, looking, good, tmp_path):
    edge = np.where(np.arange(good.shape[1]) < 300, 40, 200).astype(np.uint8)
    image = save(tmp_path / "edge.png", np.broadcast_to(edge, good.shape).copy())
    refused(looking(image), 1, "edge.png")


def test_item_14_blur_is_told(detected, good, tmp_path):
    blurred = cv2.GaussianBlur(good, None, 14)
    outcome, rows = detected(save(tmp_path / "blurred.png", blurred))
    assert "warning: " in outcome.stderr
    assert "focus the lens" in outcome.stderr
    assert all("blurred" in names for names in flags(rows) if "not_found" not in names)


def test_item_15_interlace_comb_is_told(detected, good, tmp_path):
    combed = good.copy()
    combed[1::2] = np.roll(good[1::2], 4, axis=1)  # the second field, 4 px later
    outcome, _ = detected(save(tmp_path / "fields.png", combed))
    assert "warning: " in outcome.stderr
    assert "interlaced" in outcome.stderr


@pytest.fixture
def project(demo_data, tmp_path):
    """Copy three placements of the demo's calibration as a project without jobs."""
    folder = tmp_path / "project"
    (folder / "calibration").mkdir(parents=True)
    for height in ("-50.0", "+00.0", "+50.0"):
        for camera in ("left", "right"):
            name = f"{camera}_z{height}.png"
            shutil.copy(demo_data / "calibration" / name, folder / "calibration")
    for name in ("plate.toml", "control.csv"):
        shutil.copy(demo_data / name, folder)
    text = (demo_data / "closerange.toml").read_text(encoding="utf-8")
    (folder / "closerange.toml").write_text(text[: text.index("[[job]]")], encoding="utf-8")
    return folder


@pytest.fixture
def run_refused(run, project):
    """Run the project, which must be refused and get no results."""

    def check(code, *words):
        before = sorted(path.name for path in project.iterdir())
        outcome = run("run", project / "closerange.toml")
        assert outcome.code == code, outcome.stderr
        assert "error: " in outcome.stderr
        assert "\nremedy: " in outcome.stderr
        for word in words:
            assert word in outcome.stderr, f"{word!r} is not in: {outcome.stderr}"
        assert sorted(path.name for path in project.iterdir()) == before

    return check


def test_item_16_unequal_counts_list_the_orphans(project, run_refused):
    (project / "calibration" / "right_z+00.0.png").unlink()
    run_refused(2, "left 3, right 2", "left_z+00.0.png", "missing in right")


def test_item_17_natural_order_of_image_2_and_image_10(detected, good, tmp_path):
    folder = tmp_path / "images"
    folder.mkdir()
    for number in (10, 2, 1):
        save(folder / f"image{number}.png", np.roll(good, number, axis=1))
    _, rows = detected(folder)
    assert [row["placement"] for row in rows[::9]] == ["image1", "image2", "image10"]
    shifts = xy(rows)[::9, 0] - xy(rows)[0, 0]
    np.testing.assert_allclose(shifts, [0, 1, 9], atol=0.01)


def test_item_18_one_exposure_twice(project, run_refused):
    calibration = project / "calibration"
    shutil.copy(calibration / "left_z+00.0.png", calibration / "left_z+50.0.png")
    run_refused(2, "left_z+00.0.png", "left_z+50.0.png", "identical pixels", "occurs twice")


def test_item_18_one_exposure_twice_for_detect(refused, looking, demo_data, tmp_path):
    first = demo_data / "calibration" / GOOD
    again = tmp_path / "again.png"
    shutil.copy(first, again)
    refused(looking(first, again), 2, "again.png", "identical pixels")


def test_item_19_one_image_for_both_cameras(project, run_refused):
    calibration = project / "calibration"
    shutil.copy(calibration / "left_z+00.0.png", calibration / "right_z+00.0.png")
    run_refused(2, "left_z+00.0.png", "right_z+00.0.png", "one image stands for two cameras")


def test_item_20_left_and_right_exchanged_in_one_placement(project, run_refused):
    calibration = project / "calibration"
    left, right = calibration / "left_z+00.0.png", calibration / "right_z+00.0.png"
    left.rename(calibration / "aside.png")
    right.rename(left)
    (calibration / "aside.png").rename(right)
    run_refused(1, "'z+00.0'", "exchanged")


def board(rows, columns, square=40):
    """Draw a chessboard with the given numbers of inner corners, on white."""
    cells = np.indices((rows + 1, columns + 1)).sum(axis=0) % 2
    image = np.kron(np.where(cells, 220, 30), np.ones((square, square))).astype(np.uint8)
    image = cv2.copyMakeBorder(image, 60, 60, 60, 60, cv2.BORDER_CONSTANT, value=220)
    return cv2.GaussianBlur(image, None, 1.0)


@pytest.fixture
def board_target(tmp_path):
    def write(rows, columns):
        path = tmp_path / "board.toml"
        text = f'kind = "chessboard"\nrows = {rows}\ncolumns = {columns}\nsquare_mm = 10.0\n'
        path.write_text(text, encoding="utf-8")
        return path

    return write


@pytest.mark.parametrize(
    ("rows", "columns", "symmetric"), [(4, 6, True), (5, 7, True), (4, 7, False), (5, 6, False)]
)
def test_item_22_board_that_looks_alike_after_half_a_turn(
    detected, board_target, tmp_path, rows, columns, symmetric
):
    """Upright it is labelled, with a warning; calibration finds out single turned images."""
    target = board_target(rows, columns)
    image = save(tmp_path / "board.png", board(rows, columns))
    outcome, found = detected(image, target=target)
    assert outcome.code == 0
    assert len(found) == rows * columns
    assert ("warning: " in outcome.stderr) == symmetric
    assert ("looks the same after half a turn" in outcome.stderr) == symmetric


def test_item_22_symmetric_board_turned_by_a_quarter(refused, looking, board_target, tmp_path):
    turned = np.ascontiguousarray(np.rot90(board(4, 6)))
    image = save(tmp_path / "turned.png", turned)
    refused(looking(image, target=board_target(4, 6)), 1, "turned.png", "odd and one even")


def test_item_22_unsymmetric_board_keeps_its_labels_upside_down(detected, board_target, tmp_path):
    """The same corner keeps its name: r0c0 moves to the opposite corner of the image."""
    upright = board(4, 7)
    target = board_target(4, 7)
    _, before = detected(save(tmp_path / "up.png", upright), target=target)
    turned = np.ascontiguousarray(upright[::-1, ::-1])
    _, after = detected(save(tmp_path / "down.png", turned), target=target)
    last = np.array(upright.shape[::-1]) - 1
    np.testing.assert_allclose(xy(after), last - xy(before), atol=0.02)


def test_item_23_image_turned_by_a_quarter(detected, good, tmp_path):
    """Orientation "upright" holds within 45 degrees of roll: labels follow the image."""
    turned = np.ascontiguousarray(np.rot90(good))
    outcome, rows = detected(save(tmp_path / "turned.png", turned))
    assert outcome.code == 0
    centres = xy(rows).reshape(3, 3, 2)
    assert (np.diff(centres[:, :, 0], axis=1) > 0).all()
    assert (np.diff(centres[:, :, 1], axis=0) > 0).all()


def test_item_24_disc_cut_by_the_border_is_dropped_and_told(detected, good, truth, tmp_path):
    left = int(truth[:, 0].min())  # cut through the middle of the leftmost disc
    cropped = np.ascontiguousarray(good[:, left:])
    outcome, rows = detected(save(tmp_path / "cut.png", cropped))
    assert outcome.code == 0
    assert "cut by the image border" in outcome.stderr
    cut = [row for row in rows if "at_border" in row["flags"]]
    assert cut
    assert not any(row["x_px"] or row["y_px"] for row in cut)
    whole = np.array([row["flags"] == "" for row in rows])
    np.testing.assert_allclose(xy(rows)[whole], truth[whole] - [left, 0], atol=0.01)


def with_disc(pixels, centre, radius=26):
    """Add one more white disc of the size of the plate's."""
    added = pixels.copy()
    shift, scale = 8, 256
    middle = tuple(round(scale * value) for value in centre)
    cv2.circle(added, middle, radius * scale, int(pixels.max()), -1, cv2.LINE_AA, shift)
    return cv2.GaussianBlur(added, None, 0.7)


def test_item_25_extra_disc_that_makes_the_labels_ambiguous(
    refused, looking, good, truth, tmp_path
):
    """A tenth disc continues a row: two grids of three columns fit."""
    grid = truth.reshape(3, 3, 2)
    column = 2 * grid[:, 2] - grid[:, 1]
    column[:, 0] = np.minimum(column[:, 0], good.shape[1] - 30)
    crowded = good
    for centre in column:
        crowded = with_disc(crowded, centre)
    refused(looking(save(tmp_path / "twelve.png", crowded)), 1, "twelve.png")


def test_item_25_speck_beside_the_plate_does_no_harm(detected, good, truth, tmp_path):
    speck = with_disc(good, (20, 20), radius=5)
    outcome, rows = detected(save(tmp_path / "speck.png", speck))
    assert outcome.code == 0
    np.testing.assert_allclose(xy(rows), truth, atol=0.05)


def test_item_25_disc_that_is_missing_is_not_invented(run, looking, good, truth, tmp_path):
    """A covered disc is NaN with a flag, or the whole image is refused; never a wrong label."""
    covered = good.copy()
    x, y = truth[4].round().astype(int)
    covered[y - 40 : y + 40, x - 40 : x + 40] = np.median(good)
    output = tmp_path / "points.csv"
    outcome = run(*looking(save(tmp_path / "covered.png", covered)), "-o", output)
    if outcome.code:
        assert "covered.png" in outcome.stderr
        assert not output.exists()
        return
    with output.open(newline="", encoding="utf-8") as stream:
        rows = list(csv.DictReader(stream))
    assert "not_found" in flags(rows)[4]
    others = [i for i in range(9) if i != 4]
    np.testing.assert_allclose(xy(rows)[others], truth[others], atol=0.01)


def test_warnings_stand_in_the_json_summary(run, looking, good, tmp_path):
    image = save(tmp_path / "colour.png", cv2.cvtColor(good, cv2.COLOR_GRAY2BGR))
    outcome = run(*looking(image), "--json", "-o", tmp_path / "points.csv")
    (warning,) = json.loads(outcome.stdout)["warnings"]
    assert f"warning: {warning}" in outcome.stderr
    assert "colours turned to grey" in warning


def test_errors_stand_in_the_json_summary(run, looking, tmp_path):
    outcome = run(*looking(tmp_path / "none.png"), "--json", "-o", tmp_path / "points.csv")
    document = json.loads(outcome.stdout)
    assert document["exit_code"] == outcome.code == 2
    assert "none.png" in document["error"]
    assert document["remedy"]


@pytest.mark.parametrize("pattern", ["(", "z.*", "_(q)$", "(?P<reading>z.*)"])
def test_placement_pattern_that_cannot_be_used(refused, looking, demo_data, pattern):
    args = [*looking(demo_data / "calibration" / GOOD), "--placement-pattern", pattern]
    refused(args, 2, "placement pattern")


def test_one_placement_name_for_two_images(refused, looking, demo_data):
    images = sorted((demo_data / "calibration").glob("left_*.png"))[:2]
    refused([*looking(*images), "--placement", "here"], 2, "2 images")
