"""Text from outside and broken standard streams: neither changes the exit status of a flight."""

from __future__ import annotations

import errno
import io
import os
import subprocess
import sys
from collections.abc import Callable, Iterator
from contextlib import redirect_stderr, redirect_stdout
from pathlib import Path

import msgspec
import pytest
from hypothesis import given
from hypothesis import strategies as st

from dart_flight.base.text import printable
from dart_flight.cli import main
from dart_flight.cli.terminal import (
    OutputError,
    emit_json,
    keep_status,
    live_screen,
    messages,
    print_status,
    styled,
    tables,
)
from dart_flight.config.document import InputError
from dart_flight.config.provenance import display_path
from dart_flight.config.vehicle import packaged
from tests.command_fixtures import Refuse, RunJson
from tests.shared_flights import ROOT

MISSION = packaged("missions", "single_wall.yaml")
NEAR = ROOT / "tests" / "data" / "near_wall.yaml"
PREDICT = ["predict", "--surface", "acrylic", "--mode", "rigid", "--velocity", "-1.0", "0.0"]


class BrokenStream(io.StringIO):
    """A stream that refuses every write."""

    def __init__(self, number: int) -> None:
        super().__init__()
        self.number = number

    def write(self, text: str) -> int:
        raise OSError(self.number, os.strerror(self.number))


@pytest.fixture
def odd_mission(tmp_path: Path) -> Path:
    """A mission whose file name is not UTF-8 and has brackets."""
    path = Path(os.fsdecode(os.fsencode(tmp_path) + b"/m[/x]\xff.yaml"))
    path.parent.mkdir()
    text = MISSION.read_text(encoding="utf-8")
    path.write_text(text.replace("../configs/dart.yaml", str(packaged("configs", "dart.yaml"))))
    return path


@pytest.fixture
def removed_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """A working folder that was removed."""
    folder = tmp_path / "gone"
    folder.mkdir()
    monkeypatch.chdir(folder)
    folder.rmdir()
    yield
    os.chdir(ROOT)


# --- text ------------------------------------------------------------------------------------------------


@given(st.text(alphabet=st.characters(exclude_categories=())))
def test_printable_text_can_be_encoded_and_is_otherwise_unchanged(text: str) -> None:
    shown = printable(text)
    assert shown.encode() == printable(shown).encode()
    if not any(0xD800 <= ord(c) < 0xE000 for c in text):
        assert shown == text


@given(st.binary())
def test_a_file_name_of_any_bytes_is_printable(name: bytes) -> None:
    shown = printable(os.fsdecode(name))
    assert shown.encode().decode() == shown
    assert len(shown) >= len(name.decode("utf-8", "ignore"))


def test_undecodable_bytes_of_a_file_name_are_shown_as_escapes() -> None:
    assert printable(os.fsdecode(b"m\xff\xc3\xa4.yaml")) == "m\\xffä.yaml"


@pytest.mark.parametrize("text", ["p [/x]", "q [red]", "[bold", ":warning:", "\\[a]", "[@click=f]b[/]"])
def test_text_is_not_interpreted_as_markup(text: str, capsys: pytest.CaptureFixture[str]) -> None:
    from rich.table import Table

    table = Table(title=text)
    table.add_column(text, no_wrap=True)
    table.add_row(text)
    print_status(text)
    messages().print(text, style="red", soft_wrap=True)
    messages().print(styled((text, "bold"), text), soft_wrap=True)
    tables().print(table)
    output = capsys.readouterr()
    assert output.err == f"{text}\n{text}\n{text}{text}\n"
    assert output.out.count(text) == 3


def test_an_ascii_terminal_receives_only_ascii() -> None:
    data = io.BytesIO()
    terminal = io.TextIOWrapper(data, encoding="ascii")
    with redirect_stdout(terminal):
        tables().print("0.02\N{NO-BREAK SPACE}m ± 0.01 → ü \udcff", soft_wrap=True)
    assert data.getvalue() == b"0.02 m +/- 0.01 -> \\xfc \\xff\n"


# --- names -----------------------------------------------------------------------------------------------


def test_a_mission_with_an_odd_file_name_flies(odd_mission: Path, tmp_path: Path, run_json: RunJson) -> None:
    printed, errors = run_json("dry-run", odd_mission, "--fast", "--log-dir", tmp_path / "logs [/y]")
    assert "logs [/y]" in printed["log"]
    assert Path(printed["log"]).exists()
    assert "dart-flight report" not in errors, "--json recommends no command"


