"""Instructions that the flight core, the log and the receiving of telemetry execute, counted by an emulator.

    python -m tools.bench.instructions [--count FILE] [--passes N] [--apart S] [FLIGHT]

Runs as the guest of QEMU's user-mode emulation, whose plugin `instructions.c` keeps in FILE how many
instructions have been executed; docs/results/raspberry_pi.md has the commands. Without FILE the same work
takes processor time, in nanoseconds; `--apart 0.003` sleeps before each item, as the app does between two
messages, so that it meets cold memory.
"""

from __future__ import annotations

import argparse
import gc
import itertools
import mmap
import platform
import queue
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from pathlib import Path
from statistics import fmean, median
from types import SimpleNamespace
from typing import Any, NamedTuple, TypeVar

import msgspec
from mavsdk.plugins.mavlink_direct.mavlink_direct import MavlinkMessage, MavlinkMessageCStruct

from dart_flight.base.motor_outputs import MotorOutputDecoder
from dart_flight.base.records import (
    MOTOR_FULL_US,
    MOTOR_STOP_US,
    ActuatorSample,
    AttitudeSample,
    ContactEnd,
    ImpactOnset,
    ImpactPeak,
    ImuSample,
    Input,
    OdometrySample,
    Output,
    Record,
    StatusSample,
    WallEstimate,
)
from dart_flight.core.flight_core import FlightCore
from dart_flight.recording.about import flown_mission
from dart_flight.recording.encoding import encode
from dart_flight.recording.reader import Log, read_log
from dart_flight.recording.schema import INPUTS
from dart_flight.recording.writer import _FLUSH_S, LogPart
from dart_flight.vehicle import messages
from dart_flight.vehicle.clock import ClockEstimate, host_us
from dart_flight.vehicle.messages import AUTOPILOT, MessageEntry
from dart_flight.vehicle.vehicle_session import VehicleSession

ROOT = Path(__file__).parents[2]
FLIGHT = ROOT / "tests" / "data" / "flights" / "embedded.mcap"
_OUTPUTS = 32  # of ACTUATOR_OUTPUT_STATUS
_SYSTEM = 1  # its id

T = TypeVar("T")
Read = Callable[[], int]


class Row(NamedTuple):
    """What one kind of work costs, in instructions or nanoseconds.

    Attributes:
        name: of the work.
        number: of items.
        mean, median, largest: of an item.
    """

    name: str
    number: int
    mean: float
    median: float
    largest: float


class _Logged(NamedTuple):
    record: Record
    time_us: int
    number: int


def counter(path: Path) -> Read:
    """The count that the plugin keeps in this file of eight bytes."""
    with open(path, "r+b") as file:
        return partial(memoryview(mmap.mmap(file.fileno(), 8)).cast("Q").__getitem__, 0)


def costs(
    read: Read, passes: int, begin: Callable[[], Callable[[T], object]], items: Sequence[T]
) -> list[float]:
    """What each item takes: the least of its passes, less what reading takes.

    Args:
        read: the count, or the clock.
        passes: how many; one more goes before, in which the interpreter specialises what it runs.
        begin: called before every pass, returns what takes an item.
        items: given to it in this order.
    """
    nothing = median(_pass(read, lambda _: None, items))
    rows = [_pass(read, begin(), items) for _ in range(passes + 1)]
    return [min(column) - nothing for column in zip(*rows[1:], strict=True)]


def _pass(read: Read, take: Callable[[T], object], items: Sequence[T]) -> list[int]:
    row = []
    for item in items:
        start = read()
        take(item)
        row.append(read() - start)
    return row


def apart(read: Read, pause_s: float) -> Read:
    """A clock that sleeps first, every other time: when an item begins."""
    begins = itertools.cycle((True, False))

    def sleep_and_read() -> int:
        if next(begins):
            time.sleep(pause_s)
        return read()

    return sleep_and_read


