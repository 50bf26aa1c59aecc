"""Replay: equal inputs give equal decisions, and changed settings show the decisions they would cause."""

from __future__ import annotations

import json
from pathlib import Path

import msgspec
import pytest

from dart_flight.base.records import ImpactOnset, ImpactPeak, ImuSample, Phase, Setpoint, World
from dart_flight.cli import main
from dart_flight.config.document import InputError
from dart_flight.config.mission import Mission
from dart_flight.recording.about import describe_flight
from dart_flight.recording.reader import Log, LogEntry, read_log
from dart_flight.run.fast import FastFlight
from dart_flight.run.replay import changed_mission, replay
from tests.shared_flights import PLAIN_GPS, SharedFlights


def with_record(log: Log, index: int, record: object) -> Log:
    """Return a copy of a log with one record replaced."""
    entries = list(log.entries)
    entries[index] = LogEntry(entries[index].number, record)  # type: ignore[arg-type]
    return Log(log.source, log.about, log.end, entries, log.complete)


def beginning(log: Log, inputs: int, about: dict[str, str] | None = None) -> Log:
    """Return a complete log of the first inputs and their outputs."""
    entries = [entry for entry in log.entries if entry.number < inputs]
    return Log(log.source, about or log.about, log.end, entries, True)


def test_a_flight_replays_bit_for_bit(flight: Log) -> None:
    result = replay(flight)
    assert result.exact
    assert result.equal
    assert result.inputs > 10_000
    assert result.outputs > 5_000
    assert any(isinstance(r, ImpactPeak) for r in result.replayed)
    assert any(isinstance(r, Setpoint) and r.recovery for r in result.replayed)


@pytest.mark.parametrize(
    ("name", "settings"),
    [
        ("paper_dual_collision", ()),
        *(
            pytest.param(name, settings, marks=pytest.mark.rest)
            for name, settings in (
                ("find_a_wall", ()),  # probes
                ("dual_collision_gps", PLAIN_GPS),  # a frame that contacts correct
            )
        ),
    ],
)
def test_a_shared_flight_replays_bit_for_bit(
    name: str, settings: tuple[str, ...], flown: SharedFlights
) -> None:
    result = replay(read_log(flown(name, 1, settings=settings).log))
    assert result.exact
    assert result.equal, result.differences[0].text()
    assert any(isinstance(r, ImpactPeak) for r in result.replayed)


def test_one_changed_bit_of_an_input_is_detected(flight: Log) -> None:
    """The least significant bit of one IMU sample changes during the contact."""
    peak = next(e.record for e in flight.entries if isinstance(e.record, ImpactOnset))
    index, sample = next(
        (i, e.record)
        for i, e in enumerate(flight.entries)
        if isinstance(e.record, ImuSample) and e.record.t_us == peak.t_us
    )
    x, y, z = sample.specific_force_frd
    moved = msgspec.structs.replace(sample, specific_force_frd=(x + 4e-15 * max(1.0, abs(x)), y, z))
    assert moved != sample
    log = with_record(beginning(flight, flight.entries[index].number + 50), index, moved)
    result = replay(log)
    assert not result.equal
    assert "ForceEstimate: force_mission" in result.differences[0].text()
    # The comparison between kinds of machines tolerates such a difference.
    assert replay(log, exact=False).equal


def test_a_missing_decision_is_detected(flight: Log) -> None:
    index = next(i for i, e in enumerate(flight.entries) if isinstance(e.record, ImpactPeak))
    flight = beginning(flight, flight.entries[index].number + 50)
    entries = flight.entries[:index] + flight.entries[index + 1 :]
    result = replay(Log(flight.source, flight.about, flight.end, entries, True))
    assert result.differences[0].text().startswith("ImpactPeak is not in the recording")


def test_a_higher_threshold_delays_the_detection(flight: Log) -> None:
    result = replay(flight, ["detection.force_threshold_n=25"])
    onsets = [
        [r.t_us for r in side if isinstance(r, ImpactOnset)] for side in (result.recorded, result.replayed)
    ]
    assert len(onsets[0]) == len(onsets[1]) == 1
    assert onsets[1][0] > onsets[0][0]


