"""STATUSTEXT in parts: a text longer than 50 bytes comes in several messages of one id."""

from __future__ import annotations

from dart_flight.vehicle.messages import TextChunk

_CUT = "..."  # stands for a lost part


class TextAssembler:
    """Joins the parts of texts, one text at a time as PX4 sends them."""

    def __init__(self) -> None:
        self._severity, self._id, self._next = "", 0, 0
        self._text = ""
        self._is_old = False  # a heartbeat has come since the last part

    def add(self, part: TextChunk) -> list[tuple[str, str]]:
        """Add a part; returns (severity, text) of each text that it completes or cuts off."""
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
        """Return the text whose next part has not come for a second; called with every heartbeat."""
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
        text = self._text.strip()  # PX4 ends a text with a tab if it sends it as an event as well
        self._text, self._id, self._next = "", 0, 0
        self._is_old = False
        return self._severity, text