def measure(read: Read, log: Log, passes: int) -> Iterator[Row]:
    """The rows of one flight: the core by kind of input, the log's records, what is received."""
    mission = flown_mission(log.about, log.source)
    inputs: list[Any] = [entry.record for entry in log.entries if isinstance(entry.record, INPUTS)]
    core = FlightCore(mission)
    outputs = [core.step(item) for item in inputs]
    yield from _core_rows(inputs, outputs, costs(read, passes, lambda: FlightCore(mission).step, inputs))

    logged = list(_logged(inputs, outputs))
    yield _row(
        "log, encode a record", costs(read, passes, lambda: encode, [entry.record for entry in logged])
    )
    with tempfile.TemporaryDirectory() as folder:
        files = (Path(folder) / f"{i}.mcap" for i in range(passes + 1))
        writing = costs(read, passes, lambda: _writing(next(files), log.about), logged)
    yield _row("log, a record into the file", writing)

    motors = len(mission.vehicle.airframe.motors)
    for kind, handed_over in HANDED_OVER.items():
        messages = [handed_over(item) for item in inputs if isinstance(item, kind)]
        yield _row(
            f"receive, {kind.__name__}",
            costs(read, passes, partial(receiving, kind, motors, queue.SimpleQueue[Input]().put), messages),
        )


def _core_rows(inputs: list[Input], outputs: list[list[Output]], steps: list[float]) -> Iterator[Row]:
    yield _row("core, one input", steps)
    for kind in dict.fromkeys(map(type, inputs)):
        yield _row(
            f"core, {kind.__name__}",
            [cost for cost, item in zip(steps, inputs, strict=True) if type(item) is kind],
        )
    # What follows from a contact, apart: the steps that fit are the longest.
    given = [{type(output) for output in of_one} for of_one in outputs]
    for made in (ImpactOnset, ImpactPeak, ContactEnd, WallEstimate):
        if found := [cost for cost, kinds in zip(steps, given, strict=True) if made in kinds]:
            yield _row(f"core, gives {made.__name__}", found)
    ends, felt = (
        [i for i, kinds in enumerate(given) if made in kinds] for made in (ContactEnd, WallEstimate)
    )
    if sums := [sum(steps[i : j + 1]) for i, j in zip(ends, felt, strict=False)]:
        yield _row("core, ContactEnd to WallEstimate", sums)


def _row(name: str, of_items: list[float]) -> Row:
    return Row(name, len(of_items), fmean(of_items), median(of_items), max(of_items))


def _logged(inputs: list[Input], outputs: list[list[Output]]) -> Iterator[_Logged]:
    """Inputs and what follows from them, as a flight's log has them; a kept flight lacks the estimates."""
    time_us = 0
    for number, (item, follows) in enumerate(zip(inputs, outputs, strict=True)):
        for record in (item, *follows):
            time_us = getattr(record, "t_us", 0) or time_us
            yield _Logged(record, time_us, number)


def _writing(path: Path, about: dict[str, str]) -> Callable[[_Logged], None]:
    part, flushed_us = LogPart(path, about, 1), 0

    def write(logged: _Logged) -> None:
        nonlocal flushed_us
        part.write(*logged)
        if logged.time_us - flushed_us >= 1e6 * _FLUSH_S:
            flushed_us = logged.time_us
            part.flush()

    return write


def _imu(sample: ImuSample) -> MavlinkMessageCStruct:
    (ax, ay, az), (wx, wy, wz) = sample.specific_force_frd, sample.rate_frd
    return _as_text(
        message_id=105,
        message_name="HIGHRES_IMU",
        abs_pressure=1013.25,
        diff_pressure=0.0,
        fields_updated=0x1FFF,
        id=0,
        pressure_alt=0.0,
        temperature=25.0,
        time_usec=host_us(),  # the recorded time would leap, as the samples come at once
        xacc=ax,
        xgyro=wx,
        xmag=0.2,
        yacc=ay,
        ygyro=wy,
        ymag=0.0,
        zacc=az,
        zgyro=wz,
        zmag=0.45,
    )


def _attitude(sample: AttitudeSample) -> MavlinkMessageCStruct:
    w, x, y, z = sample.q_frd_to_ned
    return _as_text(
        message_id=31,
        message_name="ATTITUDE_QUATERNION",
        pitchspeed=x,  # as long as a rate would be
        q1=w,
        q2=x,
        q3=y,
        q4=z,
        repr_offset_q=[0.0] * 4,
        rollspeed=y,
        time_boot_ms=sample.t_us // 1000,
        yawspeed=z,
    )


