"""Files, messages and advice that a new user meets first."""

from __future__ import annotations

import importlib.util
import io
import re
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest
from rich.console import Console

import dart_flight
from dart_flight.base.records import ImpactPeak, ImuSample, Phase, PhaseChange
from dart_flight.cli import main
from dart_flight.cli.flight_output import FlightLines, next_steps
from dart_flight.config.mission import load_mission
from dart_flight.config.packages import IN_FULL, install_command, missing_package
from dart_flight.config.provenance import find_vehicle
from dart_flight.lab.report.player import player_data
from dart_flight.lab.report.recorded_flight import RecordedFlight
from dart_flight.lab_entries import COMMANDS as LAB_COMMANDS
from tests.command_fixtures import Refuse
from tests.shared_flights import SharedFlights

ROOT = Path(__file__).resolve().parents[2]
SINGLE = dart_flight.packaged("missions", "single_wall.yaml")


# --- choice of the configuration --------------------------------------------------------------------------


def test_an_extending_configuration_is_preferred_to_its_base(folder: Path) -> None:
    (folder / "configs").mkdir()
    text = dart_flight.packaged("configs", "dart.yaml").read_text(encoding="utf-8")
    (folder / "configs" / "base.yaml").write_text(text, encoding="utf-8")
    mine = "extends: base.yaml\nairframe:\n  mass_kg: 1.05\n"
    (folder / "configs" / "mine.yaml").write_text(mine, encoding="utf-8")
    found = find_vehicle()
    assert (found.source.source, found.config.airframe.mass_kg) == ("configs/mine.yaml", 1.05)
    (folder / "configs" / "other.yaml").write_text("extends: base.yaml\n", encoding="utf-8")
    with pytest.raises(dart_flight.InputError, match="several vehicles"):  # the choice is not guessed
        find_vehicle()


def test_a_packaged_file_that_does_not_exist_is_named() -> None:
    with pytest.raises(
        dart_flight.InputError, match=r"missions/single_wal.yaml: .*did you mean single_wall.yaml"
    ):
        dart_flight.packaged("missions", "single_wal.yaml")
    with pytest.raises(dart_flight.InputError, match="packaged folders: configs, missions"):
        dart_flight.packaged("mission", "single_wall.yaml")


# --- messages and advice ---------------------------------------------------------------------------------


def test_the_program_without_arguments_prints_its_help(capsys: pytest.CaptureFixture[str]) -> None:
    assert main([]) == 0
    assert "dry-run" in capsys.readouterr().out


