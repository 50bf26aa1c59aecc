"""Units of numbers, derived from the name of a key, a record's field or a figure."""

from __future__ import annotations

# Units by the ending of a name; if several endings match, the longest counts.
_ENDINGS = {
    "_m_per_n": "m/N",
    "_n_per_rpm2": "N/rpm²",
    "_n_s_m": "N s/m",
    "_ns_per_m": "N s/m",
    "_n_per_m": "N/m",
    "_s_per_m": "s/m",
    "_kg_m2": "kg m²",
    "_m_s2": "m/s²",
    "_n_m": "N/m",
    "_m_s": "m/s",
    "_n_s": "N s",
    "_nm": "N m",
    "_rad_s": "rad/s",
    "_deg_s": "degrees/s",
    "_us_s": "us/s",
    "_per_s": "1/s",
    "_kg": "kg",
    "_mm": "mm",
    "_us": "us",
    "_hz": "Hz",
    "_deg": "degrees",
    "_rad": "rad",
    "_m": "m",
    "_n": "N",
    "_s": "s",
    "_v": "V",
}
# The coefficients are named by the paper's letters, without a unit.
COEFFICIENTS = {"k": "N/m", "f": "N s/m", "mu": "s/m", "nu": "N"}


def split_unit(name: str) -> tuple[str, str]:
    """Return a name without its unit's suffix, and the unit (empty if the name has no suffix)."""
    end = max((end for end in _ENDINGS if name.endswith(end)), key=len, default="")
    return name.removesuffix(end), _ENDINGS.get(end, "")


def unit_from_name(name: str) -> str:
    """Return the unit of a number from the name of its key, or an empty string."""
    return COEFFICIENTS.get(name) or split_unit(name)[1]
