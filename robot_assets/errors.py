"""The one exception for bad input."""

from __future__ import annotations

LONGEST = 200  # characters kept of each part of the line


class DataError(Exception):
    """Input that cannot be used; one line says what, where, what was found and what was expected.

    Attributes:
        what: the thing at fault (a file, column, key, joint).
        where: the file or place it is in.
        found: what stands there.
        expected: what would have been valid.
    """

    def __init__(self, what: str, where: str, found: str, expected: str) -> None:
        self.what, self.where, self.found, self.expected = what, where, found, expected
        super().__init__(f"{_line(what)}: {_line(where, 400)}: found {_line(found)}, expected {_line(expected, 600)}")

    def __reduce__(self) -> tuple:
        """As it was made: it reaches other processes."""
        return type(self), (self.what, self.where, self.found, self.expected)


def _line(text: str, longest: int = LONGEST) -> str:
    """The text on one line, without control characters, shortened in the middle."""
    line = "".join(c if c.isprintable() else " " for c in " ".join(str(text)[: 50 * longest].split()))
    return line if len(line) <= longest else f"{line[: longest // 2]} ... {line[-longest // 3 :]}"
