"""The one exception for bad input."""

from __future__ import annotations


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
        super().__init__(f"{what}: {where}: found {found}, expected {expected}")
