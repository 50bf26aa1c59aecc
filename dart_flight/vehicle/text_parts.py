"""Splitting and assembly of STATUSTEXTs: a text over 50 bytes becomes several messages with one id."""

from __future__ import annotations

from typing import Any

from dart_flight.vehicle.messages import TextChunk

_CUT = "..."  # stands for a lost part
_PART = 50  # bytes
_LONGEST = 199  # four parts; a limit, because PX4's forwarding buffer is small
_INFO = 6  # MAV_SEVERITY


def split_text(text: str, number: int) -> list[dict[str, Any]]:
    """Return the fields of the messages that carry a text; several messages share the id `number`."""
    plain = text.encode("ascii", "replace").decode()[:_LONGEST]
    if len(plain) <= _PART:
        return [{"severity": _INFO, "text": plain, "id": 0, "chunk_seq": 0}]
    # A part of fewer than 50 bytes, which may be empty, ends the text.
    starts = range(0, len(plain) + 1, _PART)
    return [
        {"severity": _INFO, "text": plain[start : start + _PART], "id": number, "chunk_seq": i}
        for i, start in enumerate(starts)
    ]


class TextAssembler:
    """An assembler of texts from their parts. PX4 sends the parts of a text consecutively."""

    def __init__(self) -> None:
        self._severity, self._id, self._next = "", 0, 0
        self._text = ""
        self._is_old = False  # whether a heartbeat has arrived since the last part

    def add(self, part: TextChunk) -> list[tuple[str, str]]:
        """Add a part; return (severity, text) of each text that the part completes or interrupts."""
        found: list[tuple[str, str]] = []
        if part.id == 0 or part.id != self._id or part.chunk < self._next:
            found = self._cut_off()
            self._severity, self._id, self._next = part.severity, part.id, 0
        self._text += (_CUT if part.chunk > self._next else "") + part.text
        self._next, self._is_old = part.chunk + 1, False
        if part.is_last:
            found.append(self._end())
        return found

    def overdue(self) -> list[tuple[str, str]]:
        """Return [incomplete text] if no new part has arrived for a second; call this at every heartbeat."""
        if self._is_old:
            return self._cut_off()
        self._is_old = bool(self._text)
        return []

    def _cut_off(self) -> list[tuple[str, str]]:
        if not self._text:
            return []
        self._text += _CUT
        return [self._end()]

    def _end(self) -> tuple[str, str]:
        text = self._text.strip()  # PX4 appends a tab if it also sends the text as an event
        self._text, self._id, self._next = "", 0, 0
        self._is_old = False
        return self._severity, text
