"""Text from outside (paths, names, messages) made fit for terminals, JSON and files.

Python reads the bytes of a file name that are not UTF-8 as surrogates, which no encoder accepts. They are
shown as `\\xff`. A character that an output's encoding lacks is shown by an ASCII spelling or an escape.
"""

from __future__ import annotations

import codecs

ESCAPED = "dart_flight.escaped"  # error handler for `str.encode` and `open`
_ASCII = {"\N{NO-BREAK SPACE}": " ", "±": "+/-", "→": "->", "°": " deg", "…": "...", "–": "-", "−": "-"}
_FIRST_BYTE, _LAST_BYTE = 0xDC80, 0xDCFF  # surrogates that stand for single bytes


def printable(text: str) -> str:
    """Return the text with everything escaped that UTF-8 cannot encode."""
    return text if text.isascii() else text.encode("utf-8", ESCAPED).decode()


def _escape(error: UnicodeError) -> tuple[str, int]:
    if not isinstance(error, UnicodeEncodeError):
        raise error
    return "".join(_spell(c) for c in error.object[error.start : error.end]), error.end


def _spell(character: str) -> str:
    code = ord(character)
    if _FIRST_BYTE <= code <= _LAST_BYTE:
        return f"\\x{code - 0xDC00:02x}"
    return _ASCII.get(character) or character.encode("ascii", "backslashreplace").decode()


codecs.register_error(ESCAPED, _escape)
