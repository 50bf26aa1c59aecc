"""Assembly of STATUSTEXT parts: a text longer than 50 bytes arrives as several messages with one id."""

from __future__ import annotations

from dart_flight.vehicle.messages import TextChunk

_CUT = "..."  # replaces a lost part


class TextAssembler:
    """Assembler of texts from their parts, one text at a time in PX4's order."""

    def __init__(self) -> None:
        self._severity, self._id, self._next = "", 0, 0
        self._text = ""
        self._is_old = False  # whether a heartbeat has arrived since the last part

    def add(self, part: TextChunk) -> list[tuple[str, str]]:
        """Add a part; return (severity, text) of each text that it completes or interrupts."""
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
        """Return the text without a new part for a second, if any; call at every heartbeat."""
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
