"""What is kept of one flight: its log, its verdict, and its onlookers."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path

import msgspec

from dart_flight.config.document import InputError
from dart_flight.config.mission import Mission
from dart_flight.config.provenance import shown_path
from dart_flight.recording.about import describe_flight
from dart_flight.recording.found import LOG_NAME
from dart_flight.recording.writer import FlightLog, new_flight_folder
from dart_flight.samples import Record, World
from dart_flight.verdict import Verdict, VerdictBuilder

Onlooker = Callable[[Record], None]


class FlightRecord:
    """Takes every record of one flight, in order; call it with a record and its number.

    Args:
        mission: what is flown.
        world: in which world.
        seed: of a simulated flight.
        log_dir: where the flight's folder goes; None: no log (campaigns).
        drawn: what the simulated world was drawn as, name -> value.

    Attributes:
        onlookers: called with every record, on the thread that took it.

    Raises:
        InputError: the log cannot be written.
    """

    def __init__(
        self,
        mission: Mission,
        world: World,
        seed: int | None,
        log_dir: Path | None,
        drawn: Mapping[str, float | str] | None = None,
    ) -> None:
        self._world, self._seed, self._drawn = world, seed, dict(drawn or {})
        self.verdict = VerdictBuilder(mission)
        self.onlookers: list[Onlooker] = [self.verdict.take]
        self._log: FlightLog | None = None
        if log_dir is not None:
            self._log = _open_log(mission, world, seed, log_dir, self._drawn)

    @property
    def path(self) -> Path:
        """The log's file."""
        assert self._log is not None
        return self._log.path

    @property
    def folder(self) -> Path:
        """The flight's folder."""
        return self.path.parent

    def __call__(self, record: Record, number: int) -> None:
        """Take a record with the number of the input that it is or follows from."""
        if self._log is not None:
            self._log.put(record, number)
        for onlooker in self.onlookers:
            onlooker(record)

    def truth(self, record: Record) -> None:
        """Take a record of the simulated vehicle that comes beside the core's inputs."""
        if self._log is not None:
            self._log.put(record, 0)
        self.verdict.take(record)

    def close(self) -> None:
        """End the log."""
        if self._log is not None:
            self._log.close()

    def build(self, px4_log: Path | None = None) -> Verdict:
        """The verdict so far; `px4_log` is PX4's own log, where there is one."""
        log = shown_path(self.path) if self._log is not None else None
        kept = shown_path(px4_log) if px4_log is not None and px4_log.exists() else None
        built = self.verdict.build(self._world, self._seed, log, kept)
        built.drawn = self._drawn
        return built


def _open_log(
    mission: Mission, world: World, seed: int | None, log_dir: Path, drawn: Mapping[str, float | str]
) -> FlightLog:
    try:
        path = new_flight_folder(log_dir, mission.name) / LOG_NAME
        about = describe_flight(mission, world, seed)
        if drawn:
            about["drawn"] = msgspec.json.encode(drawn).decode()
        return FlightLog(path, about)
    except OSError as error:
        raise InputError(f"cannot write the flight log: {error.strerror}", source=str(log_dir)) from None
