"""Campaign: flights with random faults, and the uncontrolled ones among them."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence

from dart_flight.lab.campaign.flight_job import JudgedRow
from tools.campaigns.results import rate


def page(rows: Sequence[JudgedRow]) -> str:
    """Return the figures of all flights, the most frequent ends, and the uncontrolled flights."""
    flown = [r.row for r in rows]
    ends = Counter(flight.came_of for flight in flown)
    line = (
        f"Uncontrolled: {rate(sum(bool(f.problems) for f in flown), len(flown), 1)}. "
        f"Largest tilt {max(f.tilt_deg for f in flown):.0f}°, hardest landing "
        f"{max(f.landing_m_s for f in flown):.2f} m/s. "
        f"Ends: {', '.join(f'{name} {count}' for name, count in ends.most_common(4))}."
    )
    wrong = [f"- flight {r.seed}: {r.row.fault}: {'; '.join(r.row.problems)}" for r in rows if r.row.problems]
    return "\n".join([line, *wrong])
