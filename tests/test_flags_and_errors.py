"""The registry of quality bits and the tree of errors."""

from __future__ import annotations

import itertools

import pytest

from closerange import errors
from closerange.errors import CloseRangeError, CloseRangeWarning, DataError, InputError
from closerange.flags import Flag, format_flags, parse_flags


def test_every_flag_is_one_bit_and_reads_back():
    bits = list(Flag)
    assert len({int(bit) for bit in bits}) == len(bits) >= 18
    for bit in bits:
        assert int(bit).bit_count() == 1
        assert parse_flags(format_flags(bit)) == bit


@pytest.mark.parametrize("pair", list(itertools.pairwise(Flag)))
def test_joined_flags_come_in_registry_order(pair):
    first, second = pair
    assert format_flags(second | first) == f"{first.name}|{second.name}"


def test_all_flags_at_once():
    everything = parse_flags("|".join(bit.name for bit in reversed(Flag)))
    assert everything == sum(Flag)
    assert format_flags(int(everything)) == "|".join(bit.name for bit in Flag)


def test_nothing_is_an_empty_cell():
    assert format_flags(0) == format_flags(Flag.none) == ""
    assert parse_flags("") == parse_flags(" ") == parse_flags("none") == Flag.none


def test_blanks_around_names_and_repeated_names_do_not_matter():
    assert parse_flags(" saturated | at_border|saturated") == Flag.saturated | Flag.at_border


@pytest.mark.parametrize("text", ["Saturated", "saturated,at_border", "1", "saturated|x", "name"])
def test_unknown_names_are_refused_with_the_known_ones(text):
    with pytest.raises(ValueError, match="unknown flag") as caught:
        parse_flags(text)
    assert "saturated" in str(caught.value)


def every_error():
    return [
        value
        for value in vars(errors).values()
        if isinstance(value, type) and issubclass(value, CloseRangeError)
    ]


@pytest.mark.parametrize("kind", every_error())
def test_message_and_remedy(kind):
    error = kind("too few points: 5, the limit is 6", remedy="add points")
    assert error.message == "too few points: 5, the limit is 6"
    assert str(error) == "too few points: 5, the limit is 6\nremedy: add points"
    assert str(kind("plain")) == "plain"
    assert isinstance(error, ValueError)


@pytest.mark.parametrize("kind", every_error())
def test_exit_codes(kind):
    assert kind("x").exit_code == (2 if issubclass(kind, InputError) else 1)


def test_the_tree():
    assert len(every_error()) == 10
    for kind in (errors.FileError, errors.ImageError, errors.TableError, errors.SchemaError):
        assert issubclass(kind, InputError)
    for kind in (errors.DetectionError, errors.GeometryError, errors.UntrustedError):
        assert issubclass(kind, DataError)
    assert issubclass(CloseRangeWarning, UserWarning)
