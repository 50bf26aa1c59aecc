"""Every command in README and docs parses, and runs unless `NOT_RUN` gives a reason."""

from __future__ import annotations

import argparse
import contextlib
import glob
import importlib.util
import os
import re
import shlex
import shutil
import subprocess
from collections.abc import Iterator
from pathlib import Path

import pytest

from dart_flight.cli import COMMANDS, build_parser, main
from dart_flight.lab.commands import plan_command
from dart_flight.lab.search import flown_plan
from dart_flight.lab.search.flown_plan import fly_in_process
from dart_flight.lab.search.plan import SearchResult
from dart_flight.lab.search.quickest import Progress, plan_quickest
from dart_flight.lab.search.scenario import Scenario
from dart_flight.run.prepare import load_flyable
from dart_flight.sim.draws import parse_vary
from dart_flight.sim.faults.fault_table import parse_fault
from tests.docs.snippets import PAGES, ROOT, Command, blocks, commands, name_of
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
    (r"^dart-flight survey", "takes seconds; tests/cli/test_survey.py runs it"),
    (r"^dart-flight studio", "serves a page until Ctrl-C"),
    (r"--scene", "needs viser; tests/lab/studio/test_server.py runs it"),
    (r"^dart-flight series", "takes minutes; tests/lab/series runs it"),
    (r"^dart-flight room", "needs cameras and a hand"),
    (r"--pdf", "takes seconds; tests/lab/report/test_page.py runs it"),
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
            assert_values_are_known(build_parser([arguments[0]]).parse_args(arguments))
    module = re.match(r"python -m (\S+)", command.text)
    if module:
        assert importlib.util.find_spec(module[1]) is not None, command.text


def assert_values_are_known(arguments: argparse.Namespace) -> None:
    """Check the values that a command itself reads: its fault, and what it varies and changes."""
    changes, spreads, fault = (getattr(arguments, name, None) for name in ("set", "vary", "fault"))
    if fault is not None:
        parse_fault(fault)
    mission = getattr(arguments, "mission", None) or next(iter(getattr(arguments, "missions", ())), "")
    if (changes or spreads) and mission.startswith("missions/"):
        settings = [setting.partition(",")[0] for setting in changes or ()]  # the first value of a campaign's
        parse_vary(spreads or (), load_flyable(ROOT / mission, settings=settings).vehicle)


def _options(parser: object, command: str) -> set[str]:
    choices = parser._subparsers._group_actions[0].choices  # type: ignore[attr-defined]
    return {option for action in choices[command]._actions for option in action.option_strings}


@pytest.mark.parametrize(("pattern", "reason"), NOT_RUN, ids=[reason for _, reason in NOT_RUN])
def test_every_reason_not_to_run_applies_to_a_command(pattern: str, reason: str) -> None:
    assert any(re.search(pattern, command.text) for command in ALL), f"no command is left that {reason}"


# --- running ---------------------------------------------------------------------------------------------


def _environment(root: Path) -> dict[str, str]:
    return os.environ | {
        "PATH": f"{root / 'bin'}:{os.environ['PATH']}",
        "PYTHONPATH": str(ROOT),
        # A state per worker, because the pages run in parallel with different locks.
        "DART_FLIGHT_STATE_DIR": str(root / f"state-{os.environ.get('PYTEST_XDIST_WORKER', '')}"),
        "COLUMNS": "200",
    }


# These commands run once: the same command on the same flight gives the same result.
RUN_ONCE = re.compile(
    r"^dart-flight (campaign|check|predict|replay|report|identify|calibrate|export|survey|dry-run .*--fast)\b"
    r"(?!.*--log-dir)"  # later commands read its flight
)
# Of these, a command with the options of another is the same, whatever their values and its mission: other
# tests fly every mission, and `test_a_documented_command_parses` checks the values.
SAME_OPTIONS = re.compile(r"^dart-flight (campaign [^-]|check|survey|dry-run)")
# The command that made the flight of `laboratory`, with any log folder.
LABORATORY_FLIGHT = re.compile(
    r"^dart-flight dry-run missions/single_wall\.yaml --fast( --runs 1)? --log-dir (\S+)$"
)


