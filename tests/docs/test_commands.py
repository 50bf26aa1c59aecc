"""Every command in README and docs parses, and runs unless `NOT_RUN` gives a reason."""

from __future__ import annotations

import contextlib
import glob
import importlib.util
import os
import re
import shlex
import shutil
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from dart_flight.cli import COMMANDS, build_parser, main
from dart_flight.lab.commands import plan_command
from tests.docs.snippets import PAGES, ROOT, Command, commands, name_of
from tests.shared_flights import LiveFlights, SharedFlights
from tests.shared_plans import limited_sight_plan

# Patterns of commands that are not run, with the reason. Those of dart-flight are still parsed.
NOT_RUN: list[tuple[str, str]] = [
    (r"^(sudo|journalctl) |> /srv/", "needs root and systemd"),
    (r"^dart-flight standby", "waits for a ground station"),
    (r"^make ", "sets up a virtual environment of its own"),
    (r"--px4", "needs a PX4 build"),
    (r"--scheduler tcp://host|^dask ", "needs a Dask scheduler"),
    (
        r"--connection serial:|^dart-flight (calibrate airframe --connection|monitor|mocap)|"
        r"^dart-flight (parameters|px4-log|standby)|"
        r"^dart-flight fly missions/\S+( --standoff \S+)?$",
        "needs the vehicle",
    ),
    (r"--driver (maestro|pwm)", "needs the servo"),
    (r"^dart-flight lock calibrate", "asks at the keyboard"),
    (r"\.ulg", "needs a log of PX4's"),
    (
        r"^python -m tools\.(bench|campaigns|synthetic_trials|lossy_proxy)",
        "takes minutes or waits",
    ),
    (r":14541", "needs the lossy proxy, which waits"),
    (r"> /srv/", "needs the installed service"),
    (r"missions/unknown_room\.yaml", "takes 12 s; tests/cli/test_survey.py flies it"),
]
# Commands that fly through MAVSDK, which test_a_documented_flight_through_mavsdk_succeeds runs.
REAL_TIME = re.compile(r"^dart-flight (simulate|fly .*udpin://127\.0\.0\.1:14540|dry-run (?!.*--fast))")


def reason_not_to_run(command: Command) -> str | None:
    if command.is_synopsis:
        return "shows the syntax"
    return next((reason for pattern, reason in NOT_RUN if re.search(pattern, command.text)), None)


def is_real_time(command: Command) -> bool:
    return reason_not_to_run(command) is None and bool(REAL_TIME.match(command.text))


ALL = [command for page in PAGES for command in commands(page)]


def test_the_extraction_finds_the_commands() -> None:
    texts = [command.text for command in ALL]
    assert "dart-flight dry-run missions/dual_collision.yaml --fast" in texts
    assert "dart-flight lock calibrate --config configs/dart.yaml" in texts, "commands in lists are found"
    assert any(command.status == 2 for command in ALL)
    assert {command.arguments()[0] for command in ALL if command.arguments()} == set(COMMANDS)  # type: ignore[index]


@pytest.mark.parametrize("command", ALL, ids=lambda c: f"{c.place}")
def test_a_documented_command_parses(command: Command) -> None:
    arguments = command.arguments()
    if arguments is not None:
        if command.is_synopsis:
            known = build_parser([arguments[0]])
            words = [word for word in arguments if word.startswith("--")]
            assert all(word.split("=")[0] in _options(known, arguments[0]) for word in words), command.text
        else:
            build_parser([arguments[0]]).parse_args(arguments)
    module = re.match(r"python -m (\S+)", command.text)
    if module:
        assert importlib.util.find_spec(module[1]) is not None, command.text


def _options(parser: object, command: str) -> set[str]:
    choices = parser._subparsers._group_actions[0].choices  # type: ignore[attr-defined]
    return {option for action in choices[command]._actions for option in action.option_strings}


@pytest.mark.parametrize(("pattern", "reason"), NOT_RUN, ids=[reason for _, reason in NOT_RUN])
def test_every_reason_not_to_run_applies_to_a_command(pattern: str, reason: str) -> None:
    assert any(re.search(pattern, command.text) for command in ALL), f"no command is left that {reason}"


# --- running ---------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def laboratory(flown: SharedFlights) -> Path:
    """A folder made by `init`, with the files that pages assume: a flight, trials, a list of hits."""
    return flown.once("laboratory", lambda folder: prepare_laboratory(folder / "lab")) / "lab"


