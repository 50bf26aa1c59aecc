"""`init` gives a folder that works by itself; `completion` a script that the shell takes."""

from __future__ import annotations

import json
import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from dart_flight.cli import COMMANDS, main
from dart_flight.config.document import Document
from dart_flight.config.file_kinds import EXTENDS
from dart_flight.config.mission import load_mission
from dart_flight.config.parameter_file import load_parameters
from dart_flight.config.starter import DART, VEHICLES
from dart_flight.config.vehicle import default_config_path
from dart_flight.config.vehicle.configuration import load_vehicle
from dart_flight.lab.search.scenario import load_scenario
from dart_flight.run.fast import fly_fast
from tests.mission_findings import check_mission

ROOT = Path(__file__).resolve().parents[2]


@pytest.fixture
def started(tmp_path: Path) -> Path:
    folder = tmp_path / "lab"
    assert main(["init", str(folder)]) == 0
    return folder


def test_everything_that_is_shipped_is_copied_unchanged_for_one_vehicle_or_another(tmp_path: Path) -> None:
    for name in VEHICLES:
        assert main(["init", str(tmp_path / name), "--vehicle", name]) == 0
    for wanted in ("configs/**/*.yaml", "configs/**/*.params", "missions/**/*.yaml", "docs/schemas/*.json"):
        files = sorted(ROOT.glob(wanted))
        assert files
        for path in files:
            copies = [tmp_path / name / path.relative_to(ROOT) for name in VEHICLES]
            there = [copy for copy in copies if copy.exists()]
            assert there, path
            everybodys = path.suffix != ".yaml" or path.name == "dart.yaml"  # which the others extend
            assert len(there) == (len(VEHICLES) if everybodys else 1)
            assert {copy.read_bytes() for copy in there} == {path.read_bytes()}


