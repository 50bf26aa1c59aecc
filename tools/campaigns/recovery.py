"""Ways to recover from a hit that turns the vehicle, side by side: what a companion may command.

    python -m tools.campaigns.recovery                  # every candidate; build/recovery.md
    python -m tools.campaigns.recovery paper level-0.15 --groups wide_room

Every candidate flies the same jobs (`tools.campaigns.body`): the shipped missions at the default body, at
mid-range and at the worst corner of its ranges, walls true and askew, and a wall with room for hits faster
than any of the paper. The candidates stand here and not in the core, but for the one that is flown.
"""

from __future__ import annotations

import argparse
import itertools
import statistics
import sys
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from typing import NamedTuple
from unittest.mock import patch

from rich.console import Console

from dart_flight.base.geometry import distance2
from dart_flight.base.records import ImpactPeak, Input, OdometrySample, Phase, SetPoint
from dart_flight.config.mission import Mission
from dart_flight.core import flight_core
from dart_flight.core.mission.executive import Executive
from dart_flight.core.mission.proposal import Proposal
from dart_flight.core.mission.yielding import Yielding
from dart_flight.core.sense.senses import Sensed
from dart_flight.core.sense.state import FlightState
from tools.campaigns.body import MIDDLE, ROOT, WIDE_ROOM, WORST, Flown, Job, default_case, fly

_SEEDS = (6001,)  # not those of `tools.campaigns.body`: a candidate may be chosen on these


class _Unmoved(Yielding):
    """Feeds nothing forward."""

    def take(self, sensed: Sensed) -> None:
        pass


class KeepsStill(Executive):
    """Nothing is asked for in a contact until the peak, and nothing is fed forward."""

    def __init__(self, mission: Mission) -> None:
        super().__init__(mission)
        self._yielding = _Unmoved(mission.vehicle)

    def _send_reference(self, sample: OdometrySample, state: FlightState, p: Proposal) -> None:
        if self.phase is not Phase.CONTACT:
            super()._send_reference(sample, state, p)


class _AfterPeak(KeepsStill):
    """An executive whose set-points change for a while after each peak.

    Attributes:
        lasts_s: for how long.
    """

    lasts_s = 0.0
    _peak_us: int | None = None
    _yaw_before = 0.0

    def _on_peak(self, event: ImpactPeak, state: FlightState, p: Proposal) -> None:
        before = self.phase
        self._yaw_before = self._references.yaw
        super()._on_peak(event, state, p)
        if before is Phase.CONTACT and self.phase is Phase.RECOVERY:
            self._peak_us = state.now_us

    def since_peak_s(self, state: FlightState) -> float | None:
        """Since the peak of the recovery under way."""
        if self._peak_us is None or self.phase is not Phase.RECOVERY:
            return None
        return (state.now_us - self._peak_us) * 1e-6

    def propose(self, item: Input, state: FlightState, sensed: Sensed, p: Proposal) -> None:
        super().propose(item, state, sensed, p)
        since_s = self.since_peak_s(state)
        if since_s is not None and isinstance(item, OdometrySample) and p.outputs:
            last = p.outputs[-1]
            if isinstance(last, SetPoint):
                p.outputs[-1] = self.changed(last, item, state, since_s)

    def changed(self, setpoint: SetPoint, sample: OdometrySample, state: FlightState, s: float) -> SetPoint:
        """Another set-point in its place."""
        raise NotImplementedError


class _Level(_AfterPeak):
    """Level first: the velocity that the vehicle has, no acceleration; then the paper's set-point."""

    def changed(self, setpoint: SetPoint, sample: OdometrySample, state: FlightState, s: float) -> SetPoint:
        if s >= self.lasts_s:
            return setpoint
        p, v = sample.position_ned, sample.velocity_ned
        return SetPoint(
            t_us=setpoint.t_us,
            trigger_received_us=setpoint.trigger_received_us,
            position_ned=(p[0], p[1], setpoint.position_ned[2]),
            yaw_ned_rad=setpoint.yaw_ned_rad,
            velocity_ned=(v[0], v[1], 0.0),
            acceleration_ned=(0.0, 0.0, 0.0),
        )


