"""A session between app and MAVSDK, with MAVSDK's plugins in its place: what is asked, what is delivered."""

from __future__ import annotations

import asyncio
import json
from collections.abc import Callable
from types import SimpleNamespace
from typing import Any

import pytest
from mavsdk.plugins.telemetry import FlightMode as SdkFlightMode

from dart_flight.base.records import (
    FlightMode,
    HealthReport,
    Input,
    OtherVehicle,
    Setpoint,
    StatusSample,
    VehicleAction,
)
from dart_flight.base.streams import STREAMS
from dart_flight.config.vehicle import load_vehicle, packaged
from dart_flight.vehicle import arming_problems as reasons
from dart_flight.vehicle import vehicle_session as module
from dart_flight.vehicle.vehicle_session import VehicleSession

VEHICLE = load_vehicle(packaged("configs", "dart.yaml"))


class Plugin:
    """In the place of a plugin: notes every call; a subscription's callback is kept by its name."""

    def __init__(self, answers: dict[str, Callable[..., Any]]) -> None:
        self.calls: list[tuple[str, tuple[Any, ...]]] = []
        self.callbacks: dict[str, Callable[[Any, Any], None]] = {}
        self._answers = answers

    def __getattr__(self, name: str) -> Callable[..., Any]:
        def call(*arguments: Any) -> Any:
            self.calls.append((name, arguments))
            if name.startswith("subscribe_"):
                key = arguments[0] if len(arguments) > 1 else name.removeprefix("subscribe_")
                self.callbacks[key] = arguments[-1]
            return self._answers[name](*arguments) if name in self._answers else None

        return call


class Rig:
    """A session on such plugins.

    Args:
        answers: what calls return or raise, by name.
        systems: ids of the systems on the link; the first one is the vehicle's.
    """

    def __init__(
        self, monkeypatch: pytest.MonkeyPatch, answers: dict[str, Callable[..., Any]], *systems: int
    ) -> None:
        self.plugins: dict[str, Plugin] = {}
        for name in ("Telemetry", "Offboard", "Action", "ServerUtility", "MavlinkDirect", "Events"):
            plugin = self.plugins[name] = Plugin(answers)
            monkeypatch.setattr(module, name, lambda _, plugin=plugin: plugin)
        self.seen: list[Input] = []
        found = [
            SimpleNamespace(get_system_id=lambda number=number: number, has_autopilot=lambda: True)
            for number in systems or (1,)
        ]

        async def get_systems() -> list[Any]:
            return found

        self.session = VehicleSession(SimpleNamespace(get_systems=get_systems), found[0], self.seen.append)

    def of(self, kind: type[Any]) -> list[Any]:
        return [item for item in self.seen if isinstance(item, kind)]

    def say(self, plugin: str, stream: str, value: Any) -> None:
        self.plugins[plugin].callbacks[stream](value, None)


def message(**fields: object) -> Any:
    return SimpleNamespace(fields_json=json.dumps(fields))


def test_a_new_session_sends(monkeypatch: pytest.MonkeyPatch) -> None:
    rig = Rig(monkeypatch, {})
    rig.session.send(Setpoint(1, 1, (1.0, 2.0, -3.0), 0.0))
    assert [name for name, _ in rig.plugins["Offboard"].calls] == ["set_position_ned"]


def refuse(*_: Any) -> None:
    raise RuntimeError("refused")


