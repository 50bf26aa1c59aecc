"""Checks of the onboard computer: wake-up delay, speed of the core, temperature, power supply and clock."""

from __future__ import annotations

import time
from collections.abc import Sequence

from dart_flight.base.geometry import GRAVITY_M_S2
from dart_flight.base.processes import LATE_S, measure_lateness_s
from dart_flight.base.records import (
    ActuatorSample,
    AttitudeSample,
    ComputerSample,
    ImuSample,
    Input,
    OdometrySample,
    StatusSample,
)
from dart_flight.check.findings import CheckFinding
from dart_flight.config.document import InputError
from dart_flight.config.mission import Mission
from dart_flight.run.computer import read_computer
from dart_flight.run.prepare import flight_core_of

_SAMPLES, _WARM = 550, 50
_HOT_C, _TOO_HOT_C = 70.0, 80.0  # a Raspberry Pi 4 throttles its clock from 80 °C
# Time of the step that finds a contact's peak, divided by a mean step's time (docs/results/raspberry_pi.md).
_PEAK_FACTOR = 12.0
_FLIGHT_FACTOR = 2.5  # time of a step in flight (0.07 to 0.08 ms) divided by the time at rest (0.03 ms)
_LEAST_MARGIN = 4.0  # minimum margin; below it, core, log and link together need more than one processor


def check_lateness(mission: Mission) -> CheckFinding:
    """Measure for half a second how late this program wakes up; `guard.stream_timeout_s` is the limit."""
    late_s = measure_lateness_s()
    message = f"this program lags by up to {late_s * 1e3:.0f} ms"
    if late_s <= LATE_S:
        return CheckFinding("lateness", True, message)
    message += ": the computer is too slow for a real-time flight (use `dry-run --fast` or --speed 0.5)"
    go = late_s <= mission.vehicle.guard.stream_timeout_s
    return CheckFinding("lateness", go, message, remark=go)


def check_core_speed(mission: Mission, found: Sequence[CheckFinding] = ()) -> CheckFinding:
    """Measure the core's processor time per IMU sample and compare it with the sample interval.

    If the core refuses the mission, the finding is a no-go with the core's reason. If a finding in `found`
    already gives this reason, the no-go refers to that finding.
    """
    interval_s = 1.0 / mission.vehicle.imu.rate_hz
    try:
        step_s = measure_step_s(mission)
    except InputError as error:
        item = next((f.item for f in found if not f.go and error.message in f.message), None)
        why = f": {error.message}" if item is None else f" because of {item}"
        return CheckFinding("core_speed", False, f"not measured{why}")
    return evaluate_core_speed(step_s, interval_s)


def evaluate_core_speed(step_s: float, interval_s: float) -> CheckFinding:
    """Check that the core keeps up with the samples and finds a contact's peak before the next sample.

    Args:
        step_s: mean processor time of one sample in free flight, seconds.
        interval_s: time between two samples, seconds.
    """
    margin = interval_s / step_s
    message = (
        f"the flight core needs {step_s * 1e3:.2f} ms per sample, the samples are {interval_s * 1e3:.1f} ms "
        f"apart, margin {margin:.0f}"
    )
    figures = {"core_step_ms": step_s * 1e3, "margin": margin}
    if margin >= _PEAK_FACTOR:
        return CheckFinding("core_speed", True, message, figures=figures)
    go = margin >= _LEAST_MARGIN
    if go:
        message += (
            f": a recovery begins {_PEAK_FACTOR * step_s * 1e3:.0f} ms after the sample with the peak force"
        )
    else:
        message += f", minimum {_LEAST_MARGIN:g}: this computer is too slow"
    return CheckFinding("core_speed", go, message, remark=go, figures=figures)


def measure_step_s(mission: Mission) -> float:
    """Return the processor time that the core needs per IMU period in flight, seconds.

    In one period the core processes an IMU sample and the other inputs that arrive with this sample. Two
    seconds of inputs from a vehicle at rest are timed. The result is multiplied by a fixed factor, because a
    period in flight costs more.
    """
    core = flight_core_of(mission)
    period_us, motors = round(1e6 / mission.vehicle.imu.rate_hz), len(mission.vehicle.airframe.motors)
    begun_s = 0.0
    for k in range(_SAMPLES):
        if k == _WARM:
            begun_s = time.thread_time()
        for item in _inputs_at(k, period_us, motors):
            core.step(item)
    return _FLIGHT_FACTOR * (time.thread_time() - begun_s) / (_SAMPLES - _WARM)


def _inputs_at(k: int, period_us: int, motors: int) -> list[Input]:
    t_us = 1_000_000 + k * period_us
    inputs: list[Input] = [StatusSample(t_us, t_us, local_position_ok=True)] if k % 60 == 0 else []
    inputs.append(ImuSample(t_us, t_us, (0.0, 0.0, -GRAVITY_M_S2), (0.0, 0.0, 0.0)))
    if k % 2 == 0:
        inputs.append(AttitudeSample(t_us, t_us, (1.0, 0.0, 0.0, 0.0)))
        inputs.append(OdometrySample(t_us, t_us, (0.0, 0.0, 0.0), (0.0, 0.0, 0.0)))
        inputs.append(ActuatorSample(t_us, t_us, (0.5,) * motors))
    return inputs


def check_computer(sample: ComputerSample | None = None) -> list[CheckFinding]:
    """Check temperature, power supply and clock, as far as the kernel reports them."""
    now = read_computer() if sample is None else sample
    findings = []
    if now.temperature_c is not None:
        hot = now.temperature_c >= _HOT_C
        message = f"{now.temperature_c:.0f} °C" + (
            ": cool the computer, because it throttles its clock above 80 °C" if hot else ""
        )
        findings.append(CheckFinding("temperature", now.temperature_c < _TOO_HOT_C, message, remark=hot))
    if now.undervoltage is not None:
        message = "power supply: no undervoltage"
        if now.undervoltage:
            message = "power supply: undervoltage now; the computer may restart when the servo moves"
        elif now.was_undervoltage:
            message = "power supply: undervoltage since the computer started; give the servo its own supply"
        findings.append(
            CheckFinding("supply", not now.undervoltage, message, remark=bool(now.was_undervoltage))
        )
    if now.throttled is not None:
        message = "processor clock: not throttled"
        if now.throttled:
            message = (
                "processor clock: heat or undervoltage throttles it now; the program would be late in flight"
            )
        elif now.was_throttled:
            message = "processor clock: heat or undervoltage has throttled it since the computer started"
        findings.append(
            CheckFinding("throttling", not now.throttled, message, remark=bool(now.was_throttled))
        )
    return findings
