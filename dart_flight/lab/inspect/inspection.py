"""The inspection of a PX4 log, used by `dart-flight inspect`."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from dart_flight.config.document import InputError
from dart_flight.config.vehicle import VehicleConfig
from dart_flight.lab.inspect.content import TOPICS, describe_cut, flights_of, missing
from dart_flight.lab.inspect.impacts import ImpactScan, InspectedFlight, Listener
from dart_flight.lab.inspect.log_samples import samples_of, vehicle_for
from dart_flight.lab.inspect.specific_thrust import (
    THRUST_KNOWN_HZ,
    are_motors_slow,
    fit_drag,
    fit_specific_thrust,
)
from dart_flight.lab.track import calibration_series_of
from dart_flight.lab.ulog import ULogFile, motor_commands, open_ulog, refuse_other_vehicles


def inspect_file(path: str | Path, vehicle: VehicleConfig, mass_kg: float | None = None) -> InspectedFlight:
    """Detect the impacts in a ULog of PX4 1.9 or later from an armed multicopter.

    Args:
        vehicle: supplies the estimator settings and the thresholds, which hold for this vehicle's mass.
        mass_kg: mass of the vehicle that flew, or None if unknown.
    """
    return inspect_log(open_ulog(path, TOPICS), vehicle, mass_kg)


def inspect_log(
    log: ULogFile,
    vehicle: VehicleConfig,
    mass_kg: float | None = None,
    listen: Callable[[VehicleConfig, list[tuple[float, float]]], Listener] | None = None,
) -> InspectedFlight:
    """Detect the impacts in an open log, for `inspect_file`.

    `listen` is called with the vehicle that the estimator uses and with the flights. `listen` returns the
    function that receives every estimate.
    """
    refuse_other_vehicles(log)
    unknown = missing(log)
    try:
        track = calibration_series_of(log, motor_commands(log))
        fitted = fit_specific_thrust(track, vehicle)
    except InputError as error:
        track, fitted = calibration_series_of(log), error.message
    unknown += [f"thrust: {fitted}; hover is assumed"] if isinstance(fitted, str) else []
    unknown += track.notes[1:]  # the first note concerns the motors
    curve = None if isinstance(fitted, str) else fitted
    if curve is not None and are_motors_slow(track):
        unknown.append(
            f"thrust: motor outputs are logged at less than {THRUST_KNOWN_HZ:.0f} Hz; only hover is evaluated"
        )
    flying = flights_of(log, track)
    unknown += describe_cut(log, track, flying)
    drag = fit_drag(track, flying)
    if not drag:
        unknown.append("drag: the flight is too slow for an estimate")
    unknown.append("wind; bias of the accelerometer outside hover")
    if mass_kg is None:
        unknown.append("mass: forces are in m/s2 only; give --mass for newton")
    flown = vehicle_for(vehicle, log, curve, drag)
    scan = ImpactScan(flown, flying, listen(flown, flying) if listen is not None else None)
    for sample in samples_of(track, curve, len(flown.airframe.motors)):
        scan.process(sample)
    return scan.result(log, track, curve, drag, mass_kg, unknown)
