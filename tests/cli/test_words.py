"""Mistakes at the keyboard in words, names and files: each is reported in one line."""

from __future__ import annotations

import os
import re
import sys
import time
from pathlib import Path

import msgspec
import pytest

from dart_flight.base.records import World
from dart_flight.check.vehicle_check import evaluate_autopilot
from dart_flight.cli import main
from dart_flight.config.link_url import link_problem
from dart_flight.config.mission import load_mission
from dart_flight.config.vehicle import LockDriver, packaged
from dart_flight.lab.commands.export_command import _files
from dart_flight.recording.about import describe_flight
from dart_flight.recording.reader import read_log
from dart_flight.recording.writer import FlightLog
from dart_flight.vehicle import messages
from dart_flight.vehicle.baud_rate import console_line
from dart_flight.vehicle.ground_link import HeartbeatMode
from dart_flight.vehicle.messages import Unusable
from tests.command_fixtures import Refuse
from tests.doubles.ports import free_udp_port
from tests.shared_flights import SharedFlights

MISSION = str(packaged("missions", "paper_single_wall.yaml"))
SCENARIO = str(packaged("missions", "scenarios", "one_wall.yaml"))
CONFIG = str(packaged("configs", "dart.yaml"))
FLIGHT = str(next((Path(__file__).parents[1] / "data" / "flights").rglob("*.mcap")))


@pytest.mark.parametrize(
    ("words", "near"),
    [
        (["dryrun", MISSION], "dry-run"),
        (["replai", FLIGHT], "replay"),
        (["dry-run", MISSION, "--sede", "3"], "--seed"),
        (["dry-run", MISSION, "--fsat"], "--fast"),
        (["lock", "toggel"], "toggle"),
        (["lock", "status", "--driver", "mokc"], "mock"),
        (["dry-run", MISSION, "--driver", "mokc"], "mock"),
        (["plan", SCENARIO, "--objective", "nearst"], "nearest"),
        (["calibrate", "thurst", FLIGHT], "thrust"),
        (["completion", "bsh"], "bash"),
        (["dry-run", MISSION, "--fast", "--fault", "servo-slw"], "servo-slow"),
        (["dry-run", MISSION, "--fast", "--vary", "mas"], "mass"),
        (["dry-run", MISSION, "--fast", "--set", "simulatio.contact.body=guards"], "simulation"),
        (["dry-run", MISSION, "--fast", "--fault", "servo-slow@aproach"], "approach"),
        (["predict", "--surface", "acrilic", "--mode", "rigid", "--drop", "1"], "acrylic"),
        (["replay", FLIGHT, "--set", "detektion.force_threshold_n=8"], "detection"),
    ],
    ids=lambda value: " ".join(value[:1] + value[2:]) if isinstance(value, list) else "",
)
def test_a_misspelt_word_is_answered_with_a_suggestion(
    words: list[str], near: str, refusal_of: Refuse
) -> None:
    assert f"did you mean {near}?" in refusal_of(*words)


@pytest.mark.parametrize(
    ("words", "kind"),
    [
        (["check", SCENARIO], "this is a scenario: `dart-flight plan`"),
        (["dry-run", CONFIG], "this is a vehicle configuration: pass it with --config"),
        (["dry-run", FLIGHT], "this is a flight log, which is an input of replay"),
        (["plan", MISSION], "this is a mission, which is an input of fly"),
        (["check", MISSION, "--config", MISSION], "this is a mission"),
        (["replay", MISSION], "this is a mission"),
        (["report", SCENARIO, "-o", "x.html"], "this is a scenario"),
        (["identify", MISSION], "this is a mission"),
        (["calibrate", "thrust", CONFIG], "this is a vehicle configuration"),
        (["predict", "--surface", "acrylic", "--batch", MISSION], "this is a mission"),
        (["inspect", FLIGHT], "this is a flight log, which is an input of replay, report, export"),
        (["zzz"], "known: fly, dry-run, campaign, simulate"),
    ],
    ids=lambda value: value[0] if isinstance(value, list) else "",
)
def test_the_wrong_kind_of_file_or_command_is_named(words: list[str], kind: str, refusal_of: Refuse) -> None:
    assert kind in refusal_of(*words)


