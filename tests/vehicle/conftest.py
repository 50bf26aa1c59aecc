"""Sessions on doubles of MAVSDK's plugins."""

from __future__ import annotations

from functools import partial

import pytest

from tests.vehicle.session_rig import MakeSession, SessionRig


@pytest.fixture
def make_session(monkeypatch: pytest.MonkeyPatch) -> MakeSession:
    """A session whose plugins give these answers: `make_session({"arm_async": ...})`."""
    return partial(SessionRig, monkeypatch)


@pytest.fixture
def rig(make_session: MakeSession) -> SessionRig:
    """A session that has subscribed to all streams of a quadrotor, with an ESC."""
    return make_session({}).subscribe()
