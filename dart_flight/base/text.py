"""Text for terminals, JSON and files: battery figures, alternatives, and escapes for external text.

External text consists of paths, names and messages from elsewhere. If a file name has bytes that are not
UTF-8, Python decodes these bytes to surrogates, which no encoder accepts. Such bytes are printed as `\\xff`.
A character that the output's encoding lacks is printed as ASCII or as an escape.
"""

from __future__ import annotations

import codecs
from collections.abc import Iterable

ESCAPED = "dart_flight.escaped"  # error handler for `str.encode` and `open`
_ASCII = {"\N{NO-BREAK SPACE}": " ", "±": "+/-", "→": "->", "°": " deg", "…": "...", "–": "-", "−": "-"}
_FIRST_BYTE, _LAST_BYTE = 0xDC80, 0xDCFF  # surrogates that represent single bytes


def battery_figures(remaining: float | None, voltage_v: float | None) -> list[str]:
    """Return strings such as ["95 %", "16.2 V"], without unknown values."""
    charge = None if remaining is None else f"{100.0 * remaining:.0f} %"
    voltage = None if voltage_v is None else f"{voltage_v:.1f} V"
    return [figure for figure in (charge, voltage) if figure is not None]


def alternatives(names: Iterable[str]) -> str:
    """Return names as text, such as `maestro, pwm or px4`."""
    *first, last = names
    return f"{', '.join(first)} or {last}" if first else last


def printable(text: str) -> str:
    """Replace characters that UTF-8 cannot encode with escapes."""
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
