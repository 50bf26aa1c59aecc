"""Force estimate and detection on real PX4 logs (docs/results/real_data.md).

    python -m tools.campaigns.real LOG_OR_FOLDER... [--json FILE]

ULogs go through `dart_flight.lab.inspect`. What comes out: thrust fitted or refused by name, impacts
in flight, and, with half-sines of 30 to 180 ms added to the estimated force, how many of them are found, by
their height over the floor that the software states. Detection is done again for a series of thresholds,
without and with the learnt noise, on the same estimates.
"""

from __future__ import annotations

import argparse
import json
import math
import random
import sys
from collections import deque
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from dart_flight.base.geometry import MissionFrame, Vec2
from dart_flight.base.records import ImpactOnset, ImpactPeak
from dart_flight.config.document import InputError
from dart_flight.config.vehicle import Detection, VehicleConfig, load_vehicle
from dart_flight.core.sense.detector import ExpectedContact, ImpactDetector
from dart_flight.core.sense.state import FlightState
from dart_flight.lab.inspect.content import TOPICS
from dart_flight.lab.inspect.impacts import (
    REMEMBERED,
    Estimated,
    InspectedFlight,
    ThresholdCrossing,
    short_samples,
)
from dart_flight.lab.inspect.inspection import inspect_log
from dart_flight.lab.ulog import ULogFile, open_ulog

_EVERY_S = 1.6  # a pulse, in flight
_AFTER_S = 3.0  # from the beginning of a flight
_BEFORE_END_S = 4.0  # the ground may be touched from here on
_DURATIONS_S = (0.03, 0.18)
_LOW_M = 0.5  # above where the log begins
_EVENT_S = 3.0  # hits closer to one another are one event
_LATE_S = 0.06  # an onset this long after a pulse still is its own
# Before: fixed thresholds, newton for the configured vehicle's mass. After: deviations of the learnt noise.
FIXED_N = (5.5, 11.0, 22.0)
SIGMAS = (4.0, 5.0, 6.0)


class Pulse(msgspec.Struct):
    """An injected half-sine and what became of it."""

    start_s: float
    duration_s: float
    heading_rad: float
    over_floor: float  # times the floor stated at its beginning
    peak_n: float = 0.0
    floor_n: float = 0.0
    found_s: float | None = None  # from its beginning to its onset's detection


class Detected(msgspec.Struct):
    """A detector's run over one flight.

    Attributes:
        onsets: of impacts that belong to no pulse, seconds.
        weak: crossings of the threshold that belong to no pulse and are no impacts (`Crossing.is_impact`).
        pulses: with what became of them.
    """

    onsets: list[float]
    weak: int
    pulses: list[Pulse]


def pushed(estimated: Estimated, push: Vec2) -> Estimated:
    """An estimate as it would be with one more horizontal force, newton, mission frame."""
    x, y, z = estimated.force.force_mission
    force = msgspec.structs.replace(estimated.force, force_mission=(x + push[0], y + push[1], z))
    along = estimated.along_n + push[0] * estimated.up[0] + push[1] * estimated.up[1]
    return estimated._replace(force=force, along_n=along)


class FixedThreshold(ImpactDetector):
    """A detector whose threshold noise does not lift."""

    def thresholds_n(self) -> tuple[float, float, float, float]:
        """The configured one, whatever the mean."""
        return (self._threshold_n,) * 4

    def _noise_hides_release(self, release: float) -> bool:
        return False


def detect(
    vehicle: VehicleConfig,
    estimates: Sequence[Estimated],
    detection: Detection,
    pulses: Sequence[Pulse] = (),
    fixed_n: float | None = None,
    kind: type[ImpactDetector] = ImpactDetector,
) -> Detected:
    """Run a detector over estimates.

    Args:
        vehicle: as the estimates were made with.
        estimates: of one log, in order.
        detection: the operating point.
        pulses: to add, in order; their height is set when they begin.
        fixed_n: peak of every pulse; otherwise a multiple of the floor stated then.
    """
    detector = kind(msgspec.structs.replace(vehicle, detection=detection))
    state = FlightState()
    state.anchor(MissionFrame())
    ahead = [msgspec.structs.replace(p) for p in pulses]
    felt: list[tuple[float, ThresholdCrossing, Pulse | None]] = []
    done: list[Pulse] = []
    now: Pulse | None = None
    newest: deque[Estimated] = deque(maxlen=REMEMBERED)
    for estimated in estimates:
        estimate = estimated.force
        t = estimate.t_us * 1e-6
        if now is None and ahead and t >= ahead[0].start_s:
            now = ahead.pop(0)
            now.floor_n = detector.floor_n(now.duration_s)
            now.peak_n = fixed_n if fixed_n is not None else now.over_floor * now.floor_n
        if now is not None:
            into = t - now.start_s
            if into <= now.duration_s:
                push = now.peak_n * math.sin(math.pi * max(0.0, into) / now.duration_s)
                estimated = pushed(
                    estimated, (push * math.cos(now.heading_rad), push * math.sin(now.heading_rad))
                )
                estimate = estimated.force
            elif into > now.duration_s + _LATE_S:
                done.append(now)
                now = None
        newest.append(estimated)
        for event in detector.update(estimate, estimate.t_us, state, ExpectedContact(estimated.flying)):
            if isinstance(event, ImpactOnset):
                felt.append((t, ThresholdCrossing(event, detector.crossed_n), now))
            elif isinstance(event, ImpactPeak):
                felt[-1][1].ends(event, newest, short_samples(vehicle))
    others = [(t, crossing) for t, crossing, pulse in felt if pulse is None]
    for t, crossing, pulse in felt:
        if pulse is not None and pulse.found_s is None and crossing.is_impact:
            pulse.found_s = t - pulse.start_s
    return Detected(
        [t for t, crossing in others if crossing.is_impact],
        sum(not crossing.is_impact for _, crossing in others),
        done,
    )


