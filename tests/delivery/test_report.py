import dataclasses
import re
from html.parser import HTMLParser
from xml.etree import ElementTree as ET

import numpy as np
import pytest

from closerange.delivery.excerpts import coverage_word
from closerange.delivery.overlays import make_overlay
from closerange.delivery.report import render_report
from closerange.delivery.sheet import Terms
from closerange.delivery.single_point_section import single_point_blocks
from closerange.delivery.wording import DASH
from closerange.flags import Flag
from closerange.images.frame import Frame
from closerange.position.positions import Positions

VOID = {"meta", "link", "br", "hr", "img"}
PROVENANCE = {
    "program": "closerange 9.9",
    "options": {"model": "brown", "limit_mm": 0.05},
    "inputs": {"points <1>.csv": "ab" * 32},
}


class _Checker(HTMLParser):
    """Collects tags and text and refuses what is not nested."""

    def __init__(self):
        super().__init__()
        self.open, self.tags, self.links, self.ids, self.texts = [], [], [], [], []

    def handle_starttag(self, tag, attrs):
        self.tags.append(tag)
        for name, value in attrs:
            if name in ("href", "src", "xlink:href", "action", "data"):
                self.links.append(value)
            if name == "id":
                self.ids.append(value)
        if tag not in VOID:
            self.open.append(tag)

    def handle_startendtag(self, tag, attrs):
        self.handle_starttag(tag, attrs)
        self.open.pop()

    def handle_endtag(self, tag):
        assert self.open, f"stray </{tag}>"
        assert self.open.pop() == tag

    def handle_data(self, data):
        if self.open and self.open[-1] != "style":
            self.texts.append(data)


def _check(html):
    checker = _Checker()
    checker.feed(html)
    checker.close()
    assert checker.open == []
    return checker


def _words(html):
    return re.sub(r"\s+", " ", " ".join(_check(html).texts))


@pytest.fixture(scope="module")
def overlays(points, rig):
    pixels = np.random.default_rng(5).integers(0, 255, (480, 640)).astype(np.uint8)
    frame = Frame("left", pixels, source="left <1>.png")
    return [make_overlay(frame, points, residuals=rig.residuals)]


@pytest.fixture(scope="module")
def full(rig, points, overlays, positions, acceptance, control_check, length_check, error_map):
    return {
        "title": 'Cell "7" <A> & B',
        "rig": rig,
        "points": points,
        "overlays": overlays,
        "positions": positions,
        "checks": [acceptance, control_check, length_check],
        "error_map": error_map,
        "provenance": PROVENANCE,
        "notes": ["left.png: lower the exposure by 10 um <i>"],
    }


@pytest.fixture(scope="module")
def html(full):
    return render_report(**full)


def test_page_is_nested_and_links_stay_inside(html):
    checker = _check(html)
    assert len(set(checker.ids)) == len(checker.ids)
    for link in checker.links:
        assert link.startswith(("#", "data:image/jpeg;base64,"))
        if link.startswith("#"):
            assert link[1:] in checker.ids
    assert "script" not in checker.tags
    assert "@import" not in html
    assert "url(" not in html
    assert "http" not in html


def test_every_drawing_is_xml_with_title_and_description(html):
    drawings = re.findall(r"<svg.*?</svg>", html, re.DOTALL)
    assert len(drawings) >= 12
    for drawing in drawings:
        root = ET.fromstring(drawing)  # noqa: S314 - our own drawing
        assert root.find("title").text
        assert root.find("desc").text


def test_texts_of_others_are_escaped(html):
    assert "<i>" not in html
    assert "<A>" not in html
    assert "a<b>" not in html
    words = _words(html)
    assert 'Cell "7" <A> & B' in words
    assert "a<b>&\"c'" in words
    assert "points <1>.csv" in words
    assert "left <1>.png" in words
    assert "lower the exposure by 10 µm <i>" in words


