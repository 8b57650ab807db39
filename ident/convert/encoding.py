"""How a text log is encoded: as its map says, by its mark, as UTF-8, or as Western letters, where they are plain."""

from __future__ import annotations

import codecs
import re
from collections.abc import Sequence
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
SHOWN = ("shift_jis", "gb18030", "big5", "euc_kr", "cp1251", "cp1252")  # readings of an error, of those that can be
LONGEST_READING = 24  # characters of one

# Bytes of cp1252 as Latin-1 has them: letters, and signs of units and numbers.
LETTERS = "À-ÖØ-öø-ÿ"
SIGNS = "°º²³µ·±\xa0"
# Punctuation between blanks, where no character of two bytes can begin or end.
PUNCTUATION = re.compile("(?<![\x80-\xff])[\x80\x85\x91-\x97\x99](?=[\\s!-/]|$)")
# Others, which are signs only where no byte above ASCII is beside them.
ALONE = re.compile(f"(?<![\x80-\xff])(?![{SIGNS}])[\xa1-\xbf×÷](?![\x80-\xff])")
WORDS = re.compile(f"[A-Za-z{LETTERS}]+")

# Bytes of the characters in common use: the first level of each standard, and syllables.
COMMON = {
    "cp932": rb"[\x81-\x83\x88-\x97].",
    "gb18030": rb"[\xa1-\xa9\xb0-\xd7][\xa1-\xfe]",
    "big5": rb"[\xa1-\xc6].",
    "cp949": rb"[\xa1-\xac\xb0-\xc8][\xa1-\xfe]",
}


def known_encoding(name: str, key: str, where: str) -> str:
    """The name of an encoding, checked.

    Raises:
        DataError: where Python knows none of that name, or it is none of texts.
    """
    try:
        if "1,2\n".encode(name).decode(name, errors="replace") == "1,2\n":
            return name
    except (LookupError, ValueError):
        pass
    raise DataError(key, where, repr(name), 'an encoding, as "utf-8", "shift_jis", "gb18030", "cp1252" or "utf-16"')


def encoding_of(path: Path, stated: str = "") -> str:
    """The encoding by which Python reads a text; empty where it is not stated, and no mark of it tells.

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
        if name == "utf-16" and not marked:
            name = _wide(head) or name
        bad = _undecoded(head, name)
        if bad is not None:
            found = f"bytes that are no {stated} in line {head[:bad].count(10) + 1}"
            raise DataError("encoding", str(path), found, f"the one that it is written in{_readings(head)}")
        return name
    if marked:
        return marked
    wide = _wide(head)
    if wide:
        return wide
    if _undecoded(head, "utf-8") is None:
        return "utf-8"
    return ""


def western(path: Path, names: Sequence[str]) -> bool:
    """Whether a text whose bytes tell no encoding is of Western letters, by the names and units of its columns, as
    Latin-1: texts below them may hold anything. Where these are plain ASCII, its first bytes tell."""
    with path.open("rb") as file:
        head = file.read(LOOKED_AT)
    if _undecoded(head, "cp1252") is not None:
        return False
    return _western("\t".join((*names, "")) if not all(map(str.isascii, names)) else head.decode("latin-1"))


def _wide(head: bytes) -> str:
    """Which UTF-16 a table without a mark is, of which every other byte is zero; empty where it is none."""
    for start, encoding in ((1, "utf-16-le"), (0, "utf-16-be")):
        half = head[start::2]
        if len(half) > 8 and half.count(0) > 0.9 * len(half):
            return encoding
    return ""


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
    except UnicodeError as err:  # a mark that is missing has no place
        return err.start if isinstance(err, UnicodeDecodeError) else 0
    return None


def _western(text: str) -> bool:
    """Whether bytes above ASCII, read as Latin-1, are letters within words of ASCII and signs that stand alone.

    Characters of two bytes come as several of such in a row, or as capitals behind small letters; words of other
    alphabets have no letters of ASCII. Words with few of them, and signs that are rarer, are Western where the bytes
    have no East Asian reading with a character that is in common use.
    """
    text = PUNCTUATION.sub(" ", text)
    plain = ALONE.sub(" ", text)
    if re.search(
        f"[^\x00-\x7f{LETTERS}{SIGNS}]|[{SIGNS}][{LETTERS}{SIGNS}]|[{LETTERS}][{SIGNS}]|[a-zß-öø-ÿ][À-ÖØ-Þ]", plain
    ):
        return False
    strange = re.compile(f"[{LETTERS}]")
    shares = [len(strange.findall(w)) / len(w) for w in WORDS.findall(plain) if len(w) > 1 and not w.isascii()]
    if all(x <= 1 / 2 for x in shares) and plain == text:
        return True
    return all(x <= 2 / 3 for x in shares) and not any(_common(text.encode("latin-1"), name) for name in COMMON)


def _common(text: bytes, encoding: str) -> bool:
    """Whether bytes can be of an East Asian encoding, and one of its characters in common use is among them."""
    try:
        read = codecs.getincrementaldecoder(encoding)().decode(text)
    except UnicodeDecodeError:
        return False
    # Signs for syllables may stand in one byte, but hardly one by itself.
    return re.search("[\uff66-\uff9f]{2}", read) is not None or any(
        re.fullmatch(COMMON[encoding], ch.encode(encoding), re.DOTALL) for ch in set(read) if not ch.isascii()
    )


def _readings(head: bytes) -> str:
    """How the first bytes above ASCII read in encodings that they can be of, in words; empty where none can."""
    first = re.search(rb"[\x80-\xff]", head)
    # No more before it than is shown: a pattern would look through a long text from each of its characters.
    head = head[max(first.start() - LONGEST_READING, 0) :] if first else b""
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
