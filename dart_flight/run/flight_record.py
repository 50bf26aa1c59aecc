"""The recorder of one flight in any world: it writes the log and forms the verdict."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Literal

import msgspec

from dart_flight.base.records import LogFailure, Record, TruthSample, World
from dart_flight.config.document import InputError, write_problem
from dart_flight.config.mission import Mission
from dart_flight.config.provenance import display_path
from dart_flight.recording.about import describe_flight
from dart_flight.recording.found import LOG_NAME
from dart_flight.recording.reader import IN_MEMORY, Log, LogEntry, read_log
from dart_flight.recording.verdict import TimeKind, Verdict, VerdictBuilder
from dart_flight.recording.writer import FlightLog, new_flight_folder

Onlooker = Callable[[Record], None]
LogPlace = Path | Literal["<memory>"] | None  # a folder for the flight's folder, memory, or None for no log


class MemoryLog:
    """Log of one flight in memory, with the interface of `FlightLog`."""

    shortfall: str | None = None  # a log in memory is always complete

    def __init__(self, about: dict[str, str]) -> None:
        self.log = Log(IN_MEMORY, about, {}, [], complete=True)

    def put(self, record: Record, number: int) -> None:
        """Append an input with its number, or another record with the number of the input that caused it."""
        self.log.entries.append(LogEntry(number, record))

    def close(self) -> None:
        """Do nothing, because a log in memory needs no closing."""


class FlightRecord:
    """Recorder of one flight; call it once for each record, in order.

    Args:
        log_dir: parent folder of the flight's folder, `IN_MEMORY`, or None for no log (campaigns).
        drawn: random quantities of the simulated world, a map from name to value.

    Attributes:
        onlookers: callbacks for every record, on the thread that produced it.
        viewers: callbacks for every record and for the truth of a simulated vehicle. The truth arrives on
            another thread. The callbacks must not block.
        notice: callback for the first failure of the log, on the thread that calls the recorder.

    Raises:
        InputError: the log cannot be written.
    """

    def __init__(
        self,
        mission: Mission,
        world: World,
        seed: int | None,
        log_dir: LogPlace,
        drawn: Mapping[str, float | str] | None = None,
    ) -> None:
        self._world, self._seed, self._drawn = world, seed, dict(drawn or {})
        self.verdict = VerdictBuilder(mission)
        # The verdict has no handler for most records, which are therefore skipped.
        self._handlers = self.verdict.handlers
        self.onlookers: list[Onlooker] = []
        self.viewers: list[Onlooker] = []
        self.notice: Onlooker = lambda record: None
        self._fails = False
        self.time: TimeKind | None = None
        self._first: tuple[int, float] | None = (
            None  # simulated time (microseconds) and the computer's time (seconds) of one record
        )
        self._last: tuple[int, float] | None = None
        self._log: FlightLog | MemoryLog | None = None
        if log_dir is not None:
            about = describe_flight(mission, world, seed)
            if drawn:
                about["drawn"] = msgspec.json.encode(self._drawn).decode()
            if isinstance(log_dir, Path):
                self._log = _open_log(mission.name, log_dir, about)
            else:
                self._log = MemoryLog(about)

    @property
    def path(self) -> Path:
        assert isinstance(self._log, FlightLog)
        return self._log.path

    @property
    def log(self) -> Log:
        """The log, from memory or from the file."""
        return self._log.log if isinstance(self._log, MemoryLog) else read_log(self.path)

    @property
    def folder(self) -> Path:
        return self.path.parent

    def __call__(self, record: Record, number: int) -> None:
        """Log a record, and pass it to verdict, onlookers and viewers; `number` is as in `MemoryLog.put`."""
        log = self._log
        if log is not None:
            log.put(record, number)
            if not self._fails and log.shortfall is not None:
                self._report_failure(log.shortfall, getattr(record, "t_us", 0))
        take = self._handlers.get(type(record))
        if take is not None:
            take(record)
        for onlooker in self.onlookers:
            onlooker(record)
        for viewer in self.viewers:
            viewer(record)

    def _report_failure(self, why: str, t_us: int) -> None:
        self._fails = True
        failure = LogFailure(t_us, why.partition(",")[0])
        for notify in (self.notice, *self.viewers):
            notify(failure)

    def truth(self, record: Record) -> None:
        """Record the truth of a simulated vehicle, which is not an input of the core."""
        if isinstance(record, TruthSample):
            self._last = (record.t_us, time.monotonic())
            self._first = self._first or self._last
        if self._log is not None:
            self._log.put(record, 0)
        self.verdict.add(record)
        for viewer in self.viewers:
            viewer(record)

    @property
    def _speed(self) -> float | None:
        """The real-time factor so far, or None without a simulated vehicle."""
        if self._first is None or self._last is None or self._last[1] <= self._first[1]:
            return None
        return 1e-6 * (self._last[0] - self._first[0]) / (self._last[1] - self._first[1])

    def close(self) -> None:
        if self._log is not None:
            self._log.close()

    def build(self, px4_log: Path | None = None) -> Verdict:
        """Return the verdict so far; `px4_log` is the path of PX4's own log."""
        log = display_path(self.path) if isinstance(self._log, FlightLog) else None
        kept = display_path(px4_log) if px4_log is not None and px4_log.exists() else None
        built = self.verdict.build(self._world, self._seed, log, kept, self._drawn)
        built.time = self.time or built.time
        if self._world is not World.FAST:  # repeated fast flights must give equal verdicts
            built.speed = self._speed
        built.log_failure = self._log.shortfall if self._log is not None else None
        return built


def _open_log(name: str, log_dir: Path, about: dict[str, str]) -> FlightLog:
    try:
        return FlightLog(new_flight_folder(log_dir, name) / LOG_NAME, about)
    except OSError as error:
        why = write_problem(log_dir, error)
        raise InputError(f"cannot write the flight log: {why}", source=str(log_dir)) from None