def test_what_is_not_known_is_never_printed_as_a_number(html):
    # positions, points, predicted errors, lens scores and limits of the fixtures hold NaN
    assert not re.search(r"\b(nan|inf|null|None)\b", _words(html), re.IGNORECASE)
    assert not re.search(r"=\"[^\"]*\b(nan|inf)\b", html)


def test_the_same_input_gives_the_same_bytes(full, html):
    assert render_report(**full) == html


def test_results_and_their_documents_give_the_same_report(full, html):
    documents = [check.to_document() for check in full["checks"]]
    assert render_report(**{**full, "checks": documents}) == html


def test_all_sections_are_there(html):
    titles = re.findall(r"<h2>\d+\. (.*?)</h2>", html)
    assert titles == [
        "Warnings",
        "How it was measured",
        "Single-point test",
        "Control points",
        "Lengths",
        "Predicted error in the volume",
        "Calibration",
        "Positions",
        "Image points",
        "Pictures with detected points",
        "Flags",
        "Versions and inputs",
        "Glossary",
    ]


@pytest.mark.parametrize(
    ("argument", "titles"),
    [
        ("rig", ["How it was measured", "Calibration"]),
        ("points", ["How it was measured", "Image points"]),
        ("overlays", ["Pictures with detected points"]),
        ("positions", ["How it was measured", "Positions"]),
        ("error_map", ["Predicted error in the volume"]),
        ("provenance", ["Versions and inputs"]),
        ("notes", ["Warnings"]),
    ],
)
def test_one_thing_gives_only_its_own_sections(full, argument, titles):
    page = render_report(title="One", **{argument: full[argument]})
    found = re.findall(r"<h2>\d+\. (.*?)</h2>", page)
    assert [title for title in found if title not in ("Flags", "Glossary")] == titles
    _check(page)


def test_nothing_gives_a_page_without_sections():
    page = render_report(title="Nothing")
    assert "<h2" not in page
    assert "<table" not in page
    assert "Nothing was measured." in _words(page)


def test_first_page_has_verdict_picture_and_figures_with_units(html):
    front = html[html.index('<section class="front"') : html.index('<section id="warnings"')]
    words = _words(f"<div>{front[: front.index('<nav')]}</section></div>")
    assert front.count("<svg") == 1
    assert "predicted error in space (one standard deviation) [µm]" in words
    assert "Accuracy" in words
    assert "±20 µm of the reference" in words
    assert "50 µm" in words
    assert "rejected" in words


def test_rejection_names_figure_value_and_limit(acceptance, html):
    value = 1000 * acceptance.repeatability.pooled.std_mm[2]
    assert f"Rejected: repeatability Z is {value:.1f} µm, the limit is 1.0 µm." in _words(html)
    assert 'class="verdict bad"' in html


def test_headline_replaces_the_sentence_and_not_its_colour(full):
    page = render_report(**{**full, "headline": "Holds 5 um, says <the boss>."})
    assert '<p class="verdict bad">Holds 5 µm, says &lt;the boss&gt;.</p>' in page


def test_untrusted_calibration_is_said_first(rig):
    trust = dataclasses.replace(rig.trust, verdict="untrustworthy")
    page = render_report(title="Bad", rig=dataclasses.replace(rig, trust=trust))
    assert "Untrustworthy calibration: predicted error 4.1 µm (X)" in _words(page)
    assert 'class="verdict bad"' in page


def _tables(html):
    """Return (head, rows) of every table as texts without tags."""
    tables = []
    for table in re.findall(r"<table.*?</table>", html, re.DOTALL):
        rows = [
            [re.sub("<.*?>", "", cell) for cell in re.findall(r"<t[hd].*?</t[hd]>", row, re.DOTALL)]
            for row in re.findall(r"<tr.*?</tr>", table, re.DOTALL)
        ]
        tables.append((rows[0][0], rows[1], rows[2:]))
    return tables


COUNTS = {
    *("points", "placements", "readings", "found", "flagged", "cameras", "fitted points"),
    *("points not fitted", "image points", "calibration points", "positions", "verified rows"),
    *("probability by chance", "errors inside", "mean squared error / predicted"),
}


