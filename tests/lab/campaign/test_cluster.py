"""The same flights on Dask's workers: rows identical to a local run, also where a worker is killed."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from dart_flight.cli import main
from dart_flight.config.packages import install_command
from tests.lab.campaign.test_campaign import ROOT, rows, words

distributed = pytest.importorskip("distributed", reason="needs Dask's distributed, the extra cluster")


def spawn(*command: str) -> subprocess.Popen[bytes]:
    quiet = os.environ | {"PYTHONPATH": str(ROOT), "DASK_DISTRIBUTED__WORKER__DAEMON": "true"}
    return subprocess.Popen(
        [sys.executable, "-m", "distributed.cli." + command[0], *command[1:]],
        env=quiet, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL, start_new_session=True,
    )  # fmt: skip


class Cluster:
    """A scheduler and two workers, each a process of its own as on two machines."""

    def __init__(self, folder: Path) -> None:
        self._file = folder / "scheduler.json"
        listen = ("--host", "127.0.0.1", "--port", "0", "--no-dashboard", "--scheduler-file", str(self._file))
        self.processes = [spawn("dask_scheduler", *listen)]
        until = time.monotonic() + 60.0
        while not self._file.exists() and time.monotonic() < until:
            time.sleep(0.05)
        self.workers = [self._worker(folder / str(i)) for i in range(2)]
        with distributed.Client(scheduler_file=str(self._file), timeout=60, set_as_default=False) as client:
            client.wait_for_workers(2, timeout=60)
            self.url = client.scheduler.address

    def _worker(self, folder: Path) -> subprocess.Popen[bytes]:
        folder.mkdir()
        options = ("--nthreads", "1", "--no-nanny", "--no-dashboard", "--local-directory", str(folder))
        self.processes.append(spawn("dask_worker", "--scheduler-file", str(self._file), *options))
        return self.processes[-1]

    def close(self) -> None:
        for process in self.processes:
            process.kill()
            process.wait()


@pytest.fixture
def cluster(tmp_path: Path) -> Iterator[Cluster]:
    made = Cluster(tmp_path)
    try:
        yield made
    finally:
        made.close()


def begun(out: Path, cluster: Cluster, runs: int) -> subprocess.Popen[str]:
    """The command, with a first row in its table."""
    process = subprocess.Popen(
        [sys.executable, "-m", "dart_flight", *words(out, runs, "--scheduler", cluster.url)],
        env=os.environ | {"PYTHONPATH": str(ROOT)}, stderr=subprocess.PIPE, text=True,
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),  # noqa: PLW1509
    )  # fmt: skip
    table, until = out / "flights.csv", time.monotonic() + 120.0
    while process.poll() is None and time.monotonic() < until:
        if table.exists() and table.read_bytes().count(b"\n") > 1:
            break
        time.sleep(0.02)
    return process


def test_rows_are_those_of_a_local_run_also_where_a_worker_is_killed(
    cluster: Cluster, tmp_path: Path
) -> None:
    here, there = tmp_path / "here", tmp_path / "there"
    assert main(words(here, 8)) == 0
    process = begun(there, cluster, 8)
    cluster.workers[0].send_signal(signal.SIGKILL)
    _, said = process.communicate(timeout=300.0)
    assert process.returncode == 0, said
    assert sorted((there / "flights.csv").read_bytes().splitlines()) == sorted(
        (here / "flights.csv").read_bytes().splitlines()
    )
    assert {path.parent.name for path in there.glob("logs/*/flight.mcap")} == {
        path.parent.name for path in here.glob("logs/*/flight.mcap")
    }


def test_ctrl_c_keeps_what_has_landed(cluster: Cluster, tmp_path: Path) -> None:
    out = tmp_path / "stopped"
    process = begun(out, cluster, 100)
    process.send_signal(signal.SIGINT)
    _, said = process.communicate(timeout=120.0)
    assert process.returncode == 130, said
    flown = len(rows(out))
    assert 1 <= flown < 100
    seeds = [int(row["seed"]) for row in rows(out)]
    assert len(set(seeds)) == flown


def test_a_scheduler_that_dies_ends_it_in_a_line(cluster: Cluster, tmp_path: Path) -> None:
    out = tmp_path / "orphaned"
    process = begun(out, cluster, 100)
    cluster.processes[0].kill()
    _, said = process.communicate(timeout=120.0)
    assert process.returncode == 1, said
    last = "lost connection to the scheduler; completed rows are kept; continue with --resume"
    assert said.splitlines()[-1].endswith(last)
    assert "Traceback" not in said
    assert {row["outcome"] for row in rows(out)} <= {"completed", "aborted"}, "no row of what was not flown"


def test_a_scheduler_that_is_not_there(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("dart_flight.lab.campaign.cluster._PATIENCE_S", 1.0)
    assert main(words(tmp_path / "none", 2, "--scheduler", "tcp://127.0.0.1:9")) == 1
    assert "--scheduler tcp://127.0.0.1:9: " in capsys.readouterr().err.splitlines()[-1]


def test_without_dask_the_extra_is_named(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "distributed", None)
    assert main(words(tmp_path / "none", 2, "--scheduler", "tcp://127.0.0.1:9")) == 2
    assert install_command("cluster") in capsys.readouterr().err
