"""A materials entry for the vehicle configuration, made from identified coefficients."""

from __future__ import annotations

from typing import NamedTuple

from dart_flight.config.document import InputError
from dart_flight.config.vehicle import Coefficients, VehicleConfig
from dart_flight.lab.identify.estimates import Estimate, Identification

# Values of undetermined coefficients: 0, which disables their effect. The entry marks them as assumed.
# Stiffness has no such value.
_ASSUMED = {"f": 0.0, "mu": 0.0, "nu": 0.0}


class MaterialsEntry(NamedTuple):
    """YAML for the section `materials` of a configuration.

    Attributes:
        text: the YAML; a valid entry if no mode is missing.
        assumed: coefficients that neither the trials nor the configuration determine, such as `nu of rigid`.
        missing: modes left out because their stiffness is unknown.
    """

    text: str
    assumed: list[str]
    missing: list[str]


def materials_entry(
    found: Identification, surface: str, vehicle: VehicleConfig, *, poor: bool = False
) -> MaterialsEntry:
    """Return the YAML of a material; the YAML marks unidentified values.

    A value is unidentified if its mode has no trials, or if the trials do not determine the coefficient.
    Unidentified values come from the configuration's entry of the same name. Without that entry, friction,
    damping and the vertical force are written as 0 and marked as assumed. If the stiffness of a mode is
    unknown, a comment replaces the mode. The entry states whether the fit is `poor`.
    """
    known = vehicle.materials.get(surface)
    modes = [mode for mode in vehicle.modes if mode.value in found.coefficients]
    if not modes:
        wanted = " or ".join(f"--mode {mode.value}" for mode in vehicle.modes)
        raise InputError(f"an entry needs the mode of the trials: give the option {wanted}", key=("output",))
    lines, assumed, missing = [], [], []
    for mode in vehicle.modes:
        fallback = known.coefficients(mode) if known else None
        estimates = found.coefficients.get(mode.value, {})
        if estimates.get("k") is None and fallback is None:
            missing.append(mode.value)
            lines.append(
                f"    # {mode.value}: unknown from these trials, but required; identify trials with "
                f"--mode {mode.value} and add the result here"
            )
            continue
        values, marks = [], []
        for name in ("k", "f", "mu", "nu"):
            value, mark = _value(name, estimates.get(name), fallback)
            values.append(f"{name}: {value}")
            marks.append(mark)
            if mark.endswith("assumed"):
                assumed.append(f"{name} of {mode.value}")
        lines.append(f"    {mode.value}: {{{', '.join(values)}}}  # 95 %: {'; '.join(marks)}")
    names = " and ".join(mode.value for mode in modes)
    count = len(found.trials)
    source = f"identified: {names}, {count} trial{'s' if count > 1 else ''}"
    source += f"; assumed: {', '.join(assumed)}" if assumed else ""
    source += "; POOR FIT" if poor else ""
    head = ["materials:", f"  {surface}:", f'    source: "{source}"']
    return MaterialsEntry("\n".join([*head, *lines]) + "\n", assumed, missing)


def _value(name: str, estimate: Estimate | None, fallback: Coefficients | None) -> tuple[str, str]:
    """Return a coefficient as YAML, with its source."""
    if estimate is not None:
        return (
            repr(float(f"{max(estimate.value, 0.0):.6g}")),
            f"{name} {estimate.low:.4g} to {estimate.high:.4g}",
        )
    if fallback is not None:
        return repr(getattr(fallback, name)), f"{name} from the configuration"
    return repr(_ASSUMED[name]), f"{name} not determined by the trials, assumed"
