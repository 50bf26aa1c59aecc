"""`dart-flight inspect` on difficult logs: fast flight, crashes, other vehicles, damaged files."""

from __future__ import annotations

import contextlib
import io
import json
import math
import struct
from pathlib import Path
from typing import Any

import pytest

from dart_flight.cli import main
from tests.doubles.ulog_file import Topics, write_ulog
from tests.lab.inspect.test_inspect import END_S, HIT_S, inspect_json, topics

pytest.importorskip("pyulog")

BEGIN_US = 1e6
FALL_S, GROUND_S, RELEASE = END_S - 7.0, END_S - 5.6, 0x010E00FF


def with_status(
    base: Topics, armed: bool = True, kind: int = 2, vehicle: int = 1, vtol: bool = False
) -> Topics:
    """Add the vehicle's type and arming state as PX4 reports them."""
    rows = [(BEGIN_US + 5e5 * i, [2 if armed else 1, kind, vehicle, vtol]) for i in range(90)]
    fields = "uint8_t arming_state;uint8_t system_type;uint8_t vehicle_type;bool is_vtol;"
    return {**base, ("vehicle_status", 0): (fields, rows)}


def crash_topics() -> Topics:
    """Return a motor failure in the air; PX4 reports landed for 0.14 s there, and again after the crash."""
    changed = dict(with_status(topics()))
    fields, rows = changed["sensor_combined", 0]
    new = []
    for stamp, v in rows:
        t = (stamp - BEGIN_US) * 1e-6
        if FALL_S <= t < GROUND_S:
            v = [*v[:3], *(0.3 * x for x in v[3:5]), -2.0 - 4.0 * (t - FALL_S)]
        elif GROUND_S <= t < GROUND_S + 0.05:
            v = [*v[:3], 30.0, -20.0, -300.0 * math.sin(math.pi * (t - GROUND_S) / 0.05)]
        new.append((stamp, v))
    changed["sensor_combined", 0] = fields, new
    fields, rows = changed["vehicle_local_position", 0]
    changed["vehicle_local_position", 0] = (fields, [(s, [0.0, 0.0, 5.0 * v[2], *v[3:]]) for s, v in rows])
    states = [(0.0, True), (2.0, False), (FALL_S, True), (FALL_S + 0.14, False), (END_S - 2.0, True)]
    changed["vehicle_land_detected", 0] = ("bool landed;", [(BEGIN_US + 1e6 * t, [s]) for t, s in states])
    return changed


def refusal(path: Path, capsys: pytest.CaptureFixture[str]) -> str:
    assert main(["inspect", str(path), "--json"]) == 2
    out, err = capsys.readouterr()
    assert (out, err.count("\n")) == ("", 1)
    return err


