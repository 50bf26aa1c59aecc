"""The unit that a key's name says."""

from __future__ import annotations

# Endings of names; the longest that fits counts.
_ENDINGS = {
    "_m_per_n": "m/N",
    "_n_per_rpm2": "N/rpm²",
    "_n_s_m": "N s/m",
    "_kg_m2": "kg m²",
    "_m_s2": "m/s²",
    "_n_m": "N/m",
    "_m_s": "m/s",
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
# Coefficients go by the paper's letters.
_LETTERS = {"k": "N/m", "f": "N s/m", "mu": "s/m", "nu": "N"}


def unit_of(name: str) -> str:
    """The unit of a number by the name of its key; empty where the name says none."""
    if name in _LETTERS:
        return _LETTERS[name]
    return next(
        (unit for end, unit in sorted(_ENDINGS.items(), key=lambda e: -len(e[0])) if name.endswith(end)), ""
    )