def test_every_stream_is_asked_for_and_a_refusal_is_named(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    rig = Rig(monkeypatch, {"set_rate_odometry": refuse})
    assert asyncio.run(rig.session.set_rates()) == ["odometry"]
    asked = {name.removeprefix("set_rate_"): rate for name, (rate,) in rig.plugins["Telemetry"].calls}
    assert len(asked) == len(STREAMS)
    assert asked["imu"] == next(s.rate_hz for s in STREAMS if s.name == "imu")
    few = Rig(monkeypatch, {})
    assert asyncio.run(few.session.set_rates(["imu", "attitude"], watching=True)) == []
    assert {name for name, _ in few.plugins["Telemetry"].calls} == {
        "set_rate_imu",
        "set_rate_attitude_quaternion",
    }


@pytest.mark.parametrize(("result", "refused"), [(0, False), (4, True)])
def test_a_further_stream_is_asked_for_by_its_message(
    monkeypatch: pytest.MonkeyPatch, result: int, refused: bool
) -> None:
    rig = Rig(monkeypatch, {"send_command": lambda _: message(command=511, result=result)})
    estimation = SimpleNamespace(uses_esc=True, thrust_source=None)
    rig.session.subscribe(estimation, 4)  # type: ignore[arg-type]
    assert ("esc" in asyncio.run(rig.session.set_rates([]))) is refused


def test_a_local_position_is_one_that_is_sent_and_is_well(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """`is_local_position_ok` alone is true without motion capture and GPS, too."""
    rig = Rig(monkeypatch, {})
    rig.session.subscribe(VEHICLE.estimation, 4)
    rig.say("Telemetry", "health", SimpleNamespace(is_local_position_ok=True))
    rig.say("MavlinkDirect", "ESTIMATOR_STATUS", message(flags=0))
    assert not rig.of(StatusSample)[-1].local_position_ok
    rig.say("MavlinkDirect", "ESTIMATOR_STATUS", message(flags=0xFFFF & ~0x0400))
    assert rig.of(StatusSample)[-1].local_position_ok
    rig.say("Telemetry", "health", SimpleNamespace(is_local_position_ok=False))
    assert rig.of(StatusSample)[-1].local_position_ok  # the estimator knows better
    rig.say("MavlinkDirect", "ESTIMATOR_STATUS", message(flags=0))
    assert not rig.of(StatusSample)[-1].local_position_ok


def test_without_word_of_the_estimator_mavsdk_is_believed(monkeypatch: pytest.MonkeyPatch) -> None:
    rig = Rig(monkeypatch, {})
    rig.session.subscribe(VEHICLE.estimation, 4)
    for ok in (True, False):
        rig.say("Telemetry", "health", SimpleNamespace(is_local_position_ok=ok))
        assert rig.of(StatusSample)[-1].local_position_ok is ok


def test_what_keeps_px4_from_arming_is_delivered_when_it_changes(monkeypatch: pytest.MonkeyPatch) -> None:
    rig = Rig(monkeypatch, {})
    monkeypatch.setattr(reasons, "of_sys_status", lambda text: (False, (text,), ()))
    rig.session.subscribe(VEHICLE.estimation, 4)
    for text in ("gyro", "gyro", "compass"):
        rig.say("MavlinkDirect", "SYS_STATUS", SimpleNamespace(fields_json=text))
    assert [report.blocking for report in rig.of(HealthReport)] == [("gyro",), ("compass",)]
    monkeypatch.setattr(reasons, "of_checks", lambda report: (True, (), (report,)))
    rig.say("Events", "health_and_arming_checks", "its own words")
    rig.say("MavlinkDirect", "SYS_STATUS", SimpleNamespace(fields_json="gyro"))  # they count from then on
    assert [report.blocking for report in rig.of(HealthReport)] == [("gyro",), ("compass",), ()]


@pytest.mark.parametrize(("name", "said"), [("SUCCESS", ""), ("COMMAND_DENIED", "COMMAND_DENIED")])
def test_an_action_ends_with_its_answer(monkeypatch: pytest.MonkeyPatch, name: str, said: str) -> None:
    def answer(done: Callable[[Any, Any], None]) -> None:
        for _ in range(2):  # MAVSDK may say it twice
            done(SimpleNamespace(name=name), None)

    rig = Rig(monkeypatch, {"arm_async": answer})
    assert asyncio.run(rig.session.perform(VehicleAction.ARM)) == said


def test_an_action_without_an_answer_says_so(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "_ACTION_TIMEOUT_S", 0.01)
    rig = Rig(monkeypatch, {"land_async": lambda _: None})
    assert asyncio.run(rig.session.perform(VehicleAction.LAND)) == "no answer"


def test_another_autopilot_on_the_link_is_delivered_once(monkeypatch: pytest.MonkeyPatch) -> None:
    rig = Rig(monkeypatch, {}, 1, 7)
    for _ in range(2):
        asyncio.run(rig.session.look_for_others())
    assert [other.system for other in rig.of(OtherVehicle)] == [7]
    alone = Rig(monkeypatch, {}, 1)
    asyncio.run(alone.session.look_for_others())
    assert alone.of(OtherVehicle) == []


def test_modes_that_no_word_of_ours_has_are_the_pilots(monkeypatch: pytest.MonkeyPatch) -> None:
    rig = Rig(monkeypatch, {})
    rig.session.subscribe(VEHICLE.estimation, 4)
    for mode, expected in (
        (SdkFlightMode.OFFBOARD, FlightMode.OFFBOARD),
        (SdkFlightMode.POSCTL, FlightMode.MANUAL),
    ):
        rig.say("Telemetry", "flight_mode", mode)
        assert rig.of(StatusSample)[-1].flight_mode is expected
