"""PX4's announcements of a failsafe or a termination, remembered for 3 s.

Texts and events arrive immediately; the heartbeat with the new mode and status follows up to 1 s later.
"""

from __future__ import annotations

import re
from typing import Final

from dart_flight.base.records import StatusText, SystemStatus

_MEMORY_US: Final = 3_000_000
# Warnings without a mode change: "Failsafe warning: ...", events ending in _warn, and low battery.
_WARNING = re.compile(r"failsafe warning|_warn$|_low_bat$")
_EVENT: Final = "commander_failsafe_enter"
_SWITCHING = re.compile(r"^(.+): switching to (?!offboard)")  # wording of PX4's main branch, as text or event
_ACTIVATED = re.compile(r"failsafe activated|autopilot disengaged")
_TO_STICKS = re.compile(r"switching to (position|altitude|stabilized)")
_TERMINATED = re.compile(r"flight termination|switching to terminat|kill(?:.switch)? engaged")
_FAILSAFES: Final = frozenset({SystemStatus.CRITICAL, SystemStatus.EMERGENCY})

_MENTIONED, _ANNOUNCED, _CAUSE_NAMED = 1, 2, 3


class FailsafeEvidence:
    """PX4's announcements of the last 3 s; all times are autopilot time in microseconds."""

    def __init__(self) -> None:
        self._rank, self._words, self._text_us = 0, "", 0
        self._termination, self._terminated_us = "", 0

    def add_text(self, item: StatusText, now_us: int) -> None:
        """Remember a PX4 text or event if it announces a failsafe or a termination.

        A generic text does not replace an earlier text that names the cause.
        """
        words = "; ".join(line.strip() for line in item.text.splitlines() if line.strip())
        text = item.text.strip().lower()
        if _TERMINATED.search(text):
            self._termination, self._terminated_us = words, now_us
        rank = _rank_of(text, item.event)
        if rank and rank >= self._rank_at(now_us):
            self._rank, self._words, self._text_us = rank, words, now_us

    def is_mentioned(self, now_us: int) -> bool:
        """Return whether PX4 has mentioned a failsafe; a change of mode is then PX4's, not a pilot's."""
        return self._rank_at(now_us) >= _MENTIONED

    def announcement(self, now_us: int) -> str | None:
        """Return the text in which PX4 announced a change of mode, or None."""
        return self._words if self._rank_at(now_us) >= _ANNOUNCED else None

    def hands_to_sticks(self, now_us: int) -> bool:
        """Return whether the announced failsafe switches to a mode in which a pilot flies with the sticks."""
        words = self.announcement(now_us)
        return words is not None and _TO_STICKS.search(words.lower()) is not None

    def termination(self, now_us: int) -> str | None:
        return self._termination if self._termination and now_us - self._terminated_us < _MEMORY_US else None

    def words(self, now_us: int) -> str:
        """Return PX4's most specific text about its failsafe, or an empty string."""
        return self._words if self._rank_at(now_us) else ""

    def _rank_at(self, now_us: int) -> int:
        return self._rank if now_us - self._text_us < _MEMORY_US else 0


def in_failsafe(status: SystemStatus) -> bool:
    return status in _FAILSAFES


def _rank_of(text: str, event: str) -> int:
    if _WARNING.search(text) or _WARNING.search(event):
        return _MENTIONED if "failsafe" in text else 0
    found = _SWITCHING.search(text)
    if found is not None and ("\n" in text or not _ACTIVATED.search(found[1])):
        return _CAUSE_NAMED  # PX4 sends each failed check as a separate text
    if found is not None or _ACTIVATED.search(text) or event.startswith(_EVENT):
        return _ANNOUNCED
    return _MENTIONED if "failsafe" in text else 0
