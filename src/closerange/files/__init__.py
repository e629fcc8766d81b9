"""Files at the program's border: whole or not at all, with limits, in one dialect.

Each table's reader and writer live beside its type; here are only the dialects.
"""

from closerange.files.atomic import write_bytes, write_text
from closerange.files.csv_table import (
    CsvTable,
    check_unique,
    flag_cell,
    float_cell,
    float_text,
    read_csv,
    text_cell,
    write_csv,
)
from closerange.files.json_file import dump_json, load_json, parse_json
from closerange.files.limited import (
    MAX_TABLE_BYTES,
    MAX_TEXT_BYTES,
    read_limited,
    read_text,
    sha256,
)

__all__ = [
    "MAX_TABLE_BYTES",
    "MAX_TEXT_BYTES",
    "CsvTable",
    "check_unique",
    "dump_json",
    "flag_cell",
    "float_cell",
    "float_text",
    "load_json",
    "parse_json",
    "read_csv",
    "read_limited",
    "read_text",
    "sha256",
    "text_cell",
    "write_bytes",
    "write_csv",
    "write_text",
]
