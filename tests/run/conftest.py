"""Fixtures for programs that hold the link, on a scripted session."""

from __future__ import annotations

import asyncio
import gc
import sys
from collections.abc import Awaitable, Callable
from pathlib import Path

import pytest

from dart_flight.config.mission import Mission
from dart_flight.run import app
from dart_flight.run.app import AppOptions
from dart_flight.run.prepare import load_flyable
from tests.run.scripted_session import AppFlight, IdleCore, ScriptedSession, World, connecting_to

ROOT = Path(__file__).parents[2]


async def _do_nothing(flight: AppFlight) -> None:
    """End the mission at once."""


class FlyApp:
    """`fly_app(script)`: run an app on a scripted session, and return its flight.

    Attributes:
        changes: the app's changes to its process, in order.
    """

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self._patch, self.changes = monkeypatch, list[object]()
        # The app's changes to its process must not affect the test process.
        monkeypatch.setattr(gc, "collect", lambda: self.changes.append("collect"))
        monkeypatch.setattr(gc, "freeze", lambda: self.changes.append("freeze"))
        monkeypatch.setattr(sys, "setswitchinterval", self.changes.append)
        # No setting shortens this time, and the test would wait for it.
        monkeypatch.setattr(app, "_END_GRACE_S", 0.02)

    def __call__(
        self,
        script: Callable[[AppFlight], Awaitable[None]] = _do_nothing,
        mission: Mission | str = "square",
        *,
        session: ScriptedSession | None = None,
        options: AppOptions | None = None,
        world: World | None = None,
        real_core: bool = False,
    ) -> AppFlight:
        session = session or ScriptedSession()
        self._patch.setattr(app, "connect", connecting_to([session]))
        with self._patch.context() as patched:
            if not real_core:
                patched.setattr(app, "FlightCore", IdleCore)
            if isinstance(mission, str):
                # A quick servo, because the lock's thread runs in real time.
                mission = load_flyable(ROOT / f"missions/{mission}.yaml", None, ["lock.servo.travel_s=0.05"])
            flight = AppFlight(mission, session, options or AppOptions(), world)
        asyncio.run(flight.run(script))
        return flight


@pytest.fixture
def fly_app(monkeypatch: pytest.MonkeyPatch) -> FlyApp:
    """Run the app of a flight on a scripted session, with a core that does nothing by itself."""
    return FlyApp(monkeypatch)