def as_run(command: Command) -> str:
    """Return the command with one seed, and a plan in a second, without flights except on the quickstart."""
    text = re.sub(r"--runs \d+", "--runs 1", command.text)
    if "scenarios/shuttle.yaml" in text:
        text += " --within 1"
    flies = not text.startswith("dart-flight plan") or command.page.name == "quickstart.md"
    return text if flies or "--no-verify" in text else f"{text} --no-verify"


def _form(command: Command) -> tuple[str, int]:
    """Return what must agree with a command that has run: its words without outputs, and the exit status.

    The output with `--json` is tested with the pages' JSON.
    """
    text = re.sub(r" (-o|--output|--out) \S+| --json\b", "", as_run(command))
    text = re.sub(r"[\w.]+(?=/\*/flight\.mcap)", "", text)  # the folder of flights that it reads
    if SAME_OPTIONS.match(text):
        own = r"(?!missions/)\S+\.yaml$"  # a file that another command has written
        words = text.split()
        text = " ".join([*words[:2], *(w for w in words[2:] if w.startswith("-") or re.match(own, w))])
    return text, command.status


def _find_repeated() -> set[str]:
    """Return the places of the commands that run at another place.

    The quickstart runs whole. The next ones are those that produce the pages' JSON.
    """
    quickstart = [c for c in ALL if c.page.name == "quickstart.md"]
    shown = [
        Command(page, block.line, f"dart-flight {block.produced_by}", 0)
        for page in PAGES
        for block in blocks(page)
        if block.produced_by
    ]
    runs: dict[tuple[str, int], str] = {}
    for command in filter(_runs_once, [*quickstart, *shown, *ALL]):
        runs.setdefault(_form(command), command.place)
    return {c.place for c in ALL if _runs_once(c) and runs[_form(c)] != c.place}


def _runs_once(command: Command) -> bool:
    return reason_not_to_run(command) is None and bool(RUN_ONCE.match(as_run(command)))


REPEATED = _find_repeated()


def lines_to_run(page: Path, laboratory: Path) -> Iterator[tuple[Command, str]]:
    """Yield the page's commands, each with the line that is run for it."""
    for command in commands(page):
        if reason_not_to_run(command) is not None or is_real_time(command) or command.place in REPEATED:
            continue
        text = as_run(command)
        flight = LABORATORY_FLIGHT.match(text)
        yield command, text if flight is None else f"cp -r {laboratory}/flights {flight[2]}"


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


RUNNABLE = [
    page
    for page in PAGES
    if page.name != "CONTRIBUTING.md"  # sets a checkout up
    and any(not text.startswith("cp ") for _, text in lines_to_run(page, Path("laboratory")))
]


@pytest.fixture
def short_plans(flown: SharedFlights, monkeypatch: pytest.MonkeyPatch) -> None:
    """Share the plan of a scenario with `sight`; fly a plan in one drawn world, in this process."""

    def plan(scenario: Scenario, within_s: float, progress: Progress) -> SearchResult:
        if scenario.sight is None:
            return plan_quickest(scenario, within_s, progress)
        return limited_sight_plan(flown, scenario)

    monkeypatch.setattr(plan_command, "plan_quickest", plan)
    monkeypatch.setattr(flown_plan, "DRAWN", 1)
    monkeypatch.setattr(
        flown_plan,
        "fly_fast_many",
        lambda mission, seeds, _, done, spreads, *__: fly_in_process(mission, seeds, spreads, done),
    )


@pytest.mark.rest
@pytest.mark.usefixtures("every_package", "short_plans")
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

    Dry-runs that differ only in the mission are returned once, with a short mission, because other tests fly
    every mission. tests/flights/test_embedded_flights.py flies at full speed.
    """
    found: dict[str, str | None] = {}
    for page in PAGES:
        simulate: str | None = None
        for command in filter(is_real_time, commands(page)):
            if command.text.startswith("dart-flight simulate"):
                simulate = command.text
            elif command.text.startswith("dart-flight fly"):
                found.setdefault(command.text, simulate)
            elif not re.fullmatch(r"dart-flight dry-run \S+( --speed max)?", command.text):
                found[re.sub(r"missions/\S+", "missions/single_wall.yaml", command.text)] = None
    return list(found.items())


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
