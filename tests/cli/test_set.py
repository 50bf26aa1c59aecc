"""`--set KEY=VALUE`: commands that use a vehicle apply it, report it and refuse invalid settings."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from dart_flight.cli import main
from dart_flight.config.vehicle import packaged
from dart_flight.sim import standalone
from tests.command_fixtures import Refuse, RunJson

pytestmark = pytest.mark.usefixtures("folder")

MISSION = str(packaged("missions", "paper_single_wall.yaml"))
SCENARIO = str(packaged("missions", "scenarios", "one_wall.yaml"))
PREDICT = ["predict", "--surface", "acrylic", "--mode", "rigid", "--velocity", "-1", "0"]
COMMANDS = {
    "predict": PREDICT,
    "plan": ["plan", SCENARIO, "--top", "1"],
    "check": ["check", MISSION],
    "dry-run": ["dry-run", MISSION, "--fast"],
    "simulate": ["simulate", MISSION],
}


@pytest.mark.parametrize("name", ["predict", "plan", "check"])
def test_settings_are_reported_with_the_vehicle(name: str, run_json: RunJson) -> None:
    printed, errors = run_json(*COMMANDS[name], "--set", "airframe.mass_kg=1.5")
    assert printed["vehicle"]["set"] == ["airframe.mass_kg=1.5"]
    assert printed["vehicle"]["mass_kg"] == 1.5
    assert "1.5 kg, with airframe.mass_kg=1.5" in errors
    plain, errors = run_json(*COMMANDS[name])
    assert "set" not in plain["vehicle"]
    assert ", with" not in errors
    assert plain != printed


def test_identify_uses_the_mass_that_was_set(folder: Path, run_json: RunJson) -> None:
    """The estimate of k is proportional to the mass."""
    trial = folder / "trial.csv"
    lines = ["time_s,normal_m"]
    x, v, h = 0.02, -1.0, 1e-4
    for step in range(1000):
        if step % 20 == 0:
            lines.append(f"{step * h:.4f},{x:.9f}")
        force = max(0.0, -(4000.0 * x + 15.0 * v))
        v += h * force / 1.3
        x += h * v
    trial.write_text("\n".join(lines) + "\n")
    command = ["identify", str(trial), "--mode", "rigid"]
    light, _ = run_json(*command)
    heavy, errors = run_json(*command, "--set", "airframe.mass_kg=1.95")
    k = [found["coefficients"]["rigid"]["k"]["value"] for found in (light, heavy)]
    assert k[1] == pytest.approx(1.5 * k[0], rel=0.02)
    assert heavy["vehicle"]["set"] == ["airframe.mass_kg=1.95"]
    assert "with airframe.mass_kg=1.95" in errors


def test_simulate_uses_the_mass_that_was_set(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    flown: list[Any] = []
    run: Callable[..., None] = lambda vehicle, *rest: flown.append(vehicle)  # noqa: E731
    monkeypatch.setattr(standalone, "run_vehicle", run)
    monkeypatch.setattr(
        standalone.VehiclePortLease, "__init__", lambda self, port: setattr(self, "own_port", port)
    )
    monkeypatch.setattr(standalone.VehiclePortLease, "release", lambda self: None)
    assert main([*COMMANDS["simulate"], "--set", "airframe.mass_kg=1.5"]) == 0
    assert flown[0].autopilot.plant.mass == 1.5
    assert "with airframe.mass_kg=1.5" in capsys.readouterr().err


WRONG = {
    "airframe.mas_kg=2": "unknown key, did you mean mass_kg?",
    "airfame.mass_kg=2": "unknown key 'airfame', did you mean airframe?",
    "simulation.contct.body=guards": "did you mean contact?",
    "airframe.mass_kg=heavy": "expected a number, got text",
    "airframe.mass_kg=-2": "not -2",
    "airframe.inertia_kg_m2=[1, 2]": "expected a list of length 3",
    "materials.stone.rigid.k=2": "missing key",
    "simulation.contact.body=ball": "only: point, guards",
    "airframe.mass_kg": "expected KEY=VALUE",
}


@pytest.mark.parametrize("setting", WRONG)
def test_an_invalid_setting_is_refused_in_one_line(setting: str, refusal_of: Refuse) -> None:
    line = refusal_of(*PREDICT, "--set", setting)
    assert line.startswith(f"--set {setting.partition('=')[0]}")
    assert WRONG[setting] in line


@pytest.mark.parametrize("name", [name for name in COMMANDS if name != "predict"])
def test_every_command_refuses_an_unknown_key_with_the_same_line(name: str, refusal_of: Refuse) -> None:
    line = refusal_of(*COMMANDS[name], "--set", "airframe.mas_kg=2")
    assert line == "--set airframe.mas_kg=2: unknown key, did you mean mass_kg?"


def test_a_section_that_the_file_omits_can_be_set(run_json: RunJson) -> None:
    text = packaged("configs", "dart.yaml").read_text()
    begin, end = text.index("  contact:    "), text.index("  imu_ringing: ")
    Path("old.yaml").write_text(text[:begin] + text[end:])
    settings = ["--set", "simulation.contact.body=guards", "--set", "simulation.imu_ringing.tone_m_s2=3"]
    printed, _ = run_json(*PREDICT, "--config", "old.yaml", *settings)
    assert printed["vehicle"]["set"] == settings[1::2]


def test_set_is_refused_with_restitution(refusal_of: Refuse) -> None:
    words = ["predict", "--restitution", "0.5", "--velocity", "-1", "0", "--set", "airframe.mass_kg=2"]
    assert "--restitution cannot be combined with --set" in refusal_of(*words)