def test_every_column_of_numbers_has_a_unit(html):
    number = re.compile(r"-?\d+\.\d+(e[+-]\d+)?")
    for caption, head, rows in _tables(html):
        for column, name in enumerate(head):
            decimal = [row for row in rows if number.fullmatch(row[column])]
            if decimal and head == ["name", "value"]:
                assert all("[" in row[0] for row in decimal)
            elif decimal and "[" not in name and name not in COUNTS:
                assert "unit" in head, f"{caption}: {name}"
                assert all(row[head.index("unit")] for row in decimal)


def test_every_row_fits_its_head(html):
    for caption, head, rows in _tables(html):
        assert rows, caption
        assert {len(row) for row in rows} == {len(head)}, caption


def test_tables_show_the_data(html, rig, positions):
    tables = {caption: (head, rows) for caption, head, rows in _tables(html)}
    head, rows = tables["Residuals in the images (observed minus calculated)"]
    fitted = rig.residuals.residual_px[:27][rig.residuals.fitted[:27]]
    assert rows[0][:3] == ["left", "26", f"{np.sqrt((fitted[:, 0] ** 2).mean()):.4f}"]
    _, rows = tables["Points that were not fitted"]
    assert rows[0][3:] == [
        "0.900",
        "-0.400",
        "contradicts the other points and was left out of the fit",
    ]
    assert rows[1][-1] == "check point, kept out on purpose"
    head, rows = tables["Measured positions with their predicted standard deviation"]
    assert len(rows) == 25
    assert rows[0][head.index("X [mm]")] == f"{positions.xyz_mm[0, 0]:.3f}"
    assert rows[4][3:7] == [DASH] * 4
    assert rows[4][-1] == "single_view"
    _, rows = tables["Input files"]
    assert rows == [["points &lt;1&gt;.csv", "ab" * 32]]


def test_flags_are_explained_in_words(html):
    _, head, rows = next(table for table in _tables(html) if table[0] == "Flags that occur")
    found = {row[0]: row for row in rows}
    assert set(found) == {"not_found", "saturated", "outlier", "residual", "single_view"}
    assert "lower the exposure" in found["saturated"][1]
    assert found["outlier"][head.index("calibration points")] == "1"
    assert found["single_view"][head.index("positions")] == "1"


def test_long_tables_are_cut_and_say_so():
    count = 350
    positions = Positions(
        ("",) * count,
        tuple(f"p{i}" for i in range(count)),
        np.zeros((count, 3)),
        np.broadcast_to(1e-6 * np.eye(3), (count, 3, 3)),
        np.zeros(count),
        np.full(count, 2),
        np.where(np.arange(count) == 300, int(Flag.residual), 0),
        ("",) * count,
    )
    page = render_report(title="Many", positions=positions)
    caption, _, rows = next(table for table in _tables(page) if "first 200" in table[0])
    assert "first 200 of 350 rows" in caption
    assert "CSV" in caption
    assert len(rows) == 200


def test_plots_of_chapter_three_are_there(html):
    for axis in "XYZ":
        for words in ("standard deviation of the readings", "mean of the readings"):
            assert f">{axis}: {words}</text>" in html
        assert f">{axis}: error: actual minus mean</text>" in html
        assert f">{axis}: reading minus mean</text>" in html
        for along in "XYZ":
            assert f">{axis} error over {along}" in html


def test_glossary_explains_words_that_occur_and_no_others(rig):
    page = render_report(title="Calibration", rig=rig)
    assert 'id="word-predicted-error"' in page
    assert 'href="#word-predicted-error"' in page
    assert 'id="word-guard-band"' not in page


def test_seventeen_pictures_stay_below_three_megabytes(points, rig):
    # noise of 3 grey values: JPEG cannot make it vanish
    rng = np.random.default_rng(2)
    pixels = np.clip(rng.normal(60, 3, (512, 640)), 0, 255).astype(np.uint8)
    overlay = make_overlay(Frame("left", pixels), points, residuals=rig.residuals)
    page = render_report(title="Pictures", rig=rig, overlays=[overlay] * 17)
    assert len(page.encode()) < 3e6  # measured 1.4 MB