@pytest.mark.parametrize(
    "command", ["check", "dry-run", "plan", "survey", "report", "inspect", "identify", "replay"]
)
def test_an_error_in_an_oddly_named_file_is_reported_in_one_line(
    command: str, tmp_path: Path, refusal_of: Refuse
) -> None:
    path = Path(os.fsdecode(os.fsencode(tmp_path) + b"/n\xfe[/].yaml"))
    path.parent.mkdir()
    path.write_bytes(b"version: [")
    assert "n\\xfe[/].yaml" in refusal_of(command, path)


def test_a_vehicle_with_an_odd_file_name_is_named_in_json(folder: Path, run_json: RunJson) -> None:
    path = Path(os.fsdecode(os.fsencode(folder) + b"/c\xff.yaml"))
    path.write_bytes(packaged("configs", "dart.yaml").read_bytes())
    printed, errors = run_json(*PREDICT, "--config", path)
    assert printed["vehicle"]["source"] == "c\\xff.yaml"
    assert "vehicle: c\\xff.yaml" in errors


def test_a_campaign_refuses_file_names_that_are_not_utf_8(
    odd_mission: Path, tmp_path: Path, refusal_of: Refuse
) -> None:
    words = ["campaign", odd_mission, "--runs", "1", "--out", tmp_path / "c"]
    assert "the file name is not UTF-8" in refusal_of(*words)


def test_json_output_of_any_text_is_valid(capsys: pytest.CaptureFixture[str]) -> None:
    emit_json({"log\udcff": ["\udcfe", {"a": "ü"}], "figure": 1.5, "missing": None})
    assert msgspec.json.decode(capsys.readouterr().out) == {
        "log\\xff": ["\\xfe", {"a": "ü"}],
        "figure": 1.5,
        "missing": None,
    }


# --- the working folder ----------------------------------------------------------------------------------


@pytest.mark.usefixtures("removed_folder")
@pytest.mark.parametrize("command", [["check", str(MISSION)], ["dry-run", str(MISSION), "--fast"], PREDICT])
def test_a_removed_working_folder_is_reported_in_one_line(command: list[str], refusal_of: Refuse) -> None:
    line = "cannot use the working folder: No such file or directory; cd to another folder"
    assert refusal_of(*command) == line


@pytest.mark.usefixtures("removed_folder")
def test_log_paths_can_be_displayed_in_a_removed_working_folder() -> None:
    assert display_path("flights/a/flight.mcap") == "flights/a/flight.mcap"
    assert display_path("/logs/a/flight.mcap") == "/logs/a/flight.mcap"


def test_a_circular_or_unknown_px4_folder_is_refused(tmp_path: Path, refusal_of: Refuse) -> None:
    (tmp_path / "a").symlink_to(tmp_path / "b")
    (tmp_path / "b").symlink_to(tmp_path / "a")
    for folder in (str(tmp_path / "a"), "~nobody-of-that-name/px4"):
        assert "no PX4 SITL in this folder" in refusal_of("dry-run", MISSION, "--px4", folder)


