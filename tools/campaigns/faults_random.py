"""Campaign: flights with random faults, and the uncontrolled ones among them."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence

from dart_flight.lab.campaign.flight_job import JudgedRow
from tools.campaigns.results import markdown, rate


def page(rows: Sequence[JudgedRow]) -> str:
    """Return the figures of all flights, the most frequent ends, and the uncontrolled flights."""
    flown = [r.row for r in rows]
    ends = Counter(flight.came_of for flight in flown)
    figures = [
        ("uncontrolled (95 %)", rate(sum(bool(f.problems) for f in flown), len(flown), 1)),
        ("largest tilt", f"{max(f.tilt_deg for f in flown):.0f}°"),
        ("hardest landing", f"{max(f.landing_m_s for f in flown):.2f} m/s"),
        ("farthest out of the bounds", f"{max(f.excursion_m for f in flown):.2f} m"),
        ("ends", ", ".join(f"{name} {count}" for name, count in ends.most_common(5))),
    ]
    wrong = [f"- flight {r.seed}: {r.row.fault}: {'; '.join(r.row.problems)}" for r in rows if r.row.problems]
    return "\n".join([markdown(("random faults", str(len(flown))), figures), *wrong])
