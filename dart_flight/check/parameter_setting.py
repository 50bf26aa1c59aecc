"""Read and write the PX4 parameters that differ from the desired values, for `dart-flight parameters`."""

from __future__ import annotations

import re
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
    ParameterState,
    list_differences,
    restart_names,
    state_of,
    wanted_parameters,
    with_lock_output,
)
from dart_flight.config.document import InputError, report_write_errors
from dart_flight.config.mission import Mission
from dart_flight.config.parameter_file import (
    Parameter,
    PositionSource,
    Value,
    format_parameters,
    is_same_value,
    read_parameter_file,
    show_value,
)
from dart_flight.vehicle import messages
from dart_flight.vehicle.downloads import DownloadError
from dart_flight.vehicle.ground_link import GroundLink
from dart_flight.vehicle.vehicle_session import NoAnswerError, VehicleError

_MOCAP_SOURCE, _GPS_SOURCE = "EKF2_EV_CTRL", "EKF2_GPS_CTRL"  # parameters that determine the position source
_FIX_S = 1.5
_SETTLE_S = 3.0  # wait in the vehicle's time; PX4's modules may limit a written value up to 2 s later
# Values of one flight controller and its sensors. PX4's start-up script keeps most of them when it resets all
# parameters: SYS_PARAM_VER SYS_AUTOCFG_CAL CAL_* LND_FLIGHT* TC_* COM_FLIGHT*.
_OF_ONE_BOARD = re.compile(
    r"MAV_SYS_ID|CAL_.*|TC_.*|SENS_BOARD_[XYZ]_OFF|SENS_GPS\d_ID|SENS_DPRES_OFF|LND_FLIGHT.*|COM_FLIGHT.*"
    r"|SYS_PARAM_VER|SYS_AUTOCFG_CAL"
)

Progress = Callable[[int, int], None]  # arguments: number of parameters read, and total number


class ParameterReading(msgspec.Struct, frozen=True):
    """The parameters of a vehicle that do not have the desired values.

    Attributes:
        rows: one row for each of these parameters.
        position_from: the assumed position source, or None if unknown, or if the desired values are from a
            file.
        version: PX4's version, empty if not reported.
        restart_source: source of the list of parameters that need a restart, or None if there are no rows.
        states: state of each requested parameter, by name.
        remarks: lines for the operator, such as the rows of a file that are not restored.
    """

    rows: list[ParameterRow]
    position_from: PositionSource | None
    version: str
    restart_source: str | None
    states: dict[str, ParameterState] = {}
    remarks: list[str] = []

    @property
    def writable(self) -> list[ParameterRow]:
        """The rows whose parameters exist on the vehicle."""
        return [row for row in self.rows if row.state is ParameterState.PRESENT]

    def names(self, state: ParameterState) -> list[str]:
        """Return the names of the rows in a given state."""
        return [row.name for row in self.rows if row.state is state]


class WriteReport(msgspec.Struct):
    """The result of writing parameters.

    Attributes:
        written: names whose new value was read back. If there is no `problem`, every other name is in
            `refused`.
        refused: reason of the refusal, by the parameter's name.
        problem: reason why the link was lost, or None. If the link was lost, `written` has the acknowledged
            names, which were not read back.
    """

    written: list[str]
    refused: dict[str, str]
    problem: str | None = None


class RestoredFile(msgspec.Struct, frozen=True):
    """The parameters to restore from a file; see `read_parameter_file`.

    Attributes:
        vehicles: ids of the vehicles in the file.
        remarks: lines about the rows that are not restored.
    """

    parameters: dict[str, Parameter]
    vehicles: frozenset[str] = frozenset()
    remarks: list[str] = []


def load_restored(path: Path, everything: bool = False) -> RestoredFile:
    """Read a file to restore; `everything` includes the values that belong to one flight controller.

    Raises:
        InputError: the file is wrong, or nothing remains.
    """
    file, remarks = read_parameter_file(path), list[str]()
    if file.skipped:
        others = ", ".join(f"{count} of component {name}" for name, count in file.skipped.items())
        remarks.append(f"rows of components other than the autopilot are skipped: {others}")
    own = [] if everything else [name for name in file.parameters if _OF_ONE_BOARD.fullmatch(name)]
    if own:
        remarks.append(f"values of one flight controller are restored only with --all: {', '.join(own)}")
    if len(own) == len(file.parameters):
        raise InputError(remarks[-1], source=str(path))
    kept = {
        name: msgspec.structs.replace(p, reason=p.reason or f"as in {path.name}")
        for name, p in file.parameters.items()
        if name not in own
    }
    return RestoredFile(kept, file.vehicles, remarks)