def pulses_for(flying: list[tuple[float, float]], busy: list[float], rng: random.Random) -> list[Pulse]:
    """Pulses all over the flights, away from take-off, landing and what is felt there anyway."""
    out = []
    for begin, end in flying:
        at = begin + _AFTER_S
        while at < end - _BEFORE_END_S:
            at += _EVERY_S * rng.uniform(0.8, 1.2)
            pulse = Pulse(
                at,
                rng.uniform(*_DURATIONS_S),
                rng.uniform(-math.pi, math.pi),
                rng.choice((1.0, 1.25, 1.5, 2.0)),
            )
            if at < end - _BEFORE_END_S and all(abs(at - t) > 1.0 for t in busy):
                out.append(pulse)
    return out


def open_log(path: Path) -> ULogFile:
    """A ULog with the topics that `feel` reads."""
    return open_ulog(path, TOPICS)


def judge(
    path: Path,
    vehicle: VehicleConfig,
    rng: random.Random,
    read: Callable[[Path], ULogFile] = open_log,
    only_shipped: bool = False,
) -> dict[str, Any]:
    """Everything about one log; of the thresholds all, or only the shipped one."""
    try:
        log = read(path)
        flight, estimates, flying, made = inspect_log_keeping(log, vehicle)
    except InputError as error:
        return {"log": path.name, "refused": error.message}
    begin_s = flight.begin_s
    busy = [begin_s + i.t_s for i in flight.impacts]
    pulses = pulses_for(flying, busy, rng)
    row: dict[str, Any] = {
        "log": path.name,
        "version": flight.px4_version,
        "flight_s": flight.flight_s,
        "flights": [[a - begin_s, b - begin_s] for a, b in flying],
        "noise_m_s2": flight.noise_m_s2,
        "noise_short_m_s2": flight.noise_short_m_s2,
        "noise_long_m_s2": flight.noise_long_m_s2,
        "threshold_m_s2": flight.threshold_m_s2,
        "floors_m_s2": [flight.floor_rigid_m_s2, flight.floor_flexible_m_s2],
        "fastest_m_s": fastest(log),
        "thrust": None if flight.thrust is None else msgspec.to_builtins(flight.thrust),
        "impacts": [msgspec.to_builtins(i) for i in flight.impacts if i.kind != "untold"],
        "untold": flight.untold,
        "unknown": flight.unknown,
    }
    d = made.detection
    if not estimates or flight.flight_s <= 0.0:
        return row
    runs = {}
    for name, detection, kind in (
        *(
            (f"fixed {n:g} N", msgspec.structs.replace(d, force_threshold_n=n), FixedThreshold)
            for n in FIXED_N
        ),
        *((f"learnt {s:g}", msgspec.structs.replace(d, noise_sigma=s), ImpactDetector) for s in SIGMAS),
    ):
        if only_shipped and (detection != d or kind is FixedThreshold):
            continue
        clean = detect(made, estimates, detection, kind=kind)
        at_16 = detect(made, estimates, detection, pulses, fixed_n=15.4, kind=kind)
        runs[name] = {
            "onsets": [t - begin_s for t in clean.onsets],
            "weak": clean.weak,
            "found_of_15.4_n": [sum(p.found_s is not None for p in at_16.pulses), len(at_16.pulses)],
        }
        if detection == d:
            over = detect(made, estimates, detection, pulses)
            row["pulses"] = [msgspec.to_builtins(p) for p in over.pulses]
    row["runs"] = runs
    return row


