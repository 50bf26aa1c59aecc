"""Replay of a recorded flight through the flight core, with a comparison of every output.

The mission in the log configures a new core, which gets the inputs in the order of their numbers. Truth and
the shell's notes are not inputs. On the same kind of machine, outputs must be equal bit for bit. On another
kind of machine a relative error of 1e-9 is allowed, because the mathematics library may round differently.

With changed settings, the replay shows how the core decides on the recorded samples. Such a replay is open
loop: after the first command that differs, the samples still come from a vehicle that followed the recorded
commands. `dart-flight replay` and tests use this module.
"""

from __future__ import annotations

import difflib
import math
from collections.abc import Iterator, Sequence
from typing import Any

import msgspec

from dart_flight.base.records import (
    ContactEnd,
    GoalPassed,
    GuardEvent,
    ImpactOnset,
    ImpactPeak,
    LockCommand,
    LockPermission,
    MissionEnd,
    Output,
    PhaseChange,
    PlanRequest,
    PlanTaken,
    PosesWithheld,
    Record,
    Setpoint,
    Silence,
    VehicleCommand,
)
from dart_flight.config.document import InputError
from dart_flight.config.mission import Mission
from dart_flight.config.settings import apply_settings
from dart_flight.core.flight_core import FlightCore
from dart_flight.core.mission.approach import NoApproachError
from dart_flight.recording.about import flown_mission, machine, parse_written, written_mission
from dart_flight.recording.encoding import encode
from dart_flight.recording.flight_time import find_zero
from dart_flight.recording.reader import Log
from dart_flight.recording.schema import INPUTS, OUTPUTS

DECISIONS = (
    VehicleCommand,
    LockCommand,
    LockPermission,
    Silence,
    ImpactOnset,
    ImpactPeak,
    ContactEnd,
    PhaseChange,
    PosesWithheld,
    GuardEvent,
    GoalPassed,
    PlanRequest,
    PlanTaken,
    MissionEnd,
)
TOLERANCE = 1e-9
_IN_FLIGHT = 3  # number of last inputs whose outputs a cut log may lack


class Difference(msgspec.Struct, frozen=True):
    """An output that differs from the recording. If one side lacks the output, that side is None."""

    number: int
    t_us: int
    recorded: Record | None
    replayed: Record | None

    def text(self) -> str:
        kind = type(self.recorded or self.replayed).__name__
        if self.recorded is None:
            return f"{kind} is not in the recording: {_show(self.replayed)}"
        if self.replayed is None:
            return f"{kind} is recorded but not reproduced: {_show(self.recorded)}"
        if type(self.recorded) is not type(self.replayed):
            return f"{_show(self.recorded)} became {_show(self.replayed)}"
        before, after = msgspec.structs.asdict(self.recorded), msgspec.structs.asdict(self.replayed)
        changed = [k for k in before if not _same(before[k], after[k], 0.0)]
        return f"{kind}: " + ", ".join(f"{k} {before[k]!r} became {after[k]!r}" for k in changed)


class Replay(msgspec.Struct):
    """The result of a replay.

    Attributes:
        inputs: number of inputs that the core has processed.
        outputs: number of outputs that were compared.
        exact: whether the comparison was bit for bit. If not, a relative error of 1e-9 was allowed.
        recorded, replayed: decisions in the log and decisions in the replay, both in order of time.
        zero_us: autopilot time that is shown as 0 s (`recording.flight_time`).
        missing: number of inputs that the log lost; the core's state may differ after the first lost input.
        note: remark for the reader, or "".
    """

    inputs: int
    outputs: int
    exact: bool
    differences: list[Difference]
    recorded: list[Record]
    replayed: list[Record]
    missing: int
    note: str
    zero_us: int = 0

    @property
    def equal(self) -> bool:
        return not self.differences