def read_differences(
    link: GroundLink,
    mission: Mission,
    claimed: PositionSource | None,
    restored: RestoredFile | None,
    progress: Progress = lambda done, of: None,
) -> ParameterReading:
    """Read a vehicle's parameters and compare them with the desired values.

    Args:
        mission: provides the vehicle and the frame.
        claimed: position source that the operator claims. None selects a configured motion capture, otherwise
            the source in the vehicle's parameters.
        restored: file whose values are the desired values, or None.
        progress: receives the number of parameters read and the total number.

    Raises:
        VehicleError: the autopilot that answers is not PX4.
        NoAnswerError: the vehicle does not answer requests.
    """
    wanted: dict[str, Parameter] = {}
    remarks: list[str] = []
    if restored is not None:
        wanted, remarks = restored.parameters, list(restored.remarks)
        foreign = sorted(restored.vehicles - {str(link.system_id)})
        if foreign:
            own = f"this vehicle has system id {link.system_id}"
            remarks.append(f"the file is from vehicle {', '.join(foreign)}; {own}")
    wrong = evaluate_autopilot(link.heartbeat_mode())
    if wrong:
        raise VehicleError(wrong[0].message)
    version = link.version()
    release = parse_release(version)
    unanswered: set[str] = set()
    source, values = None, dict[str, Value]()
    if restored is None:
        source, values = _source(link, mission, claimed, unanswered)
        if unanswered:
            remarks.append(
                f"the position source is unknown, no answer for {', '.join(sorted(unanswered))}: "
                "try again, or give --position-from"
            )
        wanted = wanted_parameters(mission, source)
    names = list(dict.fromkeys([*values, *unanswered]))
    names += [p.name for p in wanted.values() if not p.is_absent_in(release) and p.name not in names]
    if restored is None:
        names += [name for name in with_lock_output(mission, {}, {}) if name not in names]
    asked = [name for name in names if name not in values]
    unanswered.clear()
    values |= link.read_parameters(asked, lambda done: progress(done, len(asked)), unanswered)
    values |= link.read_parameters(
        [p.renamed for p in wanted.values() if p.renamed is not None and p.name not in values],
        unanswered=unanswered,
    )
    if restored is None:
        wanted = with_lock_output(mission, wanted, values)
    states = {name: state_of(name, values, unanswered) for name in names}
    if not list_differences(wanted, values, (), unanswered):
        return ParameterReading([], source, version, None, states, remarks)
    restart, known_from = _restart_names(link)
    rows = list_differences(wanted, values, restart, unanswered)
    return ParameterReading(rows, source, version, known_from, states, remarks)


def _source(
    link: GroundLink, mission: Mission, claimed: PositionSource | None, unanswered: set[str]
) -> tuple[PositionSource | None, dict[str, Value]]:
    """Return the position source, or None if unknown, and the parameters that were read to find it.

    Add to `unanswered` the parameters whose missing answer leaves the source unknown.
    """
    if claimed is not None:
        return claimed, {}
    if mission.vehicle.mocap.url is not None:
        return PositionSource.MOCAP, {}
    lost: set[str] = set()
    values = link.read_parameters([_MOCAP_SOURCE, _GPS_SOURCE], unanswered=lost)
    source = position_source(values, link.newest(messages.GPS_RAW_INT, _FIX_S))
    if _MOCAP_SOURCE in lost or (_GPS_SOURCE in lost and source is None):
        unanswered |= lost
        source = None
    return source, values


def _restart_names(link: GroundLink) -> tuple[frozenset[str], str]:
    """Return the parameters that need a restart, and the source of this list."""
    try:
        return restart_names(link.read_file(METADATA)), "the parameter metadata of this PX4"
    except (DownloadError, MetadataError):
        return RESTART, RESTART_SOURCE


def save_previous(
    rows: Iterable[ParameterRow], folder: Path, head: str, system_id: int, now: datetime | None = None
) -> Path:
    """Save the vehicle's current values to a dated file that QGroundControl can load; return its path.

    Args:
        head: description of the vehicle, one line.
        system_id: the vehicle's MAVLink system id.
        now: time for the file's name; None means the current time.
    """
    now = now or datetime.now(UTC)
    path = folder / f"px4_before_{now:%Y-%m-%d_%H%M%S}.params"
    values: Mapping[str, Value] = {row.name: row.vehicle for row in rows if row.vehicle is not None}
    lines = [f"{head}: values before the write, {now:%Y-%m-%d %H:%M:%S} UTC"]
    lines.append(f"to restore these values: dart-flight parameters MISSION --restore {path.name}")
    with report_write_errors(path), open(path, "x", encoding="utf-8") as file:
        file.write(format_parameters(values, lines, system_id))
    return path


def write_rows(
    link: GroundLink, rows: Iterable[ParameterRow], progress: Progress = lambda done, of: None
) -> WriteReport:
    """Write parameters, wait until PX4 has limited the values, and read them back."""
    rows, failed = list(rows), dict[str, str]()
    done = 0
    try:
        for done, row in enumerate(rows):
            progress(done, len(rows))
            try:
                link.write_parameter(row.name, row.wanted)
            except VehicleError as error:
                failed[row.name] = str(error)
        done = len(rows)
        link.wait(_SETTLE_S)
        unanswered: set[str] = set()
        back = link.read_parameters([row.name for row in rows], unanswered=unanswered)
    except NoAnswerError as error:
        sent = [row.name for row in rows[:done] if row.name not in failed]
        return WriteReport(sent, failed, error.one_line())
    written, refused = [], {}
    for row in rows:
        actual = back.get(row.name)
        if actual is not None and is_same_value(actual, row.wanted):
            written.append(row.name)  # PX4 has the value, even if its acknowledgement was lost
            continue
        if actual is None:
            message = "no answer" if row.name in unanswered else "not on this vehicle"
            message = f"{row.name} cannot be read back: {message}"
        else:
            message = f"{row.name} is {show_value(actual)} after writing {show_value(row.wanted)}"
        refused[row.name] = failed.get(row.name, message)
    return WriteReport(written, refused)