def prepare_laboratory(folder: Path) -> None:
    tools = folder.parent / "bin"
    tools.mkdir()
    for name, start in (("dart-flight", "-m dart_flight"), ("python", "")):
        shim = tools / name
        shim.write_text(f'#!/bin/sh\nexec {sys.executable} {start} "$@"\n')
        shim.chmod(0o755)
    _run(["dart-flight", "init", str(folder)], folder.parent, folder.parent)
    _run(["dart-flight", "dry-run", "missions/single_wall.yaml", "--fast"], folder, folder.parent)
    (folder / "hits.csv").write_text("mode,normal_m_s,tangential_m_s\nrigid,-1.0,0.5\nflexible,-0.6,0.5\n")
    trials = ["python", "-m", "tools.synthetic_trials"]
    hits = ["--surface", "acrylic", "--mode", "flexible", "--wall", "0.6", "1.2"]
    drops = ["--surface", "concrete", "--mode", "rigid", "--drop", "0.05", "0.2", "--plane", "0.2"]
    for name, what in (("hit", hits), ("drop", drops)):
        _run([*trials, name, *what], folder.parent, folder.parent)
        for i, path in enumerate(sorted((folder.parent / name).glob("*.csv"))):
            path.rename(folder / f"{name}_{i}.csv")


def _environment(root: Path) -> dict[str, str]:
    return os.environ | {
        "PATH": f"{root / 'bin'}:{os.environ['PATH']}",
        "PYTHONPATH": str(ROOT),
        # A state per worker, because the pages run in parallel with different locks.
        "DART_FLIGHT_STATE_DIR": str(root / f"state-{os.environ.get('PYTEST_XDIST_WORKER', '')}"),
        "COLUMNS": "200",
    }


def _run(words: list[str], folder: Path, root: Path) -> None:
    subprocess.run(words, cwd=folder, env=_environment(root), check=True, capture_output=True, timeout=120)


# These commands run on one page only: the same command on the same flight gives the same result.
RUN_ONCE = re.compile(
    r"^dart-flight (campaign|check|predict|replay|report|identify|calibrate|export|survey|dry-run .*--fast)\b"
)
# The command that made the flight of `laboratory`, with any log folder.
LABORATORY_FLIGHT = re.compile(
    r"^dart-flight dry-run missions/single_wall\.yaml --fast( --runs 1)? --log-dir (\S+)$"
)


def as_run(command: Command) -> str:
    """Return the command with one seed, and a plan without its twenty flights except on the quickstart."""
    text = re.sub(r"--runs \d+", "--runs 1", command.text)
    flies = not text.startswith("dart-flight plan") or command.page.name == "quickstart.md"
    return text if flies or "--no-verify" in text else f"{text} --no-verify"


def _without_outputs(text: str) -> str:
    """Return a command without the names of its outputs and of the folder of flights that it reads.

    A flight that no later command reads also loses its missions, because another test flies each of them.
    """
    flies = re.match(r"dart-flight (campaign|survey|dry-run .*--fast)\b", text) and "--log-dir" not in text
    text = re.sub(r"[\w.]+(?=/\*/flight\.mcap)", "", re.sub(r" (-o|--output|--log-dir|--out) \S+", "", text))
    return re.sub(r" missions/\S+", " MISSION", text) if flies else text


def _find_repeated() -> set[tuple[str, str]]:
    """Return (page, command) of the commands that an earlier page runs; the quickstart comes first."""
    runs: dict[str, str] = {}
    repeated = set()
    for page in sorted(PAGES, key=lambda page: page.name != "quickstart.md"):
        for command in commands(page):
            text = as_run(command)
            runs_here = reason_not_to_run(command) is None and RUN_ONCE.match(text)
            if runs_here and runs.setdefault(_without_outputs(text), name_of(page)) != name_of(page):
                repeated.add((name_of(page), text))
    return repeated


REPEATED = _find_repeated()


def lines_to_run(page: Path, laboratory: Path) -> Iterator[tuple[Command, str]]:
    """Yield the page's commands, each with the line that is run for it."""
    for command in commands(page):
        if reason_not_to_run(command) is not None or is_real_time(command):
            continue
        text = as_run(command)
        if (name_of(page), text) in REPEATED:
            flight = LABORATORY_FLIGHT.match(text)
            if flight is None:
                assert "--log-dir" not in text, "later commands need its flight"
                continue
            text = f"cp -r {laboratory}/flights {flight[2]}"
        yield command, text


# Pipes, variables and lists of commands need a shell.
SHELL = re.compile(r"[|&;$`]|^[A-Z_]+=")


