"""`make test` and `make test-rest`: each test runs in one of them, and they leave no process behind."""

from __future__ import annotations

import functools
import os
import shlex
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
from _pytest.mark.expression import Expression  # pytest has no public name for it

from tests.conftest import COLLECTED

ROOT = Path(__file__).parents[1]
GOOD, BAD = "timeit -n 1 -r 1 pass", "py_compile there-is-no-such-file.py"
PRINTS = "timeit -n 1 -r 1 'print(chr(123), 1, chr(125))'"


def run_both(first: list[str], others: list[str]) -> subprocess.CompletedProcess[str]:
    code = f"import sys; from tools.run_tests import run_both; sys.exit(not run_both({first}, {others}))"
    return subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, check=False)


@functools.cache
def stages() -> list[Selection]:
    """Return what the pytest commands of both select."""
    words = [sys.executable, "-m", "tools.run_tests", "--list"]
    done = subprocess.run(words, cwd=ROOT, capture_output=True, text=True, check=True)
    return [Selection(command) for command in done.stdout.splitlines()]


class Selection:
    """The tests that a pytest command of `tools.run_tests` selects."""

    def __init__(self, command: str) -> None:
        words = shlex.split(command)
        self._marks = Expression.compile(words[words.index("-m") + 1])
        self._paths = tuple(word for word in words if word.startswith("tests/"))

    def __call__(self, test: str, marks: set[str]) -> bool:
        chosen = self._marks.evaluate(lambda mark, /, **_: mark in marks)
        return chosen and test.startswith(self._paths or "tests/")


def test_every_test_runs_in_exactly_one_of_the_two_commands(request: pytest.FixtureRequest) -> None:
    collected = request.config.stash[COLLECTED]
    wrong = {
        test: count
        for test, marks in collected.items()
        if (count := sum(stage(test, marks) for stage in stages())) != 1
    }
    assert collected
    assert wrong == {}


def test_a_test_in_real_time_outside_the_stages_files_would_be_found() -> None:
    assert not any(stage("tests/base/test_new.py::test_new", {"realtime"}) for stage in stages())
    assert not any(stage("tests/base/test_new.py::test_new", {"px4"}) for stage in stages())


@pytest.mark.parametrize(
    ("first", "others", "good"),
    [([GOOD], [GOOD], True), ([BAD, GOOD], [GOOD], False), ([GOOD], [BAD, GOOD], False)],
)
def test_a_failure_of_either_group_fails_the_run(first: list[str], others: list[str], good: bool) -> None:
    assert (run_both(first, others).returncode == 0) is good


def test_the_output_of_the_second_group_is_shown_last() -> None:
    done = run_both([GOOD], [PRINTS, GOOD])
    assert done.returncode == 0
    shown = [line for line in done.stdout.splitlines() if line[0] in "+{"]
    assert shown == [f"+ {GOOD}", f"+ {PRINTS}", "{ 1 }", f"+ {GOOD}"]


@pytest.mark.parametrize(
    ("number", "ignored"),
    [(signal.SIGINT, False), (signal.SIGTERM, False), (signal.SIGTERM, True)],
    ids=["Ctrl-C", "SIGTERM", "SIGTERM to what a script has started behind it"],
)
def test_an_interrupted_run_leaves_no_process_behind(
    number: signal.Signals, ignored: bool, tmp_path: Path
) -> None:
    sleeps = [
        f"timeit -n 1 -r 1 'import os, time; os.mkdir(\"{tmp_path}/\" + str(os.getpid())); time.sleep(60)'"
        for _ in range(2)
    ]
    code = "import sys; from tools import run_tests as r; r._PATIENCE_S = 1.0; "
    code += f"r.LINT, r.TESTS, r.TYPES = (), *{[[sleep] for sleep in sleeps]}; "
    code += "sys.exit(r.main([]))"
    process = subprocess.Popen(
        [sys.executable, "-c", code],
        cwd=ROOT,
        start_new_session=True,
        # A process inherits whether Ctrl-C is ignored.
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_IGN if ignored else signal.SIG_DFL),  # noqa: PLW1509
    )
    until = time.monotonic() + 60.0
    while len(list(tmp_path.iterdir())) < 2 and time.monotonic() < until:
        time.sleep(0.05)
    if number is signal.SIGINT:
        os.killpg(process.pid, number)  # as a terminal does
    else:
        process.send_signal(number)
    assert process.wait(30.0) == 1
    sleepers = [int(path.name) for path in tmp_path.iterdir()]
    assert len(sleepers) == 2
    for pid in sleepers:
        with pytest.raises(ProcessLookupError):
            os.kill(pid, 0)