def test_something_else_is_not_a_result():
    with pytest.raises(TypeError, match="object is not a verification result"):
        render_report(title="Wrong", checks=[object()])


def test_fixed_parameters_are_listed_with_their_reason(rig):
    k3 = {"value": 0.0, "std": 0.0, "unit": "", "free": False, "why": "0: no wide lens"}
    facts = {"points": 27, "parameters": {"fx": {"value": 2000.0, "free": True}, "k3": k3}}
    report = {"cameras": {"left": facts, "right": {"points": 27}}}
    page = render_report(title="Fixed", rig=dataclasses.replace(rig, report=report))
    rows = next(table for table in _tables(page) if table[0].startswith("Parameters"))[2]
    assert [row[2] for row in rows] == ["fx", "k1", "rx", "tz", "k3", "fx", "k1", "rx", "tz"]
    assert rows[0] == ["left", "focal length along x", "fx", "2000.0", "1.2", "px", "free"]
    assert rows[2][3:5] == [DASH, "0.00010"]
    assert rows[4][3:] == ["0", DASH, "pure\u00a0number", "fixed: 0: no wide lens"]
    assert ["left", "27"] in next(
        rows for caption, head, rows in _tables(page) if (caption, head[0]) == ("Cameras", "name")
    )


@pytest.mark.parametrize(
    ("low", "high", "ratio", "word"),
    [
        (0.2, 0.4, 9.0, "region too small"),
        (0.2, 0.94, 1.5, "holds"),  # one calibration's luck
        (0.9, 0.98, 1.1, "holds"),
        (0.96, 1.0, 0.5, "cautious"),
        (None, None, None, DASH),
    ],
)
def test_stated_regions_are_judged(low, high, ratio, word):
    share = None if low is None else (low + high) / 2
    coverage = {"level": 0.95, "share": share, "low": low, "high": high, "mean_ratio": ratio}
    assert coverage_word(coverage) == word


def test_too_small_uncertainties_are_said_in_the_verdict(control_check):
    document = control_check.to_document()
    small = {"count": 3, "inside": 1, "share": 0.33, "low": 0.01, "high": 0.9, "mean_ratio": 7.0}
    document["coverage"]["check"] = {"level": 0.95, **small}
    page = render_report(title="Small", checks=[document])
    assert "but the stated uncertainties are too small: 33.0 % of the errors lie" in _words(page)
    assert 'class="verdict warn"' in page


def test_the_name_of_a_job_is_said(length_check):
    check = length_check.to_document()
    page = render_report(
        title="Jobs", checks=[{**check, "job": "bars <1>"}, {**check, "job": "lengths"}]
    )
    assert "Lengths: bars <1>" in _words(page)
    assert "Error of 1 length (rms), bars <1>" in _words(page)
    # a job named as its kind would only be said twice
    assert re.findall(r"<h2>\d+\. (Lengths.*?)</h2>", page) == [
        "Lengths: bars &lt;1&gt;",
        "Lengths",
    ]
    alone = render_report(title="Jobs", checks=[{**check, "job": "bars"}])
    assert "(rms), bars" not in alone


def test_only_the_name_of_a_picture_file_is_shown(overlays):
    moved = [dataclasses.replace(overlays[0], source="/home/somebody/left 1.png")]
    page = render_report(title="Pictures", overlays=moved)
    assert "(left 1.png)" in _words(page)
    assert "somebody" not in page


def test_repeatability_is_compared_with_image_noise_where_it_is_stated(acceptance):
    document = acceptance.to_document()
    texts = []
    for stated in (True, False):
        prediction = document["prediction"] | {"noise_stated": stated}
        _, blocks = single_point_blocks(document | {"prediction": prediction})
        entries = [dict(block.entries) for block in blocks if isinstance(block, Terms)]
        texts += [found["Observed / predicted"] for found in entries]
    assert texts[0].endswith("(Z), predicted from image noise.")
    assert texts[1].endswith("(Z), predicted for all errors of a reading together, hence below 1.")
