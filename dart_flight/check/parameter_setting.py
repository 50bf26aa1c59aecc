"""Reading and writing of the PX4 parameters that differ from the wanted values: `dart-flight parameters`."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping
from datetime import UTC, datetime
from pathlib import Path

import msgspec

from dart_flight.check.px4_parameters import position_source
from dart_flight.check.vehicle_check import evaluate_autopilot
from dart_flight.check.vehicle_reading import parse_release
from dart_flight.check.wanted_parameters import (
    METADATA,
    RESTART,
    RESTART_SOURCE,
    MetadataError,
    ParameterRow,
    list_differences,
    restart_names,
    wanted_parameters,
    with_lock_output,
)
from dart_flight.config.document import report_write_errors
from dart_flight.config.mission import Mission
from dart_flight.config.parameter_file import (
    PositionSource,
    Value,
    differences,
    format_parameters,
    load_parameters,
)
from dart_flight.vehicle import messages
from dart_flight.vehicle.downloads import DownloadError
from dart_flight.vehicle.ground_link import GroundLink
from dart_flight.vehicle.vehicle_session import VehicleError

_SOURCES = ("EKF2_EV_CTRL", "EKF2_GPS_CTRL")  # they determine the position source
_FIX_S = 1.5

Progress = Callable[[int, int], None]  # number of parameters read, total number


class ParameterReading(msgspec.Struct, frozen=True):
    """The parameters of a vehicle that differ from the wanted values.

    Attributes:
        rows: one row for each of these parameters.
        position_from: the wanted position source, or None if the wanted values are those of a file.
        version: PX4's version, empty if not reported.
        restart_source: source of the list of parameters that need a restart, or None if there are no rows.
    """

    rows: list[ParameterRow]
    position_from: PositionSource | None
    version: str
    restart_source: str | None

    @property
    def writable(self) -> list[ParameterRow]:
        """The rows whose parameters exist on the vehicle."""
        return [row for row in self.rows if row.vehicle is not None]


def read_differences(
    link: GroundLink,
    mission: Mission,
    claimed: PositionSource | None,
    restored: Path | None,
    progress: Progress = lambda done, of: None,
) -> ParameterReading:
    """Read a vehicle's parameters and compare them with the wanted values.

    Args:
        link: connection to the vehicle.
        mission: provides the vehicle and the frame.
        claimed: position source that the operator claims, or None. If None, the source is motion capture if
            it is configured; otherwise the vehicle's parameters select the source.
        restored: file to restore, or None. If a file is given, its values are the wanted values.
        progress: receives the number of parameters read and the total number.

    Raises:
        InputError: the file is wrong.
        VehicleError: another autopilot answers.
        NoAnswerError: the vehicle does not answer requests.
    """
    wrong = evaluate_autopilot(link.heartbeat_mode())
    if wrong:
        raise VehicleError(wrong[0].says)
    version = link.version()
    source = None
    if restored is not None:
        says = f"as in {restored.name}"
        wanted = {
            name: msgspec.structs.replace(p, reason=p.reason or says)
            for name, p in load_parameters(restored).items()
        }
    else:
        source = claimed or _source(link, mission)
        wanted = wanted_parameters(mission, source)
    release = parse_release(version)
    names = [p.name for p in wanted.values() if not p.is_absent_in(release)]
    if restored is None:
        names += [name for name in with_lock_output(mission, {}, {}) if name not in names]
    values = link.read_parameters(names, lambda done: progress(done, len(names)))
    values |= link.read_parameters(
        [p.renamed for p in wanted.values() if p.renamed is not None and p.name not in values]
    )
    if restored is None:
        wanted = with_lock_output(mission, wanted, values)
    if not differences(wanted, values):
        return ParameterReading([], source, version, None)
    restart, known_from = _restart_names(link)
    return ParameterReading(list_differences(wanted, values, restart), source, version, known_from)


def _source(link: GroundLink, mission: Mission) -> PositionSource | None:
    if mission.vehicle.mocap.url is not None:
        return PositionSource.MOCAP
    return position_source(link.read_parameters(_SOURCES), link.newest(messages.GPS_RAW_INT, _FIX_S))


def _restart_names(link: GroundLink) -> tuple[frozenset[str], str]:
    """Return the parameters that need a restart, and the source of this list."""
    try:
        return restart_names(link.read_file(METADATA)), "the parameter metadata of this PX4"
    except (DownloadError, MetadataError):
        return RESTART, RESTART_SOURCE


def save_previous(rows: Iterable[ParameterRow], folder: Path, head: str, now: datetime | None = None) -> Path:
    """Save the vehicle's present values to a dated file that QGroundControl can load; return its path.

    Args:
        rows: the parameters.
        folder: folder of the file.
        head: description of the vehicle, one line.
        now: time for the file's name, or None for the present.

    Raises:
        InputError: the file cannot be written.
    """
    now = now or datetime.now(UTC)
    path = folder / f"px4_before_{now:%Y-%m-%d_%H%M%S}.params"
    values: Mapping[str, Value] = {row.name: row.vehicle for row in rows if row.vehicle is not None}
    lines = [f"{head}: values before the write, {now:%Y-%m-%d %H:%M:%S} UTC"]
    lines.append(f"to restore these values: dart-flight parameters MISSION --restore {path.name}")
    with report_write_errors(path), open(path, "x", encoding="utf-8") as file:
        file.write(format_parameters(values, lines))
    return path


def write_rows(
    link: GroundLink, rows: Iterable[ParameterRow], progress: Progress = lambda done, of: None
) -> dict[str, str]:
    """Write parameters and read them back.

    Returns:
        The names of the parameters that were not accepted, each with the reason.

    Raises:
        NoAnswerError: the vehicle does not answer requests.
    """
    rows, refused = list(rows), {}
    for done, row in enumerate(rows):
        progress(done, len(rows))
        try:
            link.write_parameter(row.name, row.wanted)
        except VehicleError as error:
            refused[row.name] = str(error)
    back = link.read_parameters([row.name for row in rows])
    for row in rows:
        actual = back.get(row.name)
        if actual is None or not math.isclose(actual, row.wanted, rel_tol=1e-6, abs_tol=1e-9):
            has = "cannot be read back" if actual is None else f"is {actual:g} after writing {row.wanted:g}"
            refused.setdefault(row.name, f"{row.name} {has}")
    return refused
