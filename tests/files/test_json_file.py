"""The JSON dialect: strict, bounded, finite, unique."""

from __future__ import annotations

import math

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from closerange.errors import FileError, SchemaError
from closerange.files.json_file import MAX_DEPTH, dump_json, load_json, parse_json

TEXT = st.text(st.characters(codec="utf-8"))


def parse(text):
    return parse_json(text, source="rig.json")


def test_ordinary_document():
    assert parse('{"a": [1, 2.5, "x", true, null], "b": {}}') == {
        "a": [1, 2.5, "x", True, None],
        "b": {},
    }


@pytest.mark.parametrize("text", ["1e999", "-1e999", "NaN", "Infinity", "-Infinity"])
def test_numbers_that_are_not_finite(text):
    with pytest.raises(SchemaError, match=f"{text} is not a finite number"):
        parse(f'{{"x": [{text}]}}')


def test_a_key_that_appears_twice():
    with pytest.raises(SchemaError, match="key 'a' appears twice"):
        parse('{"x": {"a": 1, "b": 2, "a": 1}}')


def test_the_same_key_in_two_objects_is_fine():
    assert parse('{"a": {"a": 1}}') == {"a": {"a": 1}}


def test_depth():
    assert parse("[" * MAX_DEPTH + "]" * MAX_DEPTH)
    for deep in (MAX_DEPTH + 1, 100_000):
        with pytest.raises(SchemaError, match=f"nested deeper than {MAX_DEPTH}"):
            parse("[" * deep + "]" * deep)
    with pytest.raises(SchemaError, match="nested deeper"):
        parse('{"a":' * 1000 + "1" + "}" * 1000)


def test_brackets_in_texts_are_not_nesting():
    text = "[" * 100 + '\\"' + "{" * 100
    assert parse(f'["{text}"]') == [text.replace("\\", "")]


def test_an_integer_of_5000_digits():
    with pytest.raises(SchemaError, match="digits"):
        parse("9" * 5000)


@pytest.mark.parametrize(
    ("text", "where"),
    [("{", "line 1"), ('{"a": 1,\n "b": }', "line 2, column 7"), ("", "line 1"), ("[1] 2", "line")],
)
def test_bad_syntax_is_located(text, where):
    with pytest.raises(SchemaError, match=where) as caught:
        parse(text)
    assert caught.value.exit_code == 2


def test_single_quotes_and_comments_are_refused():
    for text in ("{'a': 1}", '{"a": 1} // x', '{"a": 1,}'):
        with pytest.raises(SchemaError):
            parse(text)


def test_size_limit(tmp_path):
    (tmp_path / "f.json").write_text("[1, 2]")
    assert load_json(tmp_path / "f.json", max_bytes=6) == [1, 2]
    with pytest.raises(FileError, match="limit is 5"):
        load_json(tmp_path / "f.json", max_bytes=5)


@settings(max_examples=60, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(
    st.recursive(
        st.none() | st.booleans() | st.floats(allow_nan=False, allow_infinity=False) | TEXT,
        lambda inner: st.lists(inner, max_size=4) | st.dictionaries(TEXT, inner, max_size=4),
        max_leaves=12,
    )
)
def test_round_trip(tmp_path, document):
    dump_json(document, tmp_path / "f.json")
    assert load_json(tmp_path / "f.json") == document


def test_the_same_content_gives_the_same_bytes(tmp_path):
    for name in ("a", "b"):
        dump_json({"z": 0.1, "a": ["µ"]}, tmp_path / name)
    assert (tmp_path / "a").read_bytes() == (tmp_path / "b").read_bytes()
    assert "µ" in (tmp_path / "a").read_text("utf-8")


def test_nan_is_never_written(tmp_path):
    with pytest.raises(ValueError, match="JSON compliant"):
        dump_json({"x": math.nan}, tmp_path / "f.json")
    assert not list(tmp_path.iterdir())