@pytest.mark.parametrize("name", [name for name in VEHICLES if name != DART])
def test_another_vehicle_starts_with_two_commands_that_work(
    name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = tmp_path / "lab"
    assert main(["init", str(folder), "--vehicle", name]) == 0
    said = capsys.readouterr().err.splitlines()
    commands = [line.split()[1:] for line in said if line.startswith("  dart-flight ")]
    assert [words[0] for words in commands] == ["check", "dry-run"]
    monkeypatch.chdir(folder)
    monkeypatch.delenv("DART_FLIGHT_CONFIG", raising=False)
    for words in commands:
        assert main(words) == 0
    # DART's lies there too, below it: commands without a mission take the one that is meant.
    assert default_config_path() == Path(f"configs/{name}.yaml")
    vehicle = load_vehicle()
    assert not vehicle.has_lock
    assert {path.stem for path in (folder / "missions").rglob("*.yaml")} == {"single_wall", "square"}
    for path in (folder / "missions").rglob("*.yaml"):
        mission = load_mission(path)
        assert mission.vehicle == vehicle
        assert all(finding.go for finding in check_mission(mission))
    square = fly_fast(load_mission(f"missions/{name}/square.yaml"), 1, None)
    assert square.outcome == "completed"
    text = (folder / "configs" / f"{name}.yaml").read_text().lower()
    assert not re.search(r"\b(cam|rods?|servo|arms? .*(lock|free))\b", text)


def test_a_vehicle_that_is_not_there_is_one_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["init", str(tmp_path / "lab"), "--vehicle", "blimp"]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert "--vehicle: unknown vehicle 'blimp', known: dart, rigid_cage, ring_guard_250g" in line
    assert not (tmp_path / "lab").exists()


def test_the_copies_load_with_the_copied_configuration(started: Path) -> None:
    configuration = started / "configs" / "dart.yaml"
    configuration.write_text(configuration.read_text().replace("mass_kg: 1.3 ", "mass_kg: 1.4 "))
    assert load_vehicle(configuration).airframe.mass_kg == 1.4
    for path in (started / "missions").glob("*.yaml"):
        assert load_mission(path).vehicle.airframe.mass_kg == 1.4
    for path in (started / "missions" / "scenarios").glob("*.yaml"):
        assert load_scenario(path).vehicle.airframe.mass_kg == 1.4
    for path in (started / "configs" / "px4").glob("*.params"):
        assert load_parameters(path)


def test_the_editor_finds_the_schemas(started: Path) -> None:
    for path in started.rglob("*.yaml"):
        if EXTENDS in Document.load(path).tree:
            continue  # it holds less than the schema wants of a whole configuration
        first = path.read_text().splitlines()[0]
        schema = path.parent / first.partition("$schema=")[2]
        assert json.loads(schema.read_text())["title"].startswith("DART"), path


def test_the_copied_mission_flies(started: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(started)
    assert main(["dry-run", "missions/single_wall.yaml", "--fast"]) == 0
    assert list(started.glob("flights/*/flight.mcap"))


def test_nothing_is_overwritten(started: Path, capsys: pytest.CaptureFixture[str]) -> None:
    mine = started / "configs" / "dart.yaml"
    mine.write_text("mine")
    (started / "missions" / "single_wall.yaml").unlink()
    assert main(["init", str(started)]) == 2
    error = capsys.readouterr().err.splitlines()
    assert len(error) == 1
    assert "dart.yaml: already exists, and so do " in error[0]
    assert mine.read_text() == "mine"
    assert not (started / "missions" / "single_wall.yaml").exists(), "all or nothing"


@pytest.mark.skipif(os.geteuid() == 0, reason="root may write everywhere")
def test_a_folder_that_cannot_be_written(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    tmp_path.chmod(0o500)
    try:
        assert main(["init", str(tmp_path / "lab")]) == 2
    finally:
        tmp_path.chmod(0o700)
    assert "cannot write: Permission denied" in capsys.readouterr().err


def test_a_file_in_the_place_of_the_folder(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "lab").write_text("")
    assert main(["init", str(tmp_path / "lab")]) == 2
    assert len(capsys.readouterr().err.splitlines()) == 1


def test_json_lists_what_was_written(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["init", str(tmp_path / "lab"), "--json"]) == 0
    report = json.loads(capsys.readouterr().out)
    assert report["directory"] == str(tmp_path / "lab")
    assert {Path(name) for name in report["files"]} == {
        p for p in (tmp_path / "lab").rglob("*") if p.is_file()
    }


def test_completion_knows_every_command_and_option(capsys: pytest.CaptureFixture[str]) -> None:
    for shell in ("bash", "zsh", "tcsh"):
        assert main(["completion", shell]) == 0
        script = capsys.readouterr().out
        for command in COMMANDS:
            assert command in script, f"{command} in {shell}"
        if shell == "tcsh":
            continue  # knows commands and their choices only
        for option in ("--standoff", "--objective", "--incidence-deg"):
            assert option in script, f"{option} in {shell}"


def bash_completes(words: list[str], folder: Path, script: Path) -> set[str]:
    """What bash offers for the last word of a command line."""
    line = " ".join(words)
    probe = (
        f"source {script}; COMP_WORDS=({' '.join(word or chr(39) * 2 for word in words)}); "
        f"COMP_CWORD={len(words) - 1}; COMP_LINE='{line}'; COMP_POINT={len(line)}; "
        'f=$(complete -p dart-flight | grep -oP "(?<=-F )\\S+"); '
        '"$f" dart-flight "${COMP_WORDS[COMP_CWORD]}" "${COMP_WORDS[COMP_CWORD-1]}"; '
        'printf "%s\\n" "${COMPREPLY[@]}"'
    )
    done = subprocess.run(
        ["bash", "-c", probe], cwd=folder, capture_output=True, text=True, check=True, timeout=20
    )
    return set(done.stdout.split())


@pytest.mark.skipif(shutil.which("bash") is None, reason="no bash here")
def test_bash_completes_commands_options_choices_and_files(started: Path, tmp_path: Path) -> None:
    script = tmp_path / "completion.bash"
    done = subprocess.run(
        [sys.executable, "-m", "dart_flight", "completion", "bash"],
        capture_output=True,
        text=True,
        check=True,
        cwd=ROOT,
    )
    script.write_text(done.stdout)
    assert bash_completes(["dart-flight", "dry"], started, script) == {"dry-run"}
    assert "--standoff" in bash_completes(["dart-flight", "fly", "--st"], started, script)
    assert bash_completes(["dart-flight", "lock", "fle"], started, script) == {"flexible"}
    offered = bash_completes(["dart-flight", "dry-run", "missions/sing"], started, script)
    assert offered == {"missions/single_wall.yaml"}
    assert bash_completes(["dart-flight", "fly", "--driver", "ma"], started, script) == {"maestro"}