def test_an_unexpected_system_error_is_one_line_with_its_source_line(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def refuse(*_: object) -> None:
        raise OSError(errno.ENXIO, os.strerror(errno.ENXIO), "/etc/odd")

    monkeypatch.setattr("dart_flight.config.provenance.load_vehicle", refuse)
    assert main(PREDICT) == 1
    assert capsys.readouterr().err.startswith(f"/etc/odd: {os.strerror(errno.ENXIO)} (test_output.py:")


# --- broken streams --------------------------------------------------------------------------------------


@pytest.mark.parametrize("number", [errno.EIO, errno.ENOSPC, errno.EPIPE])
def test_a_lost_terminal_does_not_end_a_flight(number: int) -> None:
    with redirect_stderr(BrokenStream(number)):
        print_status("→ APPROACH 1")
        messages().print("→ APPROACH 1")


@pytest.mark.parametrize("write", [lambda: emit_json({}), lambda: tables().print("a")])
def test_a_full_standard_output_is_reported(write: Callable[[], None]) -> None:
    with (
        redirect_stdout(BrokenStream(errno.ENOSPC)),
        pytest.raises(OutputError, match="cannot write standard output: No space left"),
    ):
        write()


def test_a_finished_flight_keeps_its_status_if_the_output_fails(capsys: pytest.CaptureFixture[str]) -> None:
    text = "dual-collision, fast: completed, log: a.mcap"
    with redirect_stdout(BrokenStream(errno.EDQUOT)), keep_status(text):
        emit_json({})
    err = capsys.readouterr().err
    assert err.startswith("dual-collision, fast: completed, log: a.mcap (cannot write standard output: ")


def _run(command: list[str], redirection: str, folder: Path, **environment: str) -> tuple[int, str]:
    """Return the exit status and standard error of a command whose output the shell redirects."""
    words = " ".join(f"'{word}'" for word in [sys.executable, "-m", "dart_flight", *command])
    done = subprocess.run(
        ["bash", "-c", f"{words} {redirection}"],
        env=os.environ | {"PYTHONPATH": str(ROOT)} | environment,
        cwd=folder, capture_output=True, text=True, check=False, timeout=120,
    )  # fmt: skip
    assert "Traceback" not in done.stderr
    assert "Exception ignored" not in done.stderr
    return done.returncode, done.stderr


@pytest.mark.parametrize(
    ("redirection", "words"),
    [
        (">/dev/full", "No space left on device"),
        pytest.param(">&-", "Bad file descriptor", marks=pytest.mark.rest),
        pytest.param("> >(true); sleep 0.1", None, marks=pytest.mark.rest),
    ],
)
def test_a_flight_without_an_output_keeps_its_exit_status(
    redirection: str, words: str | None, tmp_path: Path
) -> None:
    fly = ["dry-run", str(NEAR), "--fast", "--log-dir", "logs", "--json"]
    redirection = redirection.replace("; sleep 0.1", "; code=$?; sleep 0.1; exit $code")
    status, output = _run(fly, redirection, tmp_path)
    assert status == 0
    if words is not None:
        last = output.splitlines()[-1]
        assert last.startswith("near-wall, fast: completed, log: logs/")
        assert words in last
    assert list(tmp_path.glob("logs/*/flight.mcap"))


def test_a_lost_result_is_reported_as_a_failure(tmp_path: Path) -> None:
    status, output = _run(PREDICT, ">/dev/full", tmp_path)
    assert (status, output.splitlines()[-1]) == (1, "cannot write standard output: No space left on device")
    assert _run(["--help"], ">/dev/full", tmp_path)[0] == 1
    assert _run(PREDICT, ">/dev/null 2>/dev/full", tmp_path)[0] == 0
    assert _run(PREDICT, ">/dev/null 2>&-", tmp_path)[0] == 0


def test_a_live_screen_without_a_terminal_prints_a_line_per_period_and_the_last_one(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    now_s = 100.0
    monkeypatch.setattr("dart_flight.cli.terminal.time.monotonic", lambda: now_s)
    printed = []
    with live_screen(2.0) as show:
        for number in range(12):
            show(styled("a screen"), styled(f"{number} " + 40 * "long "))
            printed.append(capsys.readouterr().out[:2].strip())
            now_s += 0.5
    assert printed == ["0", "", "", "", "4", "", "", "", "8", "", "", ""]
    assert capsys.readouterr().out.splitlines() == ["11 " + 40 * "long "]


@pytest.mark.rest
def test_tables_are_ascii_on_an_ascii_terminal(tmp_path: Path) -> None:
    fly = ["dry-run", str(NEAR), "--fast", "--log-dir", "logs"]
    status, _ = _run(fly, ">out", tmp_path, PYTHONIOENCODING="ascii")
    assert status == 0
    assert (tmp_path / "out").read_bytes().isascii()
    assert b"max. tilt" in (tmp_path / "out").read_bytes()


def test_a_file_does_not_reuse_the_descriptor_of_a_closed_stream(tmp_path: Path) -> None:
    """Otherwise a library that prints to descriptor 1 would write into the flight's log."""
    script = (
        "import os; from dart_flight.cli.terminal import open_closed_streams; open_closed_streams();"
        "file = open('log', 'w'); import sys; sys.exit(file.fileno() < 3 or sys.stdout is None)"
    )
    done = subprocess.run(
        ["bash", "-c", f'"{sys.executable}" -c "{script}" <&- >&- 2>&-'],
        env=os.environ | {"PYTHONPATH": str(ROOT)}, cwd=tmp_path, check=False, timeout=60,
    )  # fmt: skip
    assert done.returncode == 0


def test_an_input_error_escapes_terminal_control_characters() -> None:
    assert InputError("wrong", source="a\x1b[31m\udcff\n").one_line() == "a?[31m\\xff?: wrong"
