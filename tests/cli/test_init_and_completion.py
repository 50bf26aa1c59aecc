"""`init` writes a self-contained folder; `completion` prints a script that the shell accepts."""

from __future__ import annotations

import json
import re
import shutil
import subprocess
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
from tests.command_fixtures import Refuse, RunJson
from tests.mission_findings import check_mission

ROOT = Path(__file__).resolve().parents[2]


# All but the last one run in the rest.
_OTHERS = [
    pytest.param(name, marks=[pytest.mark.rest] if name != VEHICLES[-1] else [])
    for name in VEHICLES
    if name != DART
]


@pytest.fixture
def lab_folder(tmp_path: Path) -> Path:
    folder = tmp_path / "lab"
    assert main(["init", str(folder)]) == 0
    return folder


def test_every_shipped_file_is_copied_unchanged_for_some_vehicle(tmp_path: Path) -> None:
    for name in VEHICLES:
        assert main(["init", str(tmp_path / name), "--vehicle", name]) == 0
    for pattern in ("configs/**/*.yaml", "configs/**/*.params", "missions/**/*.yaml", "docs/schemas/*.json"):
        files = sorted(ROOT.glob(pattern))
        assert files
        for path in files:
            copies = [tmp_path / name / path.relative_to(ROOT) for name in VEHICLES]
            existing = [copy for copy in copies if copy.exists()]
            assert existing, path
            shared = path.suffix != ".yaml" or path.name == "dart.yaml"  # the others extend dart.yaml
            assert len(existing) == (len(VEHICLES) if shared else 1)
            assert {copy.read_bytes() for copy in existing} == {path.read_bytes()}


@pytest.mark.parametrize("name", _OTHERS)
def test_init_of_another_vehicle_recommends_two_commands_that_work(
    name: str, folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["init", str(folder), "--vehicle", name]) == 0
    lines = capsys.readouterr().err.splitlines()
    commands = [line.split()[1:] for line in lines if line.startswith("  dart-flight ")]
    assert [words[0] for words in commands] == ["check", "dry-run"]
    for words in commands:
        assert main(words) == 0
    # DART's configuration is there too, but commands without a mission use the chosen vehicle.
    assert default_config_path() == Path(f"configs/{name}.yaml")
    vehicle = load_vehicle()
    assert not vehicle.has_lock
    assert load_scenario(f"missions/{name}/scenarios/one_wall.yaml").vehicle == vehicle
    missions = sorted((folder / "missions" / name).glob("*.yaml"))
    assert [path.stem for path in missions] == ["single_wall", "square"]
    for path in missions:
        mission = load_mission(path)
        assert mission.vehicle == vehicle
        assert all(finding.go for finding in check_mission(mission))
    text = (folder / "configs" / f"{name}.yaml").read_text().lower()
    assert not re.search(r"\b(cam|rods?|servo|arms? .*(lock|free))\b", text)


def test_an_unknown_vehicle_is_refused_in_one_line(tmp_path: Path, refusal_of: Refuse) -> None:
    line = refusal_of("init", tmp_path / "lab", "--vehicle", "blimp")
    assert "--vehicle: unknown vehicle 'blimp', known: dart, rigid_cage, ring_guard_250g" in line
    assert not (tmp_path / "lab").exists()


def test_the_copies_load_with_the_copied_configuration(lab_folder: Path) -> None:
    configuration = lab_folder / "configs" / "dart.yaml"
    configuration.write_text(configuration.read_text().replace("mass_kg: 1.3 ", "mass_kg: 1.4 "))
    assert load_vehicle(configuration).airframe.mass_kg == 1.4
    for path in (lab_folder / "missions").glob("*.yaml"):
        assert load_mission(path).vehicle.airframe.mass_kg == 1.4
    for path in (lab_folder / "missions" / "scenarios").glob("*.yaml"):
        assert load_scenario(path).vehicle.airframe.mass_kg == 1.4
    for path in (lab_folder / "configs" / "px4").glob("*.params"):
        assert load_parameters(path)


def test_every_copied_file_names_an_existing_schema(lab_folder: Path) -> None:
    for path in lab_folder.rglob("*.yaml"):
        if EXTENDS in Document.load(path).tree:
            continue  # lacks keys that the schema requires
        first = path.read_text().splitlines()[0]
        schema = path.parent / first.partition("$schema=")[2]
        assert json.loads(schema.read_text())["title"].startswith("DART"), path


def test_init_overwrites_nothing(lab_folder: Path, refusal_of: Refuse) -> None:
    mine = lab_folder / "configs" / "dart.yaml"
    mine.write_text("mine")
    (lab_folder / "missions" / "single_wall.yaml").unlink()
    line = refusal_of("init", lab_folder)
    assert "dart.yaml: already exists, and " in line
    assert " more files exist; name an empty folder" in line
    assert mine.read_text() == "mine"
    assert not (lab_folder / "missions" / "single_wall.yaml").exists(), "init writes all files or none"


def test_a_folder_that_cannot_be_written_is_reported(refusal_of: Refuse) -> None:
    assert "cannot write: " in refusal_of("init", "/proc/lab")


def test_a_file_in_place_of_the_folder_is_refused(tmp_path: Path, refusal_of: Refuse) -> None:
    (tmp_path / "lab").write_text("")
    assert str(tmp_path / "lab") in refusal_of("init", tmp_path / "lab")


def test_json_lists_the_written_files(tmp_path: Path, run_json: RunJson) -> None:
    report, _ = run_json("init", tmp_path / "lab")
    assert report["directory"] == str(tmp_path / "lab")
    assert {Path(name) for name in report["files"]} == {
        p for p in (tmp_path / "lab").rglob("*") if p.is_file()
    }


@pytest.mark.parametrize("shell", ["bash", "zsh", "tcsh"])
def test_a_completion_script_contains_every_command_and_option(
    shell: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["completion", shell]) == 0
    script = capsys.readouterr().out
    assert [command for command in COMMANDS if command not in script] == []
    options = ("--standoff", "--objective", "--incidence-deg") if shell != "tcsh" else ()
    assert [option for option in options if option not in script] == []


def complete_in_bash(words: list[str], folder: Path, script: Path) -> set[str]:
    """Return bash's completions of the last word of a command line."""
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
def test_bash_completes_commands_options_choices_and_files(
    lab_folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    script = tmp_path / "completion.bash"
    capsys.readouterr()
    assert main(["completion", "bash"]) == 0
    script.write_text(capsys.readouterr().out)
    assert complete_in_bash(["dart-flight", "dry"], lab_folder, script) == {"dry-run"}
    assert "--standoff" in complete_in_bash(["dart-flight", "fly", "--st"], lab_folder, script)
    assert complete_in_bash(["dart-flight", "lock", "fle"], lab_folder, script) == {"flexible"}
    completions = complete_in_bash(["dart-flight", "dry-run", "missions/sing"], lab_folder, script)
    assert completions == {"missions/single_wall.yaml"}
    assert complete_in_bash(["dart-flight", "fly", "--driver", "ma"], lab_folder, script) == {"maestro"}
