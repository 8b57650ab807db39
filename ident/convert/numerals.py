"""Numbers as they are typeset: a minus that is no hyphen, and thousands apart by narrow blanks or apostrophes."""

from __future__ import annotations

import re

import pyarrow as pa
import pyarrow.compute as pc

MINUS = "\u2212\uff0d"  # as Shift-JIS is decoded by its standard, and by Windows
SPACES = "\u00a0\u2007\u2009\u202f"  # that break no line, or are narrow
BETWEEN = f"{SPACES}'\u2019"
GROUPED = rf"^\s*[+-]?[0-9]{{1,3}}([{BETWEEN}][0-9][0-9][0-9])+([.,][0-9]*)?([eEdD][+-]?[0-9]+)?\s*$"
_PLAIN = re.compile(GROUPED)


def plain_number(text: str) -> str:
    """A text as numbers are written for programs; what is no number stays one that is none."""
    text = re.sub(f"[{MINUS}]", "-", text).strip()
    return re.sub(f"[{BETWEEN}]", "", text) if _PLAIN.match(text) else text


def plain_numbers(column: pa.Array) -> pa.Array:
    """Cells as ``plain_number`` has them; the column itself where none is typeset."""
    if not pc.any(pc.match_substring_regex(column, f"[{MINUS}{BETWEEN}]")).as_py():
        return column
    column = pc.utf8_trim_whitespace(pc.replace_substring_regex(column, f"[{MINUS}]", "-"))
    bare = pc.replace_substring_regex(column, f"[{BETWEEN}]", "")
    return pc.if_else(pc.match_substring_regex(column, GROUPED), bare, column)
