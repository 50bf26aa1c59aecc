"""How far a mission is: its phase, the leg that comes next or is under way, and since when.

The phase changes only through the table in `phases`.
"""

from __future__ import annotations

from typing import Final

from dart_flight.base.records import Phase, PhaseChange, VehicleAction, VehicleCommand
from dart_flight.config.mission import Collision, Mission, Waypoint
from dart_flight.core.mission.lock_orders import LockOrders
from dart_flight.core.mission.phases import BETWEEN, TRANSITIONS, WATCHING, PhaseTrigger
from dart_flight.core.mission.proposal import Proposal
from dart_flight.core.mission.setpoint_generator import SetpointGenerator
from dart_flight.core.sense.state import FlightState

_RETRY_US: Final = 1_000_000  # telemetry of mode and arming lags by up to a second
_SLOWEST: Final = 3.0  # host's time over vehicle's


class MissionProgress:
    """Phase and leg of one flight.

    Attributes:
        phase: of the mission.
        collisions: of the mission; at a wall that was sought, once that is met, with it.
        index: of the collision that comes next or is under way.
        stops: waypoints and pauses that are over.
        entered_us: when the phase began, autopilot time.
        asked_us: when a vehicle command was last sent in this phase; None: not yet.
    """

    def __init__(self, mission: Mission, lock: LockOrders, references: SetpointGenerator) -> None:
        self._mission, self._lock, self._references = mission, lock, references
        self.phase = Phase.READYING
        self.collisions = list(mission.collisions)
        self.index = 0
        self.stops = 0
        self.entered_us: int | None = None
        self._entered_host_us: int | None = None
        self.asked_us: int | None = None

    @property
    def collision(self) -> Collision | None:
        """The collision that comes next or is under way."""
        collisions = self.collisions
        return collisions[self.index] if self.index < len(collisions) else None

    @property
    def last_collision(self) -> Collision:
        """The collision that is over; there must have been one."""
        return self._mission.collisions[self.index - 1]

    @property
    def waypoint(self) -> Waypoint | None:
        """The waypoint or pause that comes next or is under way, before the next collision."""
        waypoints = self._mission.waypoints
        if self.stops < len(waypoints) and waypoints[self.stops].after == self.index:
            return waypoints[self.stops]
        return None

    def begin(self, state: FlightState) -> bool:
        """Whether there is a time to count from, which is taken down where it is new."""
        if self.entered_us is None:
            if not state.now_us:
                return False
            self.entered_us = state.now_us
        if self._entered_host_us is None:
            self._entered_host_us = state.host_us
        return True

    def go(self, cue: PhaseTrigger, state: FlightState, p: Proposal, reason: str = "") -> None:
        """Change the phase, and record it."""
        p.outputs.append(self.change(cue, state.now_us, reason or cue.value))

    def change(self, cue: PhaseTrigger, now_us: int, reason: str) -> PhaseChange:
        """Change the phase; returns the record of it."""
        before = self.phase
        self.phase = TRANSITIONS[before, cue]
        self.entered_us, self._entered_host_us, self.asked_us = now_us, None, None
        self._lock.phase_begins()
        self._references.phase_begins()
        collision = self.collision
        index = collision.index if collision and self.phase in WATCHING - BETWEEN else None
        return PhaseChange(now_us, before, self.phase, reason, index)

    def elapsed_us(self, state: FlightState) -> int:
        """Since the phase began, autopilot time."""
        assert self.entered_us is not None
        return state.now_us - self.entered_us

    def takes_longer_than(self, limit_s: float, state: FlightState) -> bool:
        """Whether the phase does, by autopilot time."""
        return self.elapsed_us(state) > limit_s * 1e6

    def is_late(self, state: FlightState, travel_s: float = 0.0) -> bool:
        """Whether the phase lasts longer than anything should that is not a collision, and its travel.

        Also where the autopilot's clock has jumped back and stands still for it: by the host's clock, with
        room for a simulation that is slower than time.
        """
        limit_s = self._mission.vehicle.flying.ready_timeout_s + travel_s
        host_us = state.host_us - (self._entered_host_us or state.host_us)
        return self.takes_longer_than(limit_s, state) or host_us > _SLOWEST * limit_s * 1e6

    def ask(self, action: VehicleAction, state: FlightState, p: Proposal) -> None:
        """Send a vehicle command, again every second until telemetry confirms it."""
        if self.asked_us is None or state.now_us - self.asked_us >= _RETRY_US:
            self.asked_us = state.now_us
            p.outputs.append(VehicleCommand(state.now_us, action))
