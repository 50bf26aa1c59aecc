"""The app forwards motion-capture poses while it is connected, and a simulated world waits for them."""

from __future__ import annotations

from collections.abc import Callable
from itertools import pairwise
from pathlib import Path

import pytest

from dart_flight.base.records import MissionEnd, Outcome, PoseSample, PosesWithheld, Record, StatusText
from dart_flight.cli import main
from dart_flight.config.document import InputError
from dart_flight.lab.flight_arrays import FlightArrays
from dart_flight.recording.about import flown_mission
from dart_flight.recording.reader import read_log
from dart_flight.run import app as module
from dart_flight.run.app import AppOptions
from dart_flight.run.embedded import fly_embedded
from dart_flight.run.prepare import load_flyable, with_mocap, with_simulated_mocap
from dart_flight.run.replay import replay
from dart_flight.sim.pipe import FULL_SPEED
from dart_flight.vehicle.motion_capture.pose_bridge import forwarded_pose
from dart_flight.vehicle.motion_capture.source import RawPose
from tests.run.conftest import FlyApp
from tests.run.scripted_session import AppFlight, ScriptedSession

ROOT = Path(__file__).parents[2]
SQUARE, NEAR = ROOT / "missions/square.yaml", ROOT / "tests/data/near_wall.yaml"
POSE = RawPose("dart", True, (1.0, 2.0, 3.0), (1.0, 0.0, 0.0, 0.0), 1, 1_000, "10.0.0.1:1511")


class ScriptedSource:
    """A pose source that delivers the poses of a test."""

    problem: str | None = None
    place, remedy = "a script", "deliver poses"

    def __init__(self) -> None:
        self.deliver: Callable[[RawPose], None] | None = None
        self.stops = 0

    def start(self, deliver: Callable[[RawPose], None]) -> None:
        self.deliver = deliver

    def stop(self) -> None:
        self.stops += 1


@pytest.fixture
def source(monkeypatch: pytest.MonkeyPatch) -> ScriptedSource:
    """The pose source of every URL."""
    source = ScriptedSource()
    monkeypatch.setattr(module, "open_source", lambda url: source)
    # No setting shortens this time, and the test would wait for it.
    monkeypatch.setattr(module, "_LOOK_PERIOD_S", 0.01)
    return source


WITH_POSES = with_mocap(load_flyable(SQUARE), "udp://127.0.0.1:9763/dart")


def test_poses_go_to_px4_until_the_core_withholds_them(fly_app: FlyApp, source: ScriptedSource) -> None:
    async def script(flight: AppFlight) -> None:
        assert source.deliver is not None
        source.deliver(POSE)
        flight.app.shell.execute(PosesWithheld(1, "turned", attitude_only=True))
        source.deliver(POSE._replace(source_us=500_000))
        flight.app.shell.execute(PosesWithheld(1, "another body"))
        source.deliver(POSE._replace(source_us=1_000_000))
        await flight.has(3, PoseSample)

    flight = fly_app(script, WITH_POSES)
    with_attitude, without_attitude = map(forwarded_pose, flight.session.messages)
    assert (with_attitude.attitude is None, without_attitude.attitude is None) == (False, True)
    assert [pose.source_us for pose in flight.records_of(PoseSample)] == [1_000, 500_000, 1_000_000]
    assert source.stops == 1
    assert flight.notes == []


def test_poses_are_forwarded_until_a_pilot_who_took_over_disarms(
    fly_app: FlyApp, source: ScriptedSource
) -> None:
    shown, session = list[Record](), ScriptedSession(armed_checks=5)
    fly_app(mission=WITH_POSES, session=session, options=AppOptions(shown.append))
    (text,) = (record.text for record in shown if isinstance(record, StatusText))
    assert text == "forwarding poses until the vehicle is disarmed; Ctrl-C ends the forwarding"
    assert not session.armed
    assert source.stops == 1


@pytest.mark.rest
@pytest.mark.mavlink
def test_pose_latency_is_in_simulated_time_and_the_flight_replays(tmp_path: Path) -> None:
    settings = ["simulation.pose_delay_s=0.02", "mocap.delay_ms=20", "mocap.up=y"]
    mission = with_simulated_mocap(load_flyable(NEAR, None, settings), "udp")
    verdict = fly_embedded(mission, 1, tmp_path, speed=FULL_SPEED)
    assert verdict.outcome is Outcome.COMPLETED
    assert verdict.ekf_error_m is not None
    assert verdict.ekf_error_m < 0.05
    log = read_log(next(tmp_path.glob("*/flight.mcap")))
    poses = [e.record for e in log.entries if isinstance(e.record, PoseSample)]
    frames = [p.frame_number for p in poses if p.frame_number is not None]
    assert {b - a for a, b in pairwise(frames)} == {1}
    # Compare only until the mission's end, because the world then runs without the program.
    (end_us,) = (e.record.t_us for e in log.entries if isinstance(e.record, MissionEnd))
    ages_us = [p.t_us - p.source_us for p in poses[1:] if p.source_us and p.t_us < end_us]
    assert set(ages_us) == {7_020_000}  # the autopilot's clock began at 7 s
    arrays = FlightArrays(log, flown_mission(log.about, log.source))
    assert arrays.posed.time_s.size > 400
    assert replay(log).equal


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--mocap", "optitrack://10.0.0.1/dart"], "emulated motion capture, one of"),
        (["--mocap", "kinect"], "emulated motion capture, one of"),
        (["--mocap", "udp", "--set", "simulation.position_from=rtk"], "comes from GPS"),
        (["--fault", "mocap-lost"], "add --mocap"),
        (["--mocap", "udp", "--fault", "mocap-slow=0"], "takes 1 to 50 Hz"),
    ],
)
def test_an_unusable_mocap_option_is_rejected_with_its_reason(
    options: list[str], message: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["dry-run", str(SQUARE), "--fast", *options]) == 2
    error = capsys.readouterr().err.strip()
    assert message in " ".join(error.split())


def test_simulation_ignores_the_configured_pose_source_without_mocap_option() -> None:
    mission = with_mocap(load_flyable(SQUARE), "optitrack://10.0.0.1/dart")
    assert with_simulated_mocap(mission, None).vehicle.mocap.url is None
    with pytest.raises(InputError, match="one of optitrack"):
        with_simulated_mocap(mission, "optitrack://10.0.0.1/dart")