class _Soft(_AfterPeak):
    """The set-point moves from where the vehicle was at the peak to the paper's in a smooth way."""

    _from: tuple[float, float] | None = None

    def changed(self, setpoint: SetPoint, sample: OdometrySample, state: FlightState, s: float) -> SetPoint:
        if self._from is None or s < 0.01:
            self._from = (sample.position_ned[0], sample.position_ned[1])
        share = min(1.0, s / self.lasts_s)
        share = share * share * (3.0 - 2.0 * share)
        to = setpoint.position_ned
        return SetPoint(
            t_us=setpoint.t_us,
            trigger_received_us=setpoint.trigger_received_us,
            position_ned=(
                self._from[0] + share * (to[0] - self._from[0]),
                self._from[1] + share * (to[1] - self._from[1]),
                to[2],
            ),
            yaw_ned_rad=setpoint.yaw_ned_rad,
        )


class _Heading(_AfterPeak):
    """The heading asked for follows the vehicle for a while, then goes back at the configured rate."""

    def changed(self, setpoint: SetPoint, sample: OdometrySample, state: FlightState, s: float) -> SetPoint:
        if s < self.lasts_s:
            self._references.yaw = state.yaw
        else:
            self._references.slew_yaw(self._yaw_before, state.now_us)
        assert state.frame is not None
        return SetPoint(
            t_us=setpoint.t_us,
            trigger_received_us=setpoint.trigger_received_us,
            position_ned=setpoint.position_ned,
            yaw_ned_rad=state.frame.yaw_to_ned(self._references.yaw),
        )


class _FromOnset(KeepsStill):
    """From the onset to the peak what the vehicle does anyway is asked for; PX4's D term does as it likes."""

    def propose(self, item: Input, state: FlightState, sensed: Sensed, p: Proposal) -> None:
        super().propose(item, state, sensed, p)
        if self.phase is Phase.CONTACT and isinstance(item, OdometrySample) and state.frame is not None:
            p.outputs.append(self._references.yielding_setpoint(state.frame, item, None))


class _Tilted(KeepsStill):
    """Anticipation: the last 0.25 s of an approach ask for the acceleration away from the wall.

    The vehicle meets the wall already leaning back, and slower.
    """

    lead_s = 0.25
    lean_m_s2 = 2.0

    def propose(self, item: Input, state: FlightState, sensed: Sensed, p: Proposal) -> None:
        super().propose(item, state, sensed, p)
        if self.phase is not Phase.APPROACH or not isinstance(item, OdometrySample) or not p.outputs:
            return
        last, collision = p.outputs[-1], self._collision
        if collision is None or not isinstance(last, SetPoint) or last.acceleration_ned is None:
            return
        speed = distance2(state.velocity, (0.0, 0.0))
        if speed > 0.1 and collision.wall.signed_distance(state.position) < self.lead_s * speed:
            n = collision.wall.normal
            assert state.frame is not None
            away = state.frame.vector_to_ned((self.lean_m_s2 * n[0], self.lean_m_s2 * n[1], 0.0))
            a = last.acceleration_ned
            p.outputs[-1] = SetPoint(
                t_us=last.t_us,
                trigger_received_us=last.trigger_received_us,
                position_ned=last.position_ned,
                yaw_ned_rad=last.yaw_ned_rad,
                velocity_ned=last.velocity_ned,
                acceleration_ned=(a[0] + away[0], a[1] + away[1], a[2]),
            )


def _lasting(kind: type[_AfterPeak], seconds: float) -> type[Executive]:
    return type(f"{kind.__name__}{seconds}", (kind,), {"lasts_s": seconds})


