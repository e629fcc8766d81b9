"""Nested facts (options, choices, hashes) as tables that a person can read."""

from __future__ import annotations

import hashlib
import re
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

from closerange.delivery.excerpts import shown
from closerange.delivery.sheet import Block, Files, Section, Table
from closerange.delivery.wording import DASH, counted, printed, significant

FEW_FILES = 12
"""Up to so many files are a table; more are a folded list."""

_HASH = re.compile(r"[0-9a-f]{64}")
_UNITS = {"mm": "mm", "mm2": "mm²", "px": "px", "px2": "px²", "rad": "rad", "s": "s"}


def provenance_section(provenance: Mapping[str, Any]) -> Section | None:
    """Name versions, options and input hashes.

    Parameters
    ----------
    provenance : mapping
        JSON-ready; a mapping whose values are SHA-256 digests becomes a table of files.

    Returns
    -------
    Section or None
        None if nothing is known.
    """
    blocks = fact_blocks("Program and options", provenance)
    return Section("provenance", "Versions and inputs", tuple(blocks)) if blocks else None


def fact_blocks(caption: str, facts: Mapping[str, Any]) -> list[Block]:
    """Turn nested facts into tables.

    Parameters
    ----------
    caption : str
        Of the table of single facts.
    facts : mapping
        JSON-ready. Lists of mappings become tables of their own, hashes as well.

    Returns
    -------
    list of Block
        Empty if there are no facts.
    """
    singles: list[tuple[str, str]] = []
    tables: list[Block] = []
    for path, value in _walk("", facts):
        if _is_hashes(value):
            tables.append(_files(_title(path), value))
        elif isinstance(value, Mapping):
            rows_of = [{"name": name, **item} for name, item in value.items()]
            tables.append(_rows_table(_title(path), rows_of))
        elif _is_rows(value):
            tables.append(_rows_table(_title(path), value))
        else:
            singles.append((words(path), _text(value)))
    if singles:
        head = ("name", "value")
        tables.insert(0, shown(singles, caption, head, texts=frozenset({0, 1}), breakable=True))
    return tables


def combined_hash(hashes: Mapping[str, str]) -> str:
    """Return one SHA-256 for many files.

    Parameters
    ----------
    hashes : mapping of str to str
        Digest by file name.

    Returns
    -------
    str
        SHA-256 of the list that ``sha256sum`` prints for the files in the order of their names
        (by code point): a line for each, digest, two blanks, name.
    """
    lines = "".join(f"{hashes[name]}  {name}\n" for name in sorted(hashes))
    return hashlib.sha256(lines.encode()).hexdigest()


def words(name: str) -> str:
    """Write a field name as words: ``cross_validation_px`` is ``cross validation [px]``."""
    stem, _, unit = name.rpartition("_")
    if stem and unit in _UNITS:
        return f"{stem.replace('_', ' ')} [{_UNITS[unit]}]"
    return name.replace("_", " ")


def _files(title: str, hashes: Mapping[str, str]) -> Block:
    """List files with their hashes, and one hash for all of them."""
    entries = tuple((str(name), str(hashes[name])) for name in sorted(hashes))
    if len(entries) <= FEW_FILES:
        texts = frozenset({0, 1})
        return Table(title, ("file", "SHA-256"), entries, texts, breakable=True)
    caption = f"{title}: {counted(len(entries), 'file')}, combined SHA-256 {combined_hash(hashes)}"
    return Files(caption, entries)


def _title(path: str) -> str:
    """Write the path of a table as its caption."""
    text = {"inputs": "Input files"}.get(path, words(path.removesuffix(": table")))
    return f"{text[0].upper()}{text[1:]}"


def _walk(path: str, value: Any) -> Iterator[tuple[str, Any]]:
    """Yield (path, value) of everything that is not a plain mapping."""
    if isinstance(value, Mapping) and not (_is_hashes(value) or _is_named_rows(value)):
        for key, item in value.items():
            yield from _walk(f"{path}: {key}" if path else str(key), item)
    elif value not in (None, "", [], (), {}):
        yield path, value


def _is_hashes(value: Any) -> bool:
    return (
        isinstance(value, Mapping)
        and bool(value)
        and all(isinstance(item, str) and _HASH.fullmatch(item) for item in value.values())
    )


def _is_named_rows(value: Mapping[str, Any]) -> bool:
    """Tell whether a mapping holds several flat mappings with the same names."""
    items = list(value.values())
    if len(items) < 2 or not all(isinstance(item, Mapping) and item for item in items):
        return False
    flat = not any(isinstance(cell, Mapping) for item in items for cell in item.values())
    return flat and all(item.keys() == items[0].keys() for item in items)


def _is_rows(value: Any) -> bool:
    return (
        isinstance(value, list | tuple)
        and bool(value)
        and all(isinstance(item, Mapping) for item in value)
    )


def _rows_table(caption: str, rows: Sequence[Mapping[str, Any]]) -> Table:
    names = list(dict.fromkeys(str(key) for row in rows for key in row))
    cells = [[_text(row.get(name)) for name in names] for row in rows]
    texts = frozenset(
        column
        for column, name in enumerate(names)
        if not all(isinstance(row.get(name), int | float | None) for row in rows)
    )
    return shown(cells, caption, tuple(words(name) for name in names), texts=texts)


def _text(value: Any) -> str:
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, int):
        return str(value)
    if isinstance(value, float):
        return significant(value, 4)
    if isinstance(value, Mapping):
        return ", ".join(f"{words(str(key))} {_text(item)}" for key, item in value.items())
    if isinstance(value, list | tuple):
        return ", ".join(_text(item) for item in value)
    return DASH if value is None else printed(str(value))