def test_a_changed_recovery_gain_changes_only_the_recovery(flight: Log) -> None:
    result = replay(flight, ["collisions[0].alpha_m_per_n=[0.05, 0.05]"])
    before, after = (
        next(r for r in side if isinstance(r, Setpoint)) for side in (result.recorded, result.replayed)
    )
    assert before.t_us == after.t_us
    assert after.position_ned != before.position_ned
    assert result.differences[0].recorded == before


@pytest.mark.parametrize(
    ("setting", "words"),
    [
        ("detection.force_treshold_n=8", "did you mean force_threshold_n"),
        ("detection.force_threshold_n=-1", "detection.force_threshold_n"),
        ("detection.force_threshold_n=much", "expected a number"),
        ("detection.force_threshold_n", "KEY=VALUE"),
        ("detector.force_threshold_n=8", "unknown key 'detector'"),
        ("collisions[3].mode=rigid", "unknown key 3, known: 0 to 0"),
        ("collisions[0].mode=stiff", "only: rigid, flexible"),
        ("materials.steel.rigid.k=1", "materials.steel.rigid.k=1: missing key f"),
        ("start.altitude_m=9", "bounds_m z"),
        ("airframe.mass_kg=[", "not valid YAML"),
        ("airframe.mass_kg.kg=1", "no key below"),
    ],
)
def test_invalid_settings_are_rejected_with_their_cause(setting: str, words: str, flight: Log) -> None:
    with pytest.raises(InputError) as error:
        changed_mission(flight, [setting])
    assert words in str(error.value)
    assert "\n" not in str(error.value)


def test_the_replay_command_refuses_an_invalid_setting_in_one_line(
    flight_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["replay", str(flight_path), "--set", "detection.force_threshold_n=-1"]) == 2
    error = capsys.readouterr().err
    assert error.count("\n") == 1
    assert "detection.force_threshold_n" in error


def test_a_mission_changed_by_options_is_replayed_as_flown(single_wall: Mission) -> None:
    """The log holds the mission as changed by the command line; replay can then set only vehicle keys."""
    flown = msgspec.structs.replace(single_wall, altitude_m=1.2)
    entries: list[LogEntry] = []
    flight = FastFlight(flown, 1, observe=lambda r, n: entries.append(LogEntry(n, r)))
    assert flight.lock is not None
    flight.lock.start()
    while flight.core.phase != Phase.TRANSIT:
        flight.tick()
    log = Log("log", describe_flight(flown, World.FAST, 1), {}, entries, True)
    assert replay(log).equal
    assert changed_mission(log, ["detection.force_threshold_n=6"]).altitude_m == 1.2
    with pytest.raises(InputError, match="only keys of the configuration"):
        changed_mission(log, ["start.altitude_m=1.1"])


def test_a_cut_log_replays_up_to_the_cut(flight: Log) -> None:
    for cut in (0, 1, 500, 7001, 15_002):
        log = Log(flight.source, flight.about, {}, flight.entries[:cut], False)
        result = replay(log)
        assert result.equal
        assert result.note.startswith("the log is cut short")


def test_replay_reports_lost_inputs(flight: Log) -> None:
    entries = [e for e in beginning(flight, 1000).entries if not 100 <= e.number < 110]
    result = replay(Log(flight.source, flight.about, flight.end, entries, True))
    assert result.missing == 10
    assert "lost 10 inputs" in result.note


OTHER_THRESHOLD = ("--set", "detection.force_threshold_n=20")


def test_the_replay_command_reports_equality_and_differences(
    flight_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["replay", str(flight_path), "--json"]) == 0
    answer = json.loads(capsys.readouterr().out)
    assert answer["equal"] is True
    assert answer["exact"] is True
    assert answer["differences"] == 0
    assert main(["replay", str(flight_path), *OTHER_THRESHOLD]) == 1
    assert "ImpactOnset" in capsys.readouterr().out


@pytest.mark.rest
def test_the_replay_command_prints_equality_and_lists_differences_as_json(
    flight_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["replay", str(flight_path)]) == 0
    assert "equal" in capsys.readouterr().out
    assert main(["replay", str(flight_path), *OTHER_THRESHOLD, "--json"]) == 1
    answer = json.loads(capsys.readouterr().out)
    assert answer["equal"] is False
    assert "DetectionFloor" in answer["first"]