@pytest.mark.parametrize(
    ("words", "says"),
    [
        (
            ["--config", CONFIG, "check", MISSION],
            "options come after the command: dart-flight check --config",
        ),
        (["-v", "tables"], "options come after the command: dart-flight tables -v"),
        (["check", MISSION, "--mocap", "udp://0.0.0.0:9763/dart"], "--mocap: .* give --connection too"),
        (["mocap", "--mocap", "optitrack"], "only dry-run and simulate accept .* optitrack://SERVER/BODY"),
    ],
)
def test_an_option_in_the_wrong_place_is_answered_with_the_right_one(
    words: list[str], says: str, refusal_of: Refuse
) -> None:
    assert re.search(says, refusal_of(*words))


@pytest.mark.parametrize(
    "words",
    [
        ["check", MISSION],
        ["fly", MISSION, "--yes"],
        ["monitor"],
        ["plan", SCENARIO],
        ["lock", "status", "--driver", "px4"],
    ],
    ids=lambda words: words[0],
)
@pytest.mark.parametrize("url", ["ttyAMA0", "serial:///dev/tty-none:57600"])
def test_an_invalid_link_is_refused_with_the_allowed_forms(
    words: list[str], url: str, folder: Path, refusal_of: Refuse
) -> None:
    line = refusal_of(*words, "--connection", url)
    assert line.startswith("--connection: ")
    assert "serial:///dev/ttyAMA0:921600" in line, "lists the allowed forms"


@pytest.mark.parametrize(
    ("url", "allowed"),
    [
        *(
            (url, True)
            for url in (
                "udpin://0.0.0.0:14540", "udp://:14540", "udpout://10.0.0.2:14550", "tcpout://localhost:5760",
                "tcpin://0.0.0.0:5760", "serial:///dev/ttyAMA0:921600", "serial_flowcontrol:///dev/ttyS1:57600",
            )
        ),
        *(
            (url, False)
            for url in (
                "", "foo", "udpin://0.0.0.0", "udpin://0.0.0.0:99999", "serial:///dev/ttyAMA0",
                "serial://x:5", "udpin://:1",
            )
        ),
    ],
)  # fmt: skip
def test_only_connection_urls_of_mavsdk_are_accepted(url: str, allowed: bool) -> None:
    assert (link_problem(url) is None) is allowed


def test_a_malformed_url_in_the_configuration_is_refused(tmp_path: Path, refusal_of: Refuse) -> None:
    path = tmp_path / "dart.yaml"
    text = Path(CONFIG).read_text()
    url = next(line for line in text.splitlines() if line.strip().startswith("url:"))
    path.write_text(text.replace(url, "  url: udpin:14540"))
    output = refusal_of("check", MISSION, "--config", str(path))
    assert "connection" in output
    assert "expected: " in output


@pytest.mark.parametrize(
    ("row", "key"),
    [("rigid,1.0,0.5", "normal_m_s"), ("rigid,0,0.5", "normal_m_s"), ("rigid,-1.0,500", "tangential_m_s")],
)
def test_batch_refuses_the_same_velocities_as_the_velocity_option(
    row: str, key: str, tmp_path: Path, refusal_of: Refuse
) -> None:
    path = tmp_path / "hits.csv"
    path.write_text(f"mode,normal_m_s,tangential_m_s\nrigid,-1.0,0.5\n{row}\n")
    batch = refusal_of("predict", "--surface", "acrylic", "--batch", str(path))
    assert f"hits.csv:3: {key}" in batch
    _, normal, tangential = row.split(",")
    single = refusal_of(
        "predict", "--surface", "acrylic", "--mode", "rigid", "--velocity", normal, tangential
    )
    assert batch.split(f"{key}: ")[-1].strip() in single, "for the same reason"


def test_monitor_ends_when_no_telemetry_arrives(capsys: pytest.CaptureFixture[str]) -> None:
    begun = time.monotonic()
    url = f"udpin://127.0.0.1:{free_udp_port()}"
    assert main(["monitor", "--connection", url, "--seconds", "0.5"]) == 1
    assert time.monotonic() - begun < 15.0, "connection.timeout_s is 30 s"
    assert "no autopilot" in capsys.readouterr().err


@pytest.mark.skipif(sys.platform != "linux", reason="the idle class is Linux's")
def test_a_program_that_calls_monitor_keeps_its_own_priority(tmp_path: Path) -> None:
    """The command itself lowers its priority for good: tests/flights/test_one_link.py."""

    def priority() -> tuple[int, int]:
        return os.sched_getscheduler(0), os.getpriority(os.PRIO_PROCESS, 0)

    before = priority()
    assert main(["monitor", "--log", str(tmp_path / "none.mcap"), "--seconds", "0.1"]) == 2
    assert priority() == before


# --- files with misleading content ----------------------------------------------------------------------