def _odometry(sample: OdometrySample) -> MavlinkMessageCStruct:
    x, y, z = sample.position_ned
    vx, vy, vz = sample.velocity_ned
    covariance = [None] + [0.0] * 20
    return _as_text(
        message_id=331,
        message_name="ODOMETRY",
        child_frame_id=1,
        estimator_type=8,
        frame_id=1,
        pitchspeed=vx,  # as long as a rate would be
        pose_covariance=covariance,
        q=[x, y, z, vx],
        quality=0,
        reset_counter=0,
        rollspeed=vy,
        time_usec=sample.t_us,
        velocity_covariance=covariance,
        vx=vx,
        vy=vy,
        vz=vz,
        x=x,
        y=y,
        yawspeed=vz,
        z=z,
    )


def _motor_outputs(sample: ActuatorSample) -> MavlinkMessageCStruct:
    pwm = [MOTOR_STOP_US + value * (MOTOR_FULL_US - MOTOR_STOP_US) for value in sample.motors]
    return _as_text(
        message_id=375,
        message_name="ACTUATOR_OUTPUT_STATUS",
        active=len(pwm),
        actuator=pwm + [0.0] * (_OUTPUTS - len(pwm)),
        time_usec=sample.t_us,
    )


def _as_text(**fields: Any) -> MavlinkMessageCStruct:
    return MavlinkMessageCStruct(
        message_name=fields["message_name"].encode(),
        system_id=_SYSTEM,
        component_id=AUTOPILOT,
        fields_json=msgspec.json.encode(fields),
    )


# A sample as MAVSDK's library hands the message over that it came from, with fields and order as seen there.
HANDED_OVER: dict[type[Any], Callable[[Any], Any]] = {
    ImuSample: _imu,
    AttitudeSample: _attitude,
    OdometrySample: _odometry,
    ActuatorSample: _motor_outputs,
}


def receiving(kind: type[Any], motors: int, deliver: Callable[[Input], None]) -> Callable[[Any], None]:
    """What takes such a message until it is delivered: MAVSDK's Python half and the session's callback."""
    callbacks: list[Callable[[Any, Any], None]] = []
    link = SimpleNamespace(subscribe_message=lambda _, take: callbacks.append(take))
    session = object.__new__(VehicleSession)  # its constructor wants a connection, the callbacks none
    session._deliver, session._direct, session.senders = deliver, link, {}
    session._raw = SimpleNamespace(get_system_id=lambda: _SYSTEM)
    session.motor_outputs, session._reset_counter, session._has_position = MotorOutputDecoder(motors), 0, True
    session._status, session.clock = StatusSample(0, 0), ClockEstimate()
    session._host_us = session.clock.host_us
    takers: dict[type[Any], tuple[MessageEntry, Callable[[Any, int], Any]]] = {
        ImuSample: (messages.HIGHRES_IMU, session._on_imu),
        AttitudeSample: (messages.ATTITUDE_QUATERNION, session._on_attitude),
        OdometrySample: (messages.ODOMETRY, session._on_odometry),
        ActuatorSample: (messages.ACTUATOR_OUTPUT_STATUS, session._on_actuator),
    }
    session.listen(*takers[kind])
    return lambda struct: callbacks[0](MavlinkMessage.from_c_struct(struct), None)


def main() -> None:
    """Print a table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("flight", nargs="?", type=Path, default=FLIGHT)
    parser.add_argument("--count", type=Path, help="file in which the emulator's plugin counts")
    parser.add_argument("--passes", type=int, default=2)
    parser.add_argument(
        "--apart", type=float, default=0.0, metavar="S", help="seconds of sleep before an item"
    )
    given = parser.parse_args()
    read, unit = (counter(given.count), "instructions") if given.count else (time.thread_time_ns, "ns")
    if given.apart:
        read = apart(read, given.apart)
    built = "interpreted" if str(sys.modules[FlightCore.__module__].__file__).endswith(".py") else "compiled"
    print(f"{platform.machine()}, Python {platform.python_version()}, {built}")
    print(f"{unit:28} {'items':>6} {'mean':>10} {'median':>10} {'largest':>10}")
    log = read_log(given.flight)
    gc.freeze()  # as the app does
    for row in measure(read, log, given.passes):
        print(
            f"{row.name:28} {row.number:6} {row.mean:10.0f} {row.median:10.0f} {row.largest:10.0f}",
            flush=True,
        )


if __name__ == "__main__":
    main()