def inspect_log_keeping(
    log: ULogFile, vehicle: VehicleConfig
) -> tuple[InspectedFlight, list[Estimated], list[tuple[float, float]], VehicleConfig]:
    """`inspect_log`, with its estimates, the flights, and the vehicle it made them with."""
    kept: list[Estimated] = []
    made: list[tuple[VehicleConfig, list[tuple[float, float]]]] = []

    def listen(of: VehicleConfig, flying: list[tuple[float, float]]) -> Any:
        made.append((of, flying))
        return kept.append

    flight = inspect_log(log, vehicle, listen=listen)
    return flight, kept, made[0][1], made[0][0]


def fastest(log: ULogFile) -> float:
    """Largest horizontal speed, m/s."""
    position = log.first("vehicle_local_position")
    if position is None:
        return math.nan
    speeds = np.hypot(position["vx"], position["vy"])
    return float(np.nanmax(speeds, initial=0.0))


def main(arguments: Sequence[str] | None = None) -> int:
    """Judge all logs; prints a summary, writes all of it as JSON."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("logs", nargs="+", type=Path, help="ULogs, or folders of them")
    parser.add_argument("--json", type=Path, default=Path("build/real.json"))
    parser.add_argument("--seed", type=int, default=1)
    options = parser.parse_args(arguments)
    vehicle = load_vehicle()
    paths = sorted(p for at in options.logs for p in ([at] if at.is_file() else at.rglob("*.ulg")))
    rows = []
    for path in paths:
        rows.append(judge(path, vehicle, random.Random(f"{options.seed} {path.name}")))
        sys.stderr.write(".")
        sys.stderr.flush()
    options.json.parent.mkdir(parents=True, exist_ok=True)
    options.json.write_text(json.dumps(rows, indent=1))
    sys.stdout.write(summary(rows))
    return 0


def is_low(impact: dict[str, Any]) -> bool:
    """Whether an impact was so low that it may be the ground."""
    return impact["height_m"] is not None and impact["height_m"] < _LOW_M


def events_of(times: Sequence[float]) -> int:
    """How many there are if what follows within a few seconds is taken for the same event."""
    times = sorted(times)
    return sum(i == 0 or t - times[i - 1] > _EVENT_S for i, t in enumerate(times))


def summary(rows: list[dict[str, Any]]) -> str:
    """The figures over all logs, as text."""
    flown = [r for r in rows if r.get("flight_s", 0.0) > 0.0]
    hours = sum(r["flight_s"] for r in flown) / 3600.0
    lines = [f"{len(rows)} logs, {len(flown)} with flight, {60.0 * hours:.1f} min of flight"]
    fitted = [r["thrust"]["held_out_percent"] for r in flown if r["thrust"]]
    if fitted:
        within = sum(f <= 10.0 for f in fitted)
        lines.append(
            f"thrust fitted in {len(fitted)}, held-out residual at most 10 % in {within}, "
            f"median {sorted(fitted)[len(fitted) // 2]:.1f} %, worst {max(fitted):.1f} %"
        )
    impacts = [i for r in flown for i in r["impacts"]]
    felt = sum(any(i["kind"] == "touch-down" for i in r["impacts"]) for r in flown)
    low = sum(i["kind"] == "impact" and is_low(i) for i in impacts)
    high = sum(i["kind"] == "impact" and not is_low(i) for i in impacts)
    lines.append(f"touch-downs felt in {felt} logs, other impacts: {low} near the ground, {high} above")
    pulses = [p for r in flown for p in r.get("pulses", [])]
    for over in sorted({p["over_floor"] for p in pulses}):
        of = [p for p in pulses if p["over_floor"] == over]
        lines.append(
            f"pulses {over:g} times the floor: {sum(p['found_s'] is not None for p in of)} of {len(of)}"
        )
    for name in next((r["runs"] for r in flown if "runs" in r), {}):
        # What happens close to the ground or is a touch-down is none of the false ones.
        downs = [[i["t_s"] for i in r["impacts"] if i["kind"] != "impact" or is_low(i)] for r in flown]
        false = [
            [t for t in r["runs"][name]["onsets"] if all(abs(t - d) > 1.0 for d in down)]
            for r, down in zip(flown, downs, strict=True)
        ]
        hits, events = sum(map(len, false)), sum(map(events_of, false))
        found = [sum(r["runs"][name]["found_of_15.4_n"][k] for r in flown) for k in (0, 1)]
        weak = sum(r["runs"][name]["weak"] for r in flown)
        lines.append(
            f"{name}: {hits} in flight, {events} events ({events / max(hours, 1e-9):.1f}/h), {weak} weak "
            f"crossings, 15.4 N found {found[0]} of {found[1]}"
        )
    return "\n".join(lines) + "\n"


if __name__ == "__main__":
    sys.exit(main())