def test_a_crash_is_found_although_px4_reported_landed_in_the_air(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    flight = inspect_json(
        write_ulog(tmp_path / "a.ulg", crash_topics(), release=RELEASE), capsys, "--mass", "2.0"
    )
    last = [i for i in flight["impacts"] if i["t_s"] > HIT_S + 1.0]
    assert [i["kind"] for i in last] == ["crash"]
    assert last[0]["t_s"] == pytest.approx(GROUND_S, abs=0.05)
    assert last[0]["acceleration_m_s2"] == pytest.approx(300.0, rel=0.1)
    assert last[0]["force_n"] == pytest.approx(2.0 * last[0]["acceleration_m_s2"])


def test_crossings_in_fast_flight_are_untold_if_the_thrust_fit_is_refused(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    changed = dict(topics(north_m_s=12.0))
    fields, rows = changed["actuator_motors", 0]
    wrong = [(t, [0.5 + 0.25 * math.sin(0.17 * (t - 1e6) * 1e-6)] * 4) for t, _ in rows]
    changed["actuator_motors", 0] = fields, wrong
    flight = inspect_json(write_ulog(tmp_path / "a.ulg", changed), capsys)
    assert flight["thrust"] is None
    assert {i["kind"] for i in flight["impacts"]} == {"untold"}
    assert flight["untold"] == len(flight["impacts"]) > 0


@pytest.mark.rest
@pytest.mark.parametrize(("motor_hz", "kind"), [(10.0, "untold"), (25.0, "impact")])
def test_crossings_in_fast_flight_are_untold_between_slow_motor_outputs(
    motor_hz: float, kind: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    changed = topics(motor_hz=motor_hz, north_m_s=6.0)
    flight = inspect_json(write_ulog(tmp_path / "fast.ulg", changed), capsys)
    assert flight["thrust"] is not None
    assert [i["kind"] for i in flight["impacts"]] == [kind]
    gaps = [what for what in flight["unknown"] if "motor outputs are logged at less than" in what]
    assert len(gaps) == (kind == "untold")
    slow = inspect_json(write_ulog(tmp_path / "slow.ulg", topics(motor_hz=motor_hz)), capsys)
    assert [i["kind"] for i in slow["impacts"]] == ["impact"]


def test_crossings_in_fast_flight_are_untold_where_motor_outputs_are_missing(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    changed = dict(topics(north_m_s=6.0))
    fields, rows = changed["actuator_motors", 0]
    for lost_s, kind in ((HIT_S, "untold"), (HIT_S - 5.0, "impact")):
        kept = [(t, v) for t, v in rows if not 0.0 <= (t - BEGIN_US) * 1e-6 - lost_s <= 0.2]
        changed["actuator_motors", 0] = fields, kept
        flight = inspect_json(write_ulog(tmp_path / "a.ulg", changed), capsys)
        assert [i["kind"] for i in flight["impacts"]] == [kind]


def test_a_log_that_begins_in_the_air_is_inspected_from_its_beginning(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    changed = dict(with_status(topics()))
    changed["vehicle_land_detected", 0] = (
        "bool landed;",
        [(BEGIN_US + 1.1e6 + 2e6 * i, [False]) for i in range(12)],
    )
    fields, rows = changed["vehicle_local_position", 0]
    changed["vehicle_local_position", 0] = (fields, [(t, [0.0, 0.0, -30.0, *v[3:]]) for t, v in rows])
    flight = inspect_json(write_ulog(tmp_path / "a.ulg", changed), capsys)
    assert flight["flight_s"] == pytest.approx(END_S, abs=0.1)
    assert [round(i["t_s"]) for i in flight["impacts"]] == [round(HIT_S)]


def test_every_impact_has_its_standard_deviation(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (impact,) = inspect_json(write_ulog(tmp_path / "a.ulg", topics()), capsys, "--mass", "2.0")["impacts"]
    assert impact["force_sd_n"] == pytest.approx(2.0 * impact["acceleration_sd_m_s2"])
    assert 0.05 * impact["force_n"] < impact["force_sd_n"] < 0.25 * impact["force_n"]
    (impact,) = inspect_json(write_ulog(tmp_path / "b.ulg", topics()), capsys)["impacts"]
    assert impact["force_sd_n"] is None


@pytest.mark.parametrize(
    ("message", "release", "status"),
    [
        ("of a VTOL: only multicopters", RELEASE, {"vtol": True}),
        ("of a VTOL: only multicopters", RELEASE, {"kind": 22}),
        ("of a plane: only multicopters", RELEASE, {"kind": 1}),
        ("of a plane: only multicopters", RELEASE, {"vehicle": 2}),
        ("of a rover: only multicopters", RELEASE, {"kind": 10}),
        ("never armed", RELEASE, {"armed": False}),
        ("log of PX4 1.6.5: only 1.9 and later are supported", 0x010605FF, {}),
    ],
)
def test_logs_of_other_vehicles_versions_and_unarmed_logs_are_refused(
    message: str, release: int, status: dict[str, Any], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    changed = with_status(topics(motor_hz=10.0), **status)
    assert message in refusal(write_ulog(tmp_path / "a.ulg", changed, release=release), capsys)


def test_a_plane_is_recognised_by_its_parameter(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = write_ulog(tmp_path / "a.ulg", topics(motor_hz=10.0), {"MAV_TYPE": 1.0})
    assert "of a plane" in refusal(path, capsys)


def test_accelerometer_intervals_in_seconds_are_accepted(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    changed = dict(topics())
    fields, rows = changed["sensor_combined", 0]
    changed["sensor_combined", 0] = (
        fields + "float accelerometer_integral_dt;",
        [(t, [*v, 0.004]) for t, v in rows],
    )
    assert len(inspect_json(write_ulog(tmp_path / "a.ulg", changed), capsys)["impacts"]) == 1


def write_damaged_log(path: Path, topic: str, place: int, at_s: float, value: float) -> Path:
    """Write a log with one value replaced as by a flipped bit; place -1 is the timestamp."""
    changed = dict(topics())
    fields, rows = changed[topic, 0]
    i = min(range(len(rows)), key=lambda k: abs(rows[k][0] - BEGIN_US - 1e6 * at_s))
    stamp, values = rows[i]
    if place < 0:
        number = list(changed).index((topic, 0))
        old_bytes, new_bytes = (struct.pack("<HQ", number, int(t)) for t in (stamp, value))
        path.write_bytes(write_ulog(path, changed).read_bytes().replace(old_bytes, new_bytes, 1))
        return path
    changed[topic, 0] = (
        fields,
        [*rows[:i], (stamp, [*values[:place], value, *values[place + 1 :]]), *rows[i + 1 :]],
    )
    return write_ulog(path, changed)


@pytest.mark.parametrize(
    ("topic", "place", "value"),
    [
        ("sensor_combined", 3, 1.2e7),
        pytest.param("sensor_combined", 5, -3.3e38, marks=pytest.mark.rest),
        ("sensor_combined", 1, 1.5e9),
        pytest.param("sensor_combined", -1, 2.0**52, marks=pytest.mark.rest),
        ("sensor_combined", -1, 17.0),
        ("vehicle_attitude", 0, 1.8e19),
        pytest.param("vehicle_local_position", 3, 1e33, marks=pytest.mark.rest),
        ("vehicle_local_position", -1, 2.0**50),
        ("actuator_motors", 2, 7e12),
    ],
)
def test_a_flipped_bit_is_not_an_impact(
    topic: str, place: int, value: float, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    flight = inspect_json(write_damaged_log(tmp_path / "a.ulg", topic, place, 20.0, value), capsys)
    assert [round(i["t_s"]) for i in flight["impacts"]] == [round(HIT_S)]
    assert flight["flight_s"] == pytest.approx(END_S - 4.3, abs=0.1)
    assert f"1 damaged samples of {topic}" in flight["unknown"]


def test_only_json_is_printed_for_a_damaged_log(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = write_ulog(tmp_path / "a.ulg", topics())
    with path.open("ab") as file:
        file.write(struct.pack("<HcHQ", 10, b"D", 4711, 5_000_000))  # data of an unknown topic
    from pyulog import ULog

    with contextlib.redirect_stdout(io.StringIO()) as printed:
        ULog(str(path))
    assert printed.getvalue(), "pyulog prints a warning"
    flight = inspect_json(path, capsys)  # parses standard output
    assert "parts of the file are damaged" in flight["unknown"]


def test_a_refused_log_does_not_end_the_batch(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    good = write_ulog(tmp_path / "good.ulg", topics())
    plane = write_ulog(tmp_path / "plane.ulg", with_status(topics(motor_hz=10.0), kind=1))
    nothing = tmp_path / "nothing.ulg"
    nothing.write_bytes(struct.pack("<Q", 0))
    assert main(["inspect", str(plane), str(good), str(nothing), "--json"]) == 2
    out, err = capsys.readouterr()
    assert [flight["log"] for flight in json.loads(out)] == [str(good)]
    assert [line.partition(":")[0] for line in err.splitlines()] == [str(plane), str(nothing)]


@pytest.mark.parametrize("command", ["replay", "report"])
def test_commands_for_flight_logs_refer_a_ulog_to_the_supporting_commands(
    command: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = write_ulog(tmp_path / "a.ulg", {})
    assert main([command, str(path)]) == 2
    assert (
        "this is a PX4 ULog, which is an input of inspect, identify and calibrate" in capsys.readouterr().err
    )


@pytest.mark.parametrize(
    ("places", "message"),
    [
        ([(1.0, 1.0), (-1.0, -1.0), (1.0, -1.0), (-1.0, 1.0)], "placeholder"),
        ([(0.1, 0.0)], "not a multicopter"),
    ],
)
def test_a_placeholder_geometry_is_not_used(
    places: list[tuple[float, float]], message: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    parameters = {"CA_ROTOR_COUNT": float(len(places))}
    for i, (x, y) in enumerate(places):
        parameters |= {f"CA_ROTOR{i}_PX": x, f"CA_ROTOR{i}_PY": y, f"CA_ROTOR{i}_KM": 0.05}
    path = write_ulog(tmp_path / "a.ulg", {}, parameters)
    assert main(["calibrate", "airframe", str(path)]) == 2
    out, err = capsys.readouterr()
    assert out == ""
    assert message in err
