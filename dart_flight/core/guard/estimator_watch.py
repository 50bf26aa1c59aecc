"""The guard's monitoring of PX4's estimator: jumps, resets, heading steps, and the estimator's flags.

A contact disturbs the estimator. For a while after an impact only the heading is evaluated.
"""

from __future__ import annotations

import math
from typing import Final

from dart_flight.base.geometry import norm
from dart_flight.base.records import (
    EstimatorSample,
    OdometrySample,
    Override,
    Phase,
)
from dart_flight.core.guard.estimator_resets import REACH_US, EstimatorReset, EstimatorResets
from dart_flight.core.guard.heading_step import HEADING_STEP_DEG
from dart_flight.core.guard.rule import Rule, RuleCondition, Scope
from dart_flight.core.guard.second_vehicle import POSITION_JUMP_M
from dart_flight.core.mission.phases import ON_GROUND

VELOCITY_JUMP_M_S: Final = 1.5  # limit between two samples; only a contact changes a correct velocity by more
# A reset with smaller steps changes only the heading, for example when PX4 aligns it in flight.
RESET_POSITION_M: Final = 0.05
RESET_VELOCITY_M_S: Final = 0.2
ESTIMATOR_BAD_S: Final = 0.3  # longest time without a valid position; PX4 may be switching sources
# PX4 may align its heading in the climb if it had no heading on the ground.
_ALIGNING: Final = frozenset((*ON_GROUND, Phase.CLIMB))


class EstimatorWatch:
    """Monitor of PX4's estimator in one flight. Its methods return a description of a problem, or None.

    `jump` describes a jump in this step's odometry, and is empty if there is none.
    """

    def __init__(self) -> None:
        self.jump = ""
        self._now_us = 0
        self._excused = False
        self.resets = EstimatorResets()
        self._reset_phase = Phase.READYING  # the phase at the newest reset
        self._unhealthy = False
        self._invalid_since_us: int | None = None
        self._recovers_us: int | None = None  # newest time at which PX4's motion was wrong

    def begin(self, now_us: int, excused: bool) -> None:
        """Begin a step; if `excused`, an impact explains unusual behaviour of the estimator."""
        self.jump, self._now_us, self._excused = "", now_us, excused

    def add_odometry(self, item: OdometrySample) -> None:
        """Process a position that the flight state has accepted."""
        if self.resets.reckoned is not None:
            self._recovers_us = self._now_us
        away_m, faster_m_s = self.resets.add_odometry(item)
        if self._excused or self._recovers:
            return
        if away_m > POSITION_JUMP_M:
            self.jump = f"position jumped by {away_m:.2f} m, limit {POSITION_JUMP_M:g} m"
        if faster_m_s > VELOCITY_JUMP_M_S:
            self.jump = f"velocity jumped by {faster_m_s:.2f} m/s, limit {VELOCITY_JUMP_M_S:g} m/s"

    def reject_odometry(self, item: OdometrySample) -> None:
        away_m, fast_m_s = norm(item.position_ned), norm(item.velocity_ned)
        self.jump = f"implausible position: {away_m:.3g} m from the origin at {fast_m_s:.3g} m/s"

    def add_report(self, item: EstimatorSample, phase: Phase) -> None:
        counter = item.reset_counter
        if counter is not None and self.resets.update_counter(counter, self._now_us, phase in _ALIGNING):
            self._reset_phase = phase
        if item.healthy is not None:
            self._unhealthy = not item.healthy

    def finish(self, position_ok: bool) -> None:
        """Finish a step; `position_ok` is PX4's flag for a valid position."""
        if (position_ok and not self._unhealthy) or self._excused:
            self._invalid_since_us = None
        elif self._invalid_since_us is None and self._now_us:  # `_now_us` is 0 until a stamped sample arrives
            self._invalid_since_us = self._now_us

    def _reset_within(self, reach_us: int) -> EstimatorReset | None:
        reset = self.resets.newest
        return reset if reset is not None and self._now_us - reset.t_us <= reach_us else None

    @property
    def _recovers(self) -> bool:
        """Whether PX4 is recovering from a wrong heading; a jump to the true motion is then not a fault."""
        return self._recovers_us is not None and self._now_us - self._recovers_us <= 2 * REACH_US

    def reset_step(self) -> str | None:
        reset = self._reset_within(REACH_US)
        if reset is None or self._excused or self._recovers:
            return None
        if reset.position_m > RESET_POSITION_M or reset.velocity_m_s > RESET_VELOCITY_M_S:
            return f"position stepped by {reset.position_m:.2f} m, velocity by {reset.velocity_m_s:.2f} m/s"
        return None

    def heading_step(self) -> str | None:
        reset = self._reset_within(2 * REACH_US)
        if reset is None or self._reset_phase in _ALIGNING:
            return None
        step_deg, limit = math.degrees(reset.heading_rad), HEADING_STEP_DEG
        if abs(step_deg) <= limit:
            return None
        return f"heading stepped by {step_deg:.1f} deg, limit {limit:.0f} deg"

    def invalid_estimate(self) -> str | None:
        since_us = self._invalid_since_us
        lasting_s = 0.0 if since_us is None else (self._now_us - since_us) * 1e-6
        return f"no valid estimate for {lasting_s:.1f} s" if lasting_s > ESTIMATOR_BAD_S else None


# fmt: off
ESTIMATOR_RULES: tuple[Rule, ...] = (
    Rule("estimator_jump", Override.HOLD, Scope.GUIDED, RuleCondition(
        "position or velocity jumped, and no impact explains the jump",
        f"{POSITION_JUMP_M:g} m, {VELOCITY_JUMP_M_S:g} m/s",
        lambda flight: flight.estimator.jump or None), (OdometrySample,), noted=True),
    Rule("estimator_reset", Override.HOLD, Scope.GUIDED, RuleCondition(
        "PX4 reset its estimator; position or velocity stepped, and no impact explains the step",
        f"{RESET_POSITION_M:g} m, {RESET_VELOCITY_M_S:g} m/s",
        lambda flight: flight.estimator.reset_step()), noted=True),
    Rule("heading_reset", Override.BREAK_OFF, Scope.FLYING, RuleCondition(
        "PX4 reset its estimator, and the heading stepped by more than 5 degrees relative to the gyro", "",
        lambda flight: flight.estimator.heading_step())),
    Rule("estimator_flags", Override.LAND, Scope.AIR, RuleCondition(
        "PX4's estimator reports an invalid position, and there was no recent impact",
        f"{ESTIMATOR_BAD_S:g} s",
        lambda flight: flight.estimator.invalid_estimate())),
)
# fmt: on