@pytest.mark.parametrize("command", ["report", "identify", "replay", "tables"])
def test_an_interrupt_is_reported_with_exit_status_130(
    command: str, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    def interrupted(arguments: object) -> int:
        raise KeyboardInterrupt

    module = LAB_COMMANDS.get(command, f"dart_flight.cli.{command}_command")
    monkeypatch.setattr(f"{module}.run", interrupted)
    assert main([command, *(["x.mcap"] if command != "tables" else [])]) == 130
    assert capsys.readouterr().err == "interrupted\n"


@pytest.mark.parametrize("seed", ["a", 1.5, -1, True, None, 2**31])
def test_an_invalid_seed_is_refused(seed: object) -> None:
    with pytest.raises(dart_flight.InputError, match="seed: expected a whole number from 0 to 2147483647"):
        dart_flight.simulate(SINGLE, seed=seed)  # type: ignore[arg-type]


def test_lines_of_a_flight_are_in_order_of_time() -> None:
    out = io.StringIO()
    lines = FlightLines(Console(file=out, width=200))
    zero = (0.0, 0.0, 0.0)
    lines(ImuSample(0, 0, zero, zero))
    lines(PhaseChange(5_020_000, Phase.APPROACH, Phase.CONTACT, "force over threshold", 1))
    lines(ImpactPeak(5_000_000, 5_030_000, 5_030_000, (1.0, 0.0), 20.0, 0.0, zero, False))
    times = [float(line.split()[0]) for line in out.getvalue().splitlines()]
    assert times == [5.02, 5.03]


def test_only_commands_with_installed_packages_are_recommended(
    flown: SharedFlights, monkeypatch: pytest.MonkeyPatch
) -> None:
    verdict = flown("paper_single_wall", 1).verdict
    assert verdict.log is not None
    everything = next_steps(verdict)
    monkeypatch.setattr("dart_flight.cli.flight_output.find_spec", lambda name: None)
    assert [step.split()[1] for step in next_steps(verdict)] == ["replay"]
    assert len(everything) == sum(
        importlib.util.find_spec(name) is not None for name in ("matplotlib", "foxglove", "scipy")
    ) + 1  # fmt: skip


def test_make_dry_run_installs_only_its_packages_and_names_make_install(tmp_path: Path) -> None:
    done = make("dry-run", tmp_path)
    (install,) = (line for line in done if "pip install" in line)
    assert "-e '.[sim]'" in install
    assert "--quiet" not in install
    assert any("`make install`" in line.replace("\\", "") for line in done)


def make(target: str, folder: Path) -> list[str]:
    """Return the commands of a target of `make` in a checkout without a virtual environment."""
    words = ["make", "-n", f"VENV={folder}/venv", target]
    return subprocess.run(words, cwd=ROOT, capture_output=True, text=True, check=True).stdout.splitlines()


def test_the_install_advice_covers_every_extra_with_pinned_versions(tmp_path: Path) -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["optional-dependencies"]
    assert project["full"] == [f"dart-flight[{','.join(IN_FULL)}]"]
    (install,) = (line for line in make("install", tmp_path) if "pip install" in line)
    assert "-c constraints.txt -e '.[full]'" in install
    for extra in [name for name in project if name not in ("dev", "full")]:
        advice = install_command(extra, tmp_path)  # as in a wheel, which has no Makefile
        assert advice.endswith(
            f"-m pip install -c constraints.txt '.[{extra}]' in the checkout of dart-flight"
        )
        advice = install_command(extra)
        assert advice.endswith("install") if "make" in advice else "-c constraints.txt -e" in advice


def test_the_install_advice_is_written_in_one_place() -> None:
    advised = [path for path in (ROOT / "dart_flight").rglob("*.py") if "pip install" in path.read_text()]
    assert {path.name for path in advised} == {
        "packages.py",
        "limit_switch.py",
    }  # gpiod is not an extra of this project


def test_a_plan_without_ruckig_prints_the_complete_install_advice(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "ruckig", None)
    scenario = str(ROOT / "missions" / "scenarios" / "one_wall.yaml")
    assert main(["plan", scenario, "-o", str(tmp_path / "planned.yaml"), "--no-verify"]) == 0
    assert "".join(install_command("plan").split()) in "".join(capsys.readouterr().out.split())


def test_the_advice_on_the_raspberry_pi_names_the_python_that_has_ruckig(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    pytest.importorskip("casadi", reason="casadi is not installed (extra `plan`)")
    monkeypatch.setattr("platform.machine", lambda: "aarch64")
    monkeypatch.setattr(sys, "version_info", (3, 13, 0))
    assert install_command("plan").endswith("use Python 3.12 or 3.11")
    monkeypatch.setattr(sys, "version_info", (3, 12, 0))
    assert "Python 3.12" not in install_command("plan")


# --- missions --------------------------------------------------------------------------------------------


def mission_with_impact(tmp_path: Path, keys: str) -> Path:
    text = SINGLE.read_text(encoding="utf-8").replace("../configs", str(ROOT / "configs"))
    changed = re.sub(r"(approach: \{[^}]*\},)", rf"\1 {keys},", text, count=1)
    assert changed != text
    path = tmp_path / "mission.yaml"
    path.write_text(changed, encoding="utf-8")
    return path


def test_an_impact_point_off_the_wall_is_refused_with_the_nearest_point(tmp_path: Path) -> None:
    wall = load_mission(SINGLE).collisions[0].wall
    nearest = wall.foot(load_mission(SINGLE).collisions[0].impact_point or (0.0, 0.0))
    x, y = nearest[0] + 0.014 * wall.normal[0], nearest[1] + 0.014 * wall.normal[1]
    with pytest.raises(dart_flight.InputError, match=r"0\.014 m off wall") as caught:
        load_mission(mission_with_impact(tmp_path, f"impact_point_m: [{x}, {y}]"))
    suggested = re.search(
        r"nearest point is \[(.+), (.+)\]; or give impact_along_m: (.+)$", str(caught.value)
    )
    assert suggested is not None
    assert (float(suggested[1]), float(suggested[2])) == pytest.approx(nearest, abs=6e-4)
    path = mission_with_impact(tmp_path, f"impact_along_m: {suggested[3]}")
    assert load_mission(path).collisions[0].impact_point == pytest.approx(nearest, abs=6e-4)


@pytest.mark.parametrize(
    ("keys", "problem"),
    [
        ("impact_along_m: 99.0", "the wall, which extends from"),
        ("impact_along_m: 0.1, impact_point_m: [0, 0]", "not both"),
    ],
)
def test_an_invalid_impact_distance_along_the_wall_is_refused(
    keys: str, problem: str, tmp_path: Path
) -> None:
    with pytest.raises(dart_flight.InputError, match=problem):
        load_mission(mission_with_impact(tmp_path, keys))


# --- pages and folders -----------------------------------------------------------------------------------


def test_a_campaign_refuses_a_folder_that_is_not_empty(tmp_path: Path, refusal_of: Refuse) -> None:
    (tmp_path / "mine.yaml").write_text("version: 1\n", encoding="utf-8")
    line = refusal_of("campaign", SINGLE, "--runs", "1", "--out", tmp_path)
    assert "the folder is not empty; choose a new folder" in line
    assert [path.name for path in tmp_path.iterdir()] == ["mine.yaml"]


@pytest.mark.rest
@pytest.mark.parametrize(("mission", "has_lock"), [("single_wall", True), ("rigid_cage/single_wall", False)])
def test_the_animation_shows_a_lock_only_if_the_vehicle_has_one(
    mission: str, has_lock: bool, flown: SharedFlights
) -> None:
    data = player_data(RecordedFlight.read(flown(mission, 1).log))
    assert data is not None
    assert data["hasLock"] is has_lock
    player = (ROOT / "dart_flight" / "lab" / "report" / "player.js").read_text(encoding="utf-8")
    shows = [line for line in player.splitlines() if '"lock' in line and "setAttribute" not in line]
    assert all("D.hasLock" in line for line in shows)


@pytest.mark.parametrize(
    ("error", "beginning"),
    [
        (ImportError("libopenblas.so.0: cannot open"), "needs SciPy, but it does not load: libopenblas.so.0"),
        (ModuleNotFoundError("No module named 'scipy'"), "needs SciPy: "),
    ],
)
def test_a_package_that_does_not_load_is_not_reported_as_missing(error: Exception, beginning: str) -> None:
    try:
        raise error
    except ImportError:
        assert missing_package("needs SciPy", "identify").message.startswith(beginning)