def replay(log: Log, settings: Sequence[str] = (), *, exact: bool | None = None) -> Replay:
    """Replay a log and return the comparison.

    Args:
        settings: `KEY=VALUE`, keys of the vehicle configuration or of the mission (`changed_mission`).
        exact: whether to compare bit for bit; None selects this for a log from this kind of machine.

    Raises:
        InputError: the log does not contain the mission, or a setting is wrong.
    """
    mission = changed_mission(log, settings) if settings else flown_mission(log.about, log.source)
    try:
        core = FlightCore(mission)
    except NoApproachError as error:
        message = f"the mission cannot be flown with these settings: {error}"
        raise InputError(message, source=log.source) from None
    if exact is None:
        exact = log.about.get("machine") == machine()
    inputs = [(e.number, e.record) for e in log.entries if isinstance(e.record, INPUTS)]
    recorded: dict[int, list[Output]] = {}
    for entry in log.entries:
        if isinstance(entry.record, OUTPUTS):
            recorded.setdefault(entry.number, []).append(entry.record)  # type: ignore[arg-type]
    last = inputs[-1][0] if inputs else -1
    compared_to = last if log.complete else last - _IN_FLIGHT
    result = Replay(0, 0, exact, [], [], [], _missing([n for n, _ in inputs]), "")
    result.zero_us = find_zero(item for _, item in inputs)
    t_us = 0
    for number, item in inputs:
        t_us = getattr(item, "t_us", t_us)
        outputs = core.step(item)  # type: ignore[arg-type]
        if number > compared_to:
            break
        result.inputs += 1
        before = recorded.get(number, [])
        result.outputs += len(before)
        result.differences += _compare(number, t_us, before, outputs, 0.0 if exact else TOLERANCE)
        result.recorded += [o for o in before if _decides(o)]
        result.replayed += [o for o in outputs if _decides(o)]
    result.note = _note(log, result)
    return result


def _decides(output: Record) -> bool:
    return isinstance(output, DECISIONS) or (isinstance(output, Setpoint) and output.recovery)


def _missing(numbers: list[int]) -> int:
    """Return how many inputs the log lost, counted from the gaps in the inputs' numbers."""
    return numbers[-1] + 1 - len(numbers) if numbers else 0


def _note(log: Log, result: Replay) -> str:
    if result.missing:
        return f"the log lost {result.missing} inputs; after the first lost input the replay may differ"
    return "" if log.complete else "the log is cut short; the replay ends where the log ends"


def _compare(
    number: int, t_us: int, recorded: list[Output], replayed: list[Output], tolerance: float
) -> Iterator[Difference]:
    for before, after in _pairs(recorded, replayed):
        if not _same_record(before, after, tolerance):
            yield Difference(number, getattr(before or after, "t_us", t_us), before, after)


def _pairs(
    recorded: Sequence[Record], replayed: Sequence[Record]
) -> list[tuple[Record | None, Record | None]]:
    """Return pairs (recorded, replayed) that describe the same decision, with equal or different values.

    A record without a counterpart is paired with None.
    """
    if [type(r) for r in recorded] == [type(r) for r in replayed]:
        return list(zip(recorded, replayed, strict=True))
    pairs: list[tuple[Record | None, Record | None]] = []
    labels = [[_label(r) for r in side] for side in (recorded, replayed)]
    matcher = difflib.SequenceMatcher(a=labels[0], b=labels[1], autojunk=False)
    for kind, a0, a1, b0, b1 in matcher.get_opcodes():
        if kind == "equal":
            pairs += zip(recorded[a0:a1], replayed[b0:b1], strict=True)
        else:
            pairs += [(r, None) for r in recorded[a0:a1]]
            pairs += [(None, r) for r in replayed[b0:b1]]
    return pairs


def _same_record(a: Record | None, b: Record | None, tolerance: float) -> bool:
    if a is None or b is None or type(a) is not type(b):
        return False
    if encode(a) == encode(b):
        return True
    if tolerance == 0.0:
        return False
    return _same(msgspec.structs.astuple(a), msgspec.structs.astuple(b), tolerance)