def run_page(page: Path, laboratory: Path) -> None:
    """Run the page's commands, those of dart-flight in this process, which is faster."""
    for command, text in lines_to_run(page, laboratory):
        if text.startswith("cd "):
            os.chdir(text[3:])
            status = 0
        elif text.startswith("dart-flight ") and not SHELL.search(text):
            status = _main(text)
        else:
            status = subprocess.run(["bash", "-c", text], check=False, timeout=300).returncode
        assert status == command.status, f"{command.place}: ended with {status}"


def _main(text: str) -> int:
    text, _, target = text.partition(" > ")
    words = [name for word in shlex.split(text)[1:] for name in sorted(glob.glob(word)) or [word]]
    with contextlib.ExitStack() as stack:
        if target:
            file = stack.enter_context(open(target.strip(), "w", encoding="utf-8"))
            stack.enter_context(contextlib.redirect_stdout(file))
        try:
            return main(words)
        except SystemExit as end:
            return int(end.code or 0)


def _is_runnable(page: Path) -> bool:
    run = [c for c in commands(page) if reason_not_to_run(c) is None and not is_real_time(c)]
    return any((name_of(page), as_run(command)) not in REPEATED for command in run)


RUNNABLE = [page for page in PAGES if _is_runnable(page)]


def test_every_repeated_command_runs_on_another_page() -> None:
    run = {
        _without_outputs(as_run(c))
        for p in RUNNABLE
        for c in commands(p)
        if (name_of(p), as_run(c)) not in REPEATED
    }
    assert {_without_outputs(text) for _, text in REPEATED} <= run


@pytest.fixture
def shared_plan(flown: SharedFlights, monkeypatch: pytest.MonkeyPatch) -> None:
    """Share the plan of a scenario with `sight` between tests, because planning takes seconds."""
    monkeypatch.setattr(
        plan_command, "plan_limited_sight", lambda scenario, progress: limited_sight_plan(flown, scenario)
    )


@pytest.mark.rest
@pytest.mark.usefixtures("shared_plan")
@pytest.mark.parametrize("page", RUNNABLE, ids=name_of)
def test_the_commands_of_a_page_run_as_written(
    page: Path, laboratory: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The commands run in order in a folder made by `init`; repeated ones run on another page."""
    if page.name == "quickstart.md":  # the quickstart makes its own folder
        monkeypatch.chdir(tmp_path)
    else:
        shutil.copytree(laboratory, tmp_path / "lab")
        monkeypatch.chdir(tmp_path / "lab")
    for name, value in _environment(laboratory.parent).items():
        monkeypatch.setenv(name, value)
    run_page(page, laboratory)


def test_the_error_shown_in_the_quickstart_is_the_actual_one(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["init", str(tmp_path / "lab")]) == 0
    monkeypatch.chdir(tmp_path / "lab")
    page = ROOT / "docs" / "quickstart.md"
    change = next(c.text for c in commands(page) if c.text.startswith("sed "))
    subprocess.run(["bash", "-c", change], check=True)
    capsys.readouterr()
    assert main(["check", "missions/mine.yaml"]) == 2
    assert f"```\n{capsys.readouterr().err.strip()}\n```" in page.read_text(encoding="utf-8")


# --- through MAVSDK --------------------------------------------------------------------------------------


def real_time_flights() -> list[tuple[str, str | None]]:
    """Return the dry-runs, and the flights with the `simulate` that precedes them on the page.

    Commands that differ only in the mission are returned once, because other tests fly every mission.
    """
    found: dict[str, tuple[str, str | None]] = {}
    for page in PAGES:
        simulate: str | None = None
        for command in filter(is_real_time, commands(page)):
            if command.text.startswith("dart-flight simulate"):
                simulate = command.text
            else:
                flies = command.text.startswith("dart-flight fly")
                form = re.sub(r"missions/\S+", "MISSION", command.text)
                found.setdefault(form, (command.text, simulate if flies else None))
    return list(found.values())


def _flights() -> list[object]:
    """Return test parameters: dry-runs at full speed, and real-time flights with their simulator."""
    return [
        pytest.param(
            command if simulate or re.search("--(speed|realtime)", command) else f"{command} --speed max",
            simulate,
            id=command,
            marks=[
                pytest.mark.mavlink,
                pytest.mark.rest,
                *([pytest.mark.realtime] if simulate or "--realtime" in command else []),
            ],
        )
        for command, simulate in real_time_flights()
    ]


@pytest.mark.parametrize(("command", "simulate"), _flights())
def test_a_documented_flight_through_mavsdk_succeeds(
    command: str, simulate: str | None, commanded: LiveFlights
) -> None:
    done = commanded(command, simulate)
    assert done.status == 0, done.errors[-2000:]
