"""How a text log is encoded: as its map says, by its mark, as UTF-8, or as Western letters, where they are plain."""

from __future__ import annotations

import codecs
import re
from pathlib import Path

from robot_assets.errors import DataError

LOOKED_AT = 1 << 16  # bytes of a text that tell
MARKS = {
    codecs.BOM_UTF32_LE: "utf-32",  # begins as the mark of UTF-16 does
    codecs.BOM_UTF32_BE: "utf-32",
    codecs.BOM_UTF16_LE: "utf-16",
    codecs.BOM_UTF16_BE: "utf-16",
    codecs.BOM_UTF8: "utf-8-sig",
}
# What programs write under these names has more characters than the standard: circled digits, units in one sign.
WIDER = {"shift_jis": "cp932", "gb2312": "gb18030", "gbk": "gb18030", "euc_kr": "cp949", "utf-8": "utf-8-sig"}
SHOWN = ("shift_jis", "gb18030", "big5", "euc_kr", "cp1251")  # readings that an error shows, of those that can be
LONGEST_READING = 24  # characters of one

# Bytes of cp1252 as Latin-1 has them: letters, and signs of units and numbers.
LETTERS = "À-ÖØ-öø-ÿ"
SIGNS = "°º²³µ·±\xa0"
# Punctuation between blanks, where no character of two bytes can begin or end.
PUNCTUATION = re.compile("(?<![\x80-\xff])[\x80\x85\x91-\x97\x99](?=[\\s!-/]|$)")
WORDS = re.compile(f"[A-Za-z{LETTERS}]+")


def known_encoding(name: str, key: str, where: str) -> str:
    """The name of an encoding, checked.

    Raises:
        DataError: where Python knows none of that name, or it is none of texts.
    """
    try:
        if "1,2\n".encode(name).decode(name) == "1,2\n":
            return name
    except (LookupError, ValueError):
        pass
    raise DataError(key, where, repr(name), 'an encoding, as "utf-8", "shift_jis", "gb18030", "cp1252" or "utf-16"')


def encoding_of(path: Path, stated: str = "") -> str:
    """The encoding by which Python reads a text; empty where its bytes do not tell, and none is stated.

    Raises:
        DataError: where the text is none of the encoding that is stated.
    """
    with path.open("rb") as file:
        head = file.read(LOOKED_AT)
    marked = next((encoding for mark, encoding in MARKS.items() if head.startswith(mark)), "")
    if stated:
        name = codecs.lookup(stated).name
        # Of an encoding that is stated without it a mark would be part of the first name.
        name = marked if marked and marked[:6] == name[:6] else WIDER.get(name, name)
        bad = _undecoded(head, name)
        if bad is not None:
            found = f"bytes that are no {stated} in line {head[:bad].count(10) + 1}"
            raise DataError("encoding", str(path), found, f"the one that it is written in{_readings(head)}")
        return name
    if marked:
        return marked
    for start, encoding in ((1, "utf-16-le"), (0, "utf-16-be")):  # without a mark: every other byte of a table is zero
        half = head[start::2]
        if len(half) > 8 and half.count(0) > 0.9 * len(half):
            return encoding
    if _undecoded(head, "utf-8") is None:
        return "utf-8"
    return "cp1252" if _western(head.decode("latin-1")) else ""


def unreadable(path: Path, name: str) -> DataError:
    """What to say of a text with a name that is of an encoding that its bytes do not tell; ``name`` as Latin-1."""
    return DataError(
        "encoding",
        str(path),
        "names of columns that are no UTF-8",
        'encoding = "NAME" in the map, or --encoding NAME beside --guess' + _readings(name.encode("latin-1")),
    )


def _undecoded(head: bytes, encoding: str) -> int | None:
    """The first byte that is none of an encoding; None where all are. The last character may be cut."""
    try:
        codecs.getincrementaldecoder(encoding)().decode(head)
    except UnicodeDecodeError as err:
        return err.start
    return None


def _western(text: str) -> bool:
    """Whether bytes above ASCII, read as Latin-1, are letters within words of ASCII and signs that stand alone.

    Characters of two bytes come as several of such in a row, or as capitals behind small letters; words of other
    alphabets have no letters of ASCII.
    """
    text = PUNCTUATION.sub(" ", text)
    if re.search(
        f"[^\x00-\x7f{LETTERS}{SIGNS}]|[{SIGNS}][{LETTERS}{SIGNS}]|[{LETTERS}][{SIGNS}]|[a-zß-öø-ÿ][À-ÖØ-Þ]", text
    ):
        return False
    strange = re.compile(f"[{LETTERS}]")
    return all(
        len(word) == 1 or 2 * len(strange.findall(word)) <= len(word)
        for word in WORDS.findall(text)
        if not word.isascii()
    )


def _readings(head: bytes) -> str:
    """How the first bytes above ASCII read in encodings that they can be of, in words; empty where none can."""
    word = re.search(rb"[^\x00-\x20,;\"]*[\x80-\xff][^\t\r\n,;\"]*", head)
    if word is None:
        return ""
    out = []
    for name in SHOWN:
        try:
            text = word[0].decode(WIDER.get(name, name)).strip()
        except UnicodeDecodeError:
            continue
        if text.isprintable():
            out.append(f"{text[:LONGEST_READING]!r} in {name}")
    return f" (this may be {', '.join(out)})" if out else ""
