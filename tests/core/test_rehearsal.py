"""A hand-fed rehearsal: the path from one wall to the next."""

from __future__ import annotations

import math
from itertools import pairwise

from dart_flight.base.records import LockPhase, Mode, Phase, Setpoint
from tests.core.conftest import HandFedCore


def follow(c: HandFedCore, seconds: float) -> list[Setpoint]:
    """Move the vehicle to every setpoint without delay; return the setpoints."""
    sent: list[Setpoint] = []
    for _ in range(round(seconds / 0.008)):
        here = [o for o in c.run(0.008) if isinstance(o, Setpoint)]
        sent += here
        if here:
            c.position_ned, c.velocity_ned = here[-1].position_ned, here[-1].velocity_ned or (0.0, 0.0, 0.0)
    return sent


def test_the_path_to_the_next_wall_starts_from_rest_after_a_slow_lock() -> None:
    c = HandFedCore(settings={"standoff_m": 0.3})
    c.enter_approach()
    while c.core.phase is Phase.APPROACH:
        follow(c, 0.1)
    assert c.core.phase is Phase.RECOVERY
    c.set_lock(Mode.RIGID, LockPhase.TRAVELLING)
    here = follow(c, 2.0)[-1].position_ned  # as long as the whole path takes
    c.set_lock(Mode.RIGID)
    sent = follow(c, 4.0)
    steps = [math.dist(b.position_ned, a.position_ned) for a, b in pairwise(sent)]
    assert math.dist(sent[0].position_ned, here) < 0.01
    assert max(steps) < 0.01
    assert math.dist(sent[-1].position_ned, here) > 0.4
