"""Live line at the bottom of the terminal, below the decisions of a flight: phase, position and state."""

from __future__ import annotations

import math
import shutil
import time
from collections.abc import Callable
from typing import IO, Any

from dart_flight.base.geometry import norm
from dart_flight.base.records import (
    ForceEstimate,
    LockState,
    OdometrySample,
    PhaseChange,
    Record,
    StatusSample,
)
from dart_flight.config.mission import Mission
from dart_flight.lock.state_machine import describe
from dart_flight.recording.anchor import MissionFrameReader

_PERIOD_S = 0.2
_CLEAR = "\r\x1b[K"


class LiveLine:
    """Line with phase, position, speed, force, lock and battery, updated five times per second.

    `Live` from rich is not used, because each of its refreshes blocks the core's interpreter for half a
    millisecond.
    """

    def __init__(
        self, mission: Mission, terminal: IO[str], now_s: Callable[[], float] = time.monotonic
    ) -> None:
        self._terminal, self._now_s = terminal, now_s
        self._anchor = MissionFrameReader(mission)
        self._shown = False
        self._due_s = -math.inf
        self._phase, self._lock, self._battery, self._force_n = "", "", "", 0.0
        self._handlers: dict[type[Record], Callable[[Any], None]] = {
            PhaseChange: self._handle_phase,
            LockState: self._handle_lock,
            StatusSample: self._handle_status,
            ForceEstimate: self._handle_force,
            OdometrySample: self._handle_odometry,
        }

    def __call__(self, record: Record) -> None:
        self._anchor.add(record)
        handler = self._handlers.get(type(record))
        if handler is not None:
            handler(record)

    def clear(self) -> None:
        if self._shown:
            self._shown = False
            self._terminal.write(_CLEAR)
            self._terminal.flush()

    def _handle_phase(self, change: PhaseChange) -> None:
        self._phase = change.after.value

    def _handle_lock(self, state: LockState) -> None:
        self._lock = f"lock {describe(state)}".removesuffix(" (no feedback)")

    def _handle_status(self, status: StatusSample) -> None:
        self._battery = "" if status.battery_v is None else f"{status.battery_v:.1f} V"

    def _handle_force(self, estimate: ForceEstimate) -> None:
        self._force_n = max(self._force_n, norm(estimate.force_mission))

    def _handle_odometry(self, sample: OdometrySample) -> None:
        now, frame = self._now_s(), self._anchor.frame
        if now < self._due_s or frame is None:
            return
        self._due_s = now + _PERIOD_S
        x, y, z = frame.point_from_ned(sample.position_ned)
        parts = (
            self._phase,
            f"({x:.2f}, {y:.2f}, {z:.2f}) m",
            f"{norm(sample.velocity_ned):.2f} m/s",
            f"force {self._force_n:.1f} N",
            self._lock,
            self._battery,
        )
        self._force_n = 0.0
        width = shutil.get_terminal_size().columns - 1
        self._shown = True
        self._terminal.write(_CLEAR + "  ".join(part for part in parts if part)[:width])
        self._terminal.flush()