CANDIDATES: dict[str, tuple[str, type[Executive]]] = {
    "paper": ("the paper's set-point at once", KeepsStill),
    "level-0.15": ("level for 0.15 s, then the paper's", _lasting(_Level, 0.15)),
    "level-0.3": ("level for 0.3 s, then the paper's", _lasting(_Level, 0.3)),
    "soft-0.3": ("the set-point moves there in 0.3 s", _lasting(_Soft, 0.3)),
    "heading-0.3": ("the heading follows the vehicle for 0.3 s", _lasting(_Heading, 0.3)),
    "onset": ("from the onset on what the vehicle does anyway", _FromOnset),
    "yield": ("from the onset on what the vehicle does anyway, PX4's D term taken out", Executive),
    "tilted": ("leaning back by 2 m/s2 from 0.25 s before the wall on", _Tilted),
}


def jobs() -> dict[str, list[Job]]:
    """What every candidate flies, by group."""
    groups: dict[str, list[Job]] = {}
    for case, mission in itertools.product(
        (default_case(), MIDDLE, WORST), ("paper_single_wall", "paper_dual_collision")
    ):
        groups[f"{mission}, {case.name}"] = [
            Job(mission, seed, case, yaw) for yaw, seed in itertools.product((0.0, 5.0, -10.0), _SEEDS)
        ]
    for speed in (1.5, 2.0, 3.0):
        groups[f"{WIDE_ROOM}, {speed:g} m/s"] = [
            Job(WIDE_ROOM, _SEEDS[0], default_case(), yaw, -speed) for yaw in (0.0, 10.0, -10.0, 20.0, -20.0)
        ]
    return groups


class _Row(NamedTuple):
    candidate: str
    group: str
    flights: list[Flown]

    def markdown(self) -> str:
        """One line of the table."""
        kinds = [flown.kind for flown in self.flights]
        hits = [hit for flown in self.flights for hit in flown.hits]
        second = [abs(hit.normal_m_s) for hit in (f.second() for f in self.flights) if hit is not None]
        cells = (
            self.group,
            self.candidate,
            f"{kinds.count('completed')} of {len(kinds)}",
            str(kinds.count("uncontrolled")),
            f"{max((flown.tilt_deg for flown in self.flights), default=0.0):.0f}",
            f"{max((hit.rate_deg_s for hit in hits), default=0.0):.0f}",
            f"{1e3 * max((hit.saturated_s for hit in hits), default=0.0):.0f}",
            f"{statistics.median(second):.2f}" if second else "",
        )
        return "| " + " | ".join(cells) + " |"


def _fly(candidate: str, job: Job) -> Flown:
    with patch.object(flight_core, "Executive", CANDIDATES[candidate][1]):
        return fly(job)


HEAD = (
    "| flights | recovery | completed | uncontrolled | tilt, deg | rate, deg/s | a motor at its limit, ms | "
    "second hit, m/s |\n|---|---|---:|---:|---:|---:|---:|---:|"
)


def main() -> int:
    """Fly the candidates named on the command line, all of them by default; write build/recovery.md."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("candidates", nargs="*", default=list(CANDIDATES), help=", ".join(CANDIDATES))
    parser.add_argument("--groups", default="", help="only groups of jobs whose name contains this")
    options = parser.parse_args()
    wanted, groups = options.candidates, {k: v for k, v in jobs().items() if options.groups in k}
    unknown = set(wanted) - set(CANDIDATES)
    if unknown:
        parser.error(f"no candidate {', '.join(sorted(unknown))}; there are {', '.join(CANDIDATES)}")
    console = Console(stderr=True)
    lines = [HEAD]
    with ProcessPoolExecutor(2) as pool:
        for group, members in groups.items():
            for candidate in wanted:
                run: Callable[..., list[Flown]] = lambda c, js: list(pool.map(_fly, [c] * len(js), js))  # noqa: E731
                row = _Row(candidate, group, run(candidate, members)).markdown()
                console.print(row, markup=False, soft_wrap=True)
                lines.append(row)
    path = ROOT / "build" / "recovery.md"
    path.parent.mkdir(exist_ok=True)
    path.write_text("\n".join(lines) + "\n")
    return 0


if __name__ == "__main__":
    sys.exit(main())