def _same(a: Any, b: Any, tolerance: float) -> bool:
    if isinstance(a, tuple | list) and isinstance(b, tuple | list):
        return len(a) == len(b) and all(_same(x, y, tolerance) for x, y in zip(a, b, strict=True))
    if isinstance(a, float) and isinstance(b, float):
        if math.isnan(a) or math.isnan(b):
            return math.isnan(a) and math.isnan(b)
        return math.isclose(a, b, rel_tol=tolerance, abs_tol=tolerance)
    if isinstance(a, msgspec.Struct) and type(a) is type(b):  # a nested record
        return _same(msgspec.structs.astuple(a), msgspec.structs.astuple(b), tolerance)
    return bool(a == b)


def _show(record: Record | None) -> str:
    if record is None:
        return "nothing"
    values = {k: v for k, v in msgspec.structs.asdict(record).items() if v is not None}
    return f"{type(record).__name__}({', '.join(f'{k}={v!s}' for k, v in values.items())})"


def decision_rows(result: Replay) -> list[tuple[float, str, str, str]]:
    """Return recorded and replayed decisions in order of time: (s, kind, recorded, replayed).

    A decision that is in the recording and in the replay has one row, even if values or times differ.
    """
    first_us = result.zero_us
    rows: list[tuple[float, str, str, str]] = []
    for one, other in _pairs(result.recorded, result.replayed):
        some = one or other
        time_s = (getattr(some, "t_us", first_us) - first_us) * 1e-6
        rows.append((time_s, type(some).__name__, _brief(one, first_us), _brief(other, first_us)))
    return rows


def _label(record: Record) -> tuple[str, ...]:
    """Return the parts that identify a decision: the record's type, strings and flags, but no numbers."""
    values = msgspec.structs.asdict(record)
    words = (str(v) for k, v in values.items() if isinstance(v, str | bool) and k not in ("detail", "reason"))
    return (type(record).__name__, *words)


def _brief(record: Record | None, first_us: int) -> str:
    if record is None:
        return "-"
    parts = [f"at {(getattr(record, 't_us', 0) - first_us) * 1e-6:.3f} s"]
    for name, value in msgspec.structs.asdict(record).items():
        if name.endswith("_us") or value is None:
            continue
        if isinstance(value, tuple):
            shown = "(" + ", ".join(f"{v:.3f}" for v in value) + ")"
        else:
            shown = f"{value:.3f}" if isinstance(value, float) else str(value)
        parts.append(f"{name} {shown}")
    return ", ".join(parts)


# --- changed settings --------------------------------------------------------------------------------


def changed_mission(log: Log, settings: Sequence[str]) -> Mission:
    """Return the mission of a log with changed settings, validated like a mission file.

    `settings` are `KEY=VALUE` with a dotted key, such as `detection.force_threshold_n=8`,
    `materials.wood.rigid.k=5000` or `collisions[0].alpha_m_per_n=[0.1, 0.02]`. Raise InputError if a key is
    unknown, or a value is of the wrong kind or out of range.
    """
    flown = flown_mission(log.about, log.source)
    mission, vehicle = written_mission(log.about, log.source)
    as_written = parse_written(mission, vehicle)
    of_mission = mission in apply_settings(settings, vehicle, mission)
    try:
        changed = parse_written(mission, vehicle)
    except InputError as error:
        place = ".".join(str(part) for part in error.key)
        said = error.source if error.source.startswith("--set") else "--set"
        where = f"{said}: {place}" if place else said
        raise InputError(f"{where}: {error.message}") from None
    same = {"source": flown.source, "vehicle_source": flown.vehicle_source}
    if msgspec.structs.replace(as_written, **same) == flown:
        return msgspec.structs.replace(changed, **same)
    # The log's text has the mission without the rehearsal: keep the rehearsal, and change only the vehicle.
    if of_mission:
        raise InputError(
            "this flight was a rehearsal, so --set accepts only keys of the configuration",
            source=log.source,
        )
    return msgspec.structs.replace(flown, vehicle=changed.vehicle)
