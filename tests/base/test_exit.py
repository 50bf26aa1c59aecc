"""A program ends after its result, whatever keeps its process alive."""

import subprocess
import sys

import pytest

KEPT_BY = {
    "nothing": "",
    "a thread": "threading.Thread(target=time.sleep, args=(600,), name='kept').start()",
    "an exit function": "atexit.register(time.sleep, 600)",
    "an executor": "ThreadPoolExecutor(1).submit(time.sleep, 600)",
    "a thread that holds the interpreter's lock in C": (
        "atexit.register(lambda: ctypes.PyDLL(None).sleep(600))"
    ),
}


@pytest.mark.parametrize("kept_by", KEPT_BY)
def test_a_program_ends_with_its_status_although_something_keeps_it(kept_by: str) -> None:
    program = (
        "import atexit, ctypes, threading, time\n"
        "from concurrent.futures import ThreadPoolExecutor\n"
        "from dart_flight.base.processes import exit_within\n"
        f"{KEPT_BY[kept_by]}\n"
        "print('verdict')\n"
        "exit_within(7, 0.3)\n"
    )
    done = subprocess.run(
        [sys.executable, "-c", program], capture_output=True, text=True, timeout=60, check=False
    )
    assert done.stdout == "verdict\n"
    # Only SIGALRM ends a process whose interpreter is blocked.
    assert done.returncode == (-14 if "in C" in kept_by else 7)
    assert ("forced exit; " in done.stderr) == (kept_by not in ("nothing",) and "in C" not in kept_by)