@pytest.mark.parametrize(
    "text", ["version: 1\nwalls:\n\ta: 1\n", "version: 1\n\tname: x\n", "a:\n  b: 1\n \tc: 2\n"]
)
def test_a_tab_in_yaml_is_reported(refusal_of: Refuse, tmp_path: Path, text: str) -> None:
    path = tmp_path / "room.yaml"
    path.write_text(text)
    assert "a tab before the text: indent YAML with spaces" in refusal_of("check", str(path))


@pytest.mark.parametrize(("driver", "given"), [("no", "no"), ("false", "false"), ("~", "null"), ("0", "0")])
def test_a_wrong_word_for_no_driver_is_answered_with_the_allowed_drivers(
    refusal_of: Refuse, tmp_path: Path, driver: str, given: str
) -> None:
    path = tmp_path / "dart.yaml"
    path.write_text(Path(CONFIG).read_text().replace("driver: mock", f"driver: {driver}"))
    output = refusal_of("lock", "status", "--config", str(path))
    drivers = ", ".join(LockDriver)
    assert f"lock.driver: {given!r} is not allowed, only: {drivers}, or none for a vehicle" in output


@pytest.mark.parametrize("command", ["inspect", "identify", "report", "replay"])
@pytest.mark.parametrize(
    ("name", "data", "problem"),
    [
        ("log.ulg.gz", b"\x1f\x8b\x08\x00", "a compressed file: unpack it first"),
        ("log.ulg.zst", b"\x28\xb5\x2f\xfd\x00", "a compressed file: unpack it first"),
        ("log.zip", b"PK\x03\x04", "a compressed file: unpack it first"),
        ("log.ulge", b"ULogEnc\x01", "an encrypted PX4 log: decrypt it first"),
    ],
)
def test_compressed_and_encrypted_logs_are_recognised(
    refusal_of: Refuse, tmp_path: Path, command: str, name: str, data: bytes, problem: str
) -> None:
    (tmp_path / name).write_bytes(data + bytes(40))
    assert problem in refusal_of(command, str(tmp_path / name))


@pytest.mark.parametrize(("given", "written"), [("play", "play.mcap"), ("play.bin", "play.bin")])
def test_an_export_without_a_suffix_gets_the_suffix_of_the_viewer(
    tmp_path: Path, given: str, written: str
) -> None:
    assert _files([Path("flight.mcap")], tmp_path / given) == [tmp_path / written]


@pytest.mark.parametrize(
    ("autopilot", "problem"),
    [(12, None), (3, "ArduPilot"), (0, "a generic autopilot"), (42, "autopilot 42")],
)
def test_an_autopilot_that_is_not_px4_is_named(autopilot: int, problem: str | None) -> None:
    fields = {"autopilot": autopilot, "base_mode": 129, "custom_mode": 6 << 16, "system_status": 4}
    _, value = messages.HEARTBEAT.reader()(msgspec.json.encode(fields).decode(), lambda stamp_us: stamp_us)
    reason = value.reason if isinstance(value, Unusable) else ""
    found = evaluate_autopilot(HeartbeatMode(armed=False, hil=False, not_px4=reason))
    assert [problem in f.message and not f.go for f in found if problem] == [True] * (problem is not None)
    assert bool(found) == (problem is not None)


@pytest.mark.parametrize(
    ("data", "line"),
    [
        (b"\r\nDebian GNU/Linux 12 dart ttyAMA0\r\n\r\ndart login: ", "dart login:"),
        (b"\r\nnsh> \x1b[K", "nsh>"),
        (b"", ""),
        (b"\xfd\x1c\x00\x00\x80\x01", ""),
        (b"\r\n", ""),
    ],
)
def test_a_serial_console_is_distinguished_from_noise(data: bytes, line: str) -> None:
    assert console_line(data) == line


def test_two_plans_of_one_name_are_refused_with_their_difference(
    flown: SharedFlights, refusal_of: Refuse, tmp_path: Path
) -> None:
    logs = []
    for speed in (-0.8, -1.0):
        mission = load_mission(MISSION).replace({"collisions[0].approach.normal_m_s": speed})
        logs.append(tmp_path / f"{speed}.mcap")
        log = FlightLog(logs[-1], describe_flight(mission, World.FAST, 1))
        for entry in read_log(flown("paper_single_wall", 1).log).entries[:2000]:
            log.put(entry.record, entry.number)
        log.close()
    line = refusal_of("report", *logs, "-o", tmp_path / "x.html")
    assert "the names agree, but collisions[0].approach.normal_m_s is -" in line
