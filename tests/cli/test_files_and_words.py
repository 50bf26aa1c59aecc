"""Files that are found, words that are said: what a newcomer stumbles over."""

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

ROOT = Path(__file__).resolve().parents[2]
SINGLE = dart_flight.packaged("missions", "single_wall.yaml")
NO_LOCK = dart_flight.packaged("missions", "rigid_cage", "single_wall.yaml")


# --- which configuration --------------------------------------------------------------------------------


def two_configurations(folder: Path) -> None:
    (folder / "configs").mkdir()
    text = dart_flight.packaged("configs", "dart.yaml").read_text(encoding="utf-8")
    (folder / "configs" / "base.yaml").write_text(text, encoding="utf-8")
    mine = "extends: base.yaml\nairframe:\n  mass_kg: 1.05\n"
    (folder / "configs" / "mine.yaml").write_text(mine, encoding="utf-8")


def test_of_a_base_and_what_extends_it_the_latter_is_taken(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    two_configurations(tmp_path)
    monkeypatch.chdir(tmp_path)
    monkeypatch.delenv("DART_FLIGHT_CONFIG", raising=False)
    found = find_vehicle()
    assert (found.source.source, found.config.airframe.mass_kg) == ("configs/mine.yaml", 1.05)
    (tmp_path / "configs" / "other.yaml").write_text("extends: base.yaml\n", encoding="utf-8")
    with pytest.raises(dart_flight.InputError, match="several vehicles"):  # not to be guessed
        find_vehicle()


def test_a_packaged_file_that_does_not_exist_is_named() -> None:
    with pytest.raises(
        dart_flight.InputError, match=r"missions/single_wal.yaml: .*did you mean single_wall.yaml"
    ):
        dart_flight.packaged("missions", "single_wal.yaml")
    with pytest.raises(dart_flight.InputError, match="packaged folders: configs, missions"):
        dart_flight.packaged("mission", "single_wall.yaml")


# --- words -----------------------------------------------------------------------------------------------


def test_the_program_alone_prints_its_help(capsys: pytest.CaptureFixture[str]) -> None:
    assert main([]) == 0
    assert "dry-run" in capsys.readouterr().out


@pytest.mark.parametrize("command", ["report", "identify", "replay", "tables"])
def test_an_interrupt_is_said_and_130(
    command: str, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    def interrupted(arguments: object) -> int:
        raise KeyboardInterrupt

    module = LAB_COMMANDS.get(command, f"dart_flight.cli.{command}_command")
    monkeypatch.setattr(f"{module}.run", interrupted)
    assert main([command, *(["x.mcap"] if command != "tables" else [])]) == 130
    assert capsys.readouterr().err == "interrupted\n"


@pytest.mark.parametrize("seed", ["a", 1.5, -1, True, None, 2**31])
def test_a_seed_that_is_none_is_one_clear_error(seed: object) -> None:
    with pytest.raises(dart_flight.InputError, match="seed: expected a whole number from 0 to 2147483647"):
        dart_flight.simulate(SINGLE, seed=seed)  # type: ignore[arg-type]


def test_lines_of_a_flight_are_in_the_order_of_their_times() -> None:
    out = io.StringIO()
    lines = FlightLines(Console(file=out, width=200))
    zero = (0.0, 0.0, 0.0)
    lines(ImuSample(0, 0, zero, zero))
    lines(PhaseChange(5_020_000, Phase.APPROACH, Phase.CONTACT, "force over threshold", 1))
    lines(ImpactPeak(5_000_000, 5_030_000, 5_030_000, (1.0, 0.0), 20.0, 0.0, zero, False))
    times = [float(line.split()[0]) for line in out.getvalue().splitlines()]
    assert times == [5.02, 5.03]


def test_only_what_is_installed_is_recommended(monkeypatch: pytest.MonkeyPatch) -> None:
    verdict = dart_flight.simulate(SINGLE).verdict
    verdict.log = "flights/x/flight.mcap"
    everything = next_steps(verdict)
    monkeypatch.setattr("dart_flight.cli.flight_output.find_spec", lambda name: None)
    assert [step.split()[1] for step in next_steps(verdict)] == ["replay"]
    assert len(everything) == sum(
        importlib.util.find_spec(name) is not None for name in ("matplotlib", "foxglove", "scipy")
    ) + 1  # fmt: skip


def test_a_dry_run_installs_what_it_needs_and_names_what_installs_the_rest(tmp_path: Path) -> None:
    done = make("dry-run", tmp_path)
    (install,) = (line for line in done if "pip install" in line)
    assert "-e '.[sim]'" in install
    assert "--quiet" not in install
    assert any("`make install`" in line.replace("\\", "") for line in done)


def make(target: str, folder: Path) -> list[str]:
    """What `make` would run in a checkout without a virtual environment."""
    words = ["make", "-n", f"VENV={folder}/venv", target]
    return subprocess.run(words, cwd=ROOT, capture_output=True, text=True, check=True).stdout.splitlines()


def test_the_advice_installs_every_extra_with_the_pinned_versions(tmp_path: Path) -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["optional-dependencies"]
    assert project["full"] == [f"dart-flight[{','.join(IN_FULL)}]"]
    (install,) = (line for line in make("install", tmp_path) if "pip install" in line)
    assert "-c constraints.txt -e '.[full]'" in install
    for extra in [name for name in project if name not in ("dev", "full")]:
        says = install_command(extra, tmp_path)  # an installed wheel has no Makefile
        assert says.endswith(f"-m pip install -c constraints.txt '.[{extra}]' in the checkout of dart-flight")
        says = install_command(extra)
        assert says.endswith("install") if "make" in says else "-c constraints.txt -e" in says


def test_the_advice_is_one_place_and_its_bracket_is_printed() -> None:
    advised = [path for path in (ROOT / "dart_flight").rglob("*.py") if "pip install" in path.read_text()]
    assert {path.name for path in advised} == {"packages.py", "limit_switch.py"}  # gpiod is no extra of ours


def test_a_plan_without_ruckig_prints_the_advice_whole(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "ruckig", None)
    monkeypatch.setattr(
        "dart_flight.lab.search.plan_table.install_command", lambda extra: install_command(extra, tmp_path)
    )
    scenario = str(ROOT / "missions" / "scenarios" / "one_wall.yaml")
    assert main(["plan", scenario, "-o", str(tmp_path / "planned.yaml")]) == 0
    assert ".[plan]" in "".join(capsys.readouterr().out.split())


# --- missions --------------------------------------------------------------------------------------------


def with_impact(tmp_path: Path, keys: str) -> Path:
    text = SINGLE.read_text(encoding="utf-8").replace("../configs", str(ROOT / "configs"))
    changed = re.sub(r"(approach: \{[^}]*\},)", rf"\1 {keys},", text, count=1)
    assert changed != text
    path = tmp_path / "mission.yaml"
    path.write_text(changed, encoding="utf-8")
    return path


def test_a_point_beside_the_wall_is_told_with_the_nearest_on_it(tmp_path: Path) -> None:
    wall = load_mission(SINGLE).collisions[0].wall
    on_it = wall.foot(load_mission(SINGLE).collisions[0].impact_point or (0.0, 0.0))
    x, y = on_it[0] + 0.014 * wall.normal[0], on_it[1] + 0.014 * wall.normal[1]
    with pytest.raises(dart_flight.InputError, match=r"0\.014 m off wall") as caught:
        load_mission(with_impact(tmp_path, f"impact_point_m: [{x}, {y}]"))
    said = re.search(r"nearest point is \[(.+), (.+)\]; or give impact_along_m: (.+)$", str(caught.value))
    assert said is not None
    assert (float(said[1]), float(said[2])) == pytest.approx(on_it, abs=6e-4)
    along = load_mission(with_impact(tmp_path, f"impact_along_m: {said[3]}")).collisions[0].impact_point
    assert along == pytest.approx(on_it, abs=6e-4)


@pytest.mark.parametrize(
    ("keys", "said"),
    [
        ("impact_along_m: 99.0", "the wall, which extends from"),
        ("impact_along_m: 0.1, impact_point_m: [0, 0]", "not both"),
    ],
)
def test_a_distance_along_the_wall_is_on_it(keys: str, said: str, tmp_path: Path) -> None:
    with pytest.raises(dart_flight.InputError, match=said):
        load_mission(with_impact(tmp_path, keys))


# --- pages and folders -----------------------------------------------------------------------------------


def test_a_campaign_does_not_scatter_files_among_others(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = tmp_path / "missions"
    folder.mkdir()
    (folder / "mine.yaml").write_text("version: 1\n", encoding="utf-8")
    assert main(["campaign", str(SINGLE), "--runs", "1", "--out", str(folder)]) == 2
    assert "the folder is not empty; choose a new folder" in capsys.readouterr().err
    assert [path.name for path in folder.iterdir()] == ["mine.yaml"]


@pytest.mark.parametrize(("mission", "has_lock"), [(SINGLE, True), (NO_LOCK, False)])
def test_the_animation_of_a_vehicle_without_a_lock_shows_none(
    mission: Path, has_lock: bool, tmp_path: Path
) -> None:
    dart_flight.simulate(mission, log_dir=tmp_path)
    data = player_data(RecordedFlight.read(next(tmp_path.glob("*/flight.mcap"))))
    assert data is not None
    assert data["hasLock"] is has_lock
    player = (ROOT / "dart_flight" / "lab" / "report" / "player.js").read_text(encoding="utf-8")
    shows = [line for line in player.splitlines() if '"lock' in line and "setAttribute" not in line]
    assert all("D.hasLock" in line for line in shows)


def test_a_package_that_is_there_and_does_not_load_is_not_called_missing() -> None:
    for error, says in (
        (ImportError("libopenblas.so.0: cannot open"), "needs SciPy, but it does not load: libopenblas.so.0"),
        (ModuleNotFoundError("No module named 'scipy'"), "needs SciPy: "),
    ):
        try:
            raise error
        except ImportError:
            assert missing_package("needs SciPy", "identify").message.startswith(says)
