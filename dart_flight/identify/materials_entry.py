"""A materials entry for the vehicle configuration, from identified coefficients."""

from __future__ import annotations

from dart_flight.config.document import InputError
from dart_flight.config.vehicle import Coefficients, VehicleConfig
from dart_flight.identify.estimates import Estimate, Identification
from dart_flight.samples import Mode


def materials_entry(found: Identification, surface: str, vehicle: VehicleConfig) -> str:
    """YAML to put under `materials` of a configuration; accepted there as it is.

    What was not identified (the other mode, a coefficient the trials do not show) is taken from the
    configuration's entry of the same name, and marked as such.

    Raises:
        InputError: the trials carry no mode, or something is missing and the configuration has no such entry.
    """
    known = vehicle.materials.get(surface)
    modes = [mode for mode in Mode if mode.value in found.coefficients]
    if not modes:
        raise InputError("to write an entry the trials need --mode rigid or --mode flexible", key=("output",))
    lines = ["materials:", f"  {surface}:"]
    names = " and ".join(mode.value for mode in modes)
    count = len(found.trials)
    lines.append(f'    source: "identified: {names}, {count} trial{"s" if count > 1 else ""}"')
    for mode in Mode:
        fallback = known.of(mode) if known else None
        estimates = found.coefficients.get(mode.value, {})
        values, marks = [], []
        for name in ("k", "f", "mu", "nu"):
            estimate = estimates.get(name)
            values.append(f"{name}: {_value(name, estimate, fallback, (surface, mode.value))}")
            marks.append(
                f"{name} from the configuration"
                if estimate is None
                else f"{name} {estimate.low:.4g} to {estimate.high:.4g}"
            )
        lines.append(f"    {mode.value}: {{{', '.join(values)}}}  # 95 %: {'; '.join(marks)}")
    return "\n".join(lines) + "\n"


def _value(
    name: str, estimate: Estimate | None, fallback: Coefficients | None, where: tuple[str, str]
) -> str:
    if estimate is not None:
        return repr(float(f"{max(estimate.value, 0.0):.6g}"))
    if fallback is None:
        surface, mode = where
        raise InputError(
            f"{name} of {mode} was not identified and the configuration has no material {surface!r} to take "
            "it from",
            key=("output",),
        )
    return repr(getattr(fallback, name))
